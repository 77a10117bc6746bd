"""What an error of timing (jitter.py) makes of a simulation error that nothing else explains."""

from collections.abc import Sequence

import numpy as np

from cg_interfaces.channels import Mechanism
from cg_sysid.identification.data_set import DataSet
from cg_sysid.records.jitter import timing_error


def late_samples(
    data_sets: Sequence[DataSet], robot: Mechanism, outputs: Sequence[str], output: str, unit: str
) -> str:
    """That samples were taken beside their stamps, and the error that this makes, in a sentence.

    Args:
        data_sets: Records, or windows of them.
        robot: Its topics tell which outputs are of one sensor.
        outputs: Names of the columns of the data sets' outputs.
        output: The one whose error is told.
        unit: Its unit.

    Returns:
        The sentence; empty where most recordings show no such thing.
    """
    sensor = next(t for t in robot.outputs if output in {c.name for c in t.channels})
    names = [c.name for c in sensor.channels if c.name in outputs]
    found, made = [], []
    recordings = sorted({data_set.recording for data_set in data_sets})
    for recording in recordings:
        own = [data_set for data_set in data_sets if data_set.recording == recording]
        signals = {name: _joined(own, outputs.index(name)) for name in names}
        error = timing_error(signals)
        if error is not None and output in error.channels:
            time, values = signals[output]
            rate = np.diff(values) / np.diff(time)
            found.append(error.sigma)
            made.append(error.sigma * float(np.sqrt(np.mean(rate**2))))
    if 2 * len(found) <= len(recordings):
        return ''
    return (
        f'Samples were taken beside their stamps, by {1e3 * np.median(found):.2g} ms RMS, which '
        f'no effect of the library is: that makes {np.median(made):.2g} {unit} RMS of error in '
        f'{output}.'
    )


def _joined(data_sets: Sequence[DataSet], column: int) -> tuple[np.ndarray, np.ndarray]:
    """Times in s and samples of an output over the windows of a recording, in order."""
    windows = sorted(data_sets, key=lambda data_set: data_set.since)
    time = np.concatenate([data_set.since + data_set.time for data_set in windows])
    values = np.concatenate([data_set.outputs[:, column] for data_set in windows])
    there = np.isfinite(values)
    time, values = time[there], values[there]
    later = np.diff(time, prepend=-np.inf) > 0.0  # windows share the sample where one ends
    return time[later], values[later]
