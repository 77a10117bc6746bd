"""The signal around each fault of a broken recording, for the report to show."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cg_interfaces.stamps import NS_PER_S
from cg_sysid.records.findings import CheckReport, Finding
from cg_sysid.records.raw import RawRecording

MOST_FAULTS = 4  # faults of one recording
LEAST_CONTEXT = 0.5  # s before and after a fault


@dataclass(frozen=True)
class FaultSignal:
    """A signal around a fault.

    Attributes:
        source: Name of the recording.
        channel: Channel shown.
        unit: Its unit.
        code: Code of the finding.
        start: Begin of the fault in s since the first stamp of the recording.
        stop: End of the fault in s.
        time: Of the samples in s, increasing, shape (n,).
        values: Samples, shape (n,).
    """

    source: str
    channel: str
    unit: str
    code: str
    start: float
    stop: float
    time: np.ndarray = field(repr=False)
    values: np.ndarray = field(repr=False)


def fault_signals(raw: RawRecording, report: CheckReport) -> tuple[FaultSignal, ...]:
    """The signals around those faults of a recording that have a place in time.

    Args:
        raw: The recording.
        report: What the check says about it.
    """
    placed = [f for f in report.findings if f.severity == 'error' and f.start_s is not None]
    found = (_around(raw, report.name, finding) for finding in placed[:MOST_FAULTS])
    return tuple(signal for signal in found if signal is not None)


def _around(raw: RawRecording, name: str, finding: Finding) -> FaultSignal | None:
    found = _channel(raw, finding.where)
    if found is None or finding.start_s is None:
        return None
    channel, stamps, values = found
    origin = min(int(t.stamp_ns.min()) for t in raw.topics.values() if len(t))
    time = (stamps - origin) / NS_PER_S
    start = finding.start_s
    stop = start if finding.stop_s is None else finding.stop_s
    margin = max(LEAST_CONTEXT, 0.75 * (stop - start))
    near = (time >= start - margin) & (time <= stop + margin)
    if near.sum() < 2:
        return None
    order = np.argsort(time[near], kind='stable')
    units = {c.name: c.unit for t in raw.mechanism.topics.values()
             for c in t.channels}  # fmt: skip
    return FaultSignal(
        name, channel, units.get(channel, '1'), finding.code, start, stop,
        time[near][order], values[near][order],
    )  # fmt: skip


def _channel(raw: RawRecording, where: str) -> tuple[str, np.ndarray, np.ndarray] | None:
    """Name, stamps and values of the channel, or of the first one of the topic, called `where`."""
    for topic in raw.topics.values():
        for channel, values in topic.values.items():
            if where in (channel, topic.name):
                return channel, topic.stamp_ns, values
    return None


def as_arrays(signals: Sequence[FaultSignal]) -> dict[str, np.ndarray]:
    """The signals as plain arrays by name, for curves.npz."""
    arrays = {}
    for k, s in enumerate(signals):
        arrays[f'fault/{k}/words'] = np.array([s.source, s.channel, s.unit, s.code], np.str_)
        arrays[f'fault/{k}/span'] = np.array([s.start, s.stop])
        arrays[f'fault/{k}/time'] = s.time
        arrays[f'fault/{k}/values'] = s.values
    return arrays


def from_arrays(arrays: Mapping[str, np.ndarray]) -> list[FaultSignal]:
    """What `as_arrays` made."""
    found: list[FaultSignal] = []
    while f'fault/{len(found)}/words' in arrays:
        k = len(found)
        source, channel, unit, code = (str(word) for word in arrays[f'fault/{k}/words'])
        start, stop = (float(t) for t in arrays[f'fault/{k}/span'])
        time, values = arrays[f'fault/{k}/time'], arrays[f'fault/{k}/values']
        found.append(FaultSignal(source, channel, unit, code, start, stop, time, values))
    return found
