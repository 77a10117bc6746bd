"""What a remaining simulation error looks like: how fast it is and what it follows.

A missing torque acts on the second derivative of an angle, so that is what is compared with angle,
rate and torque: of the variance of the error's acceleration, the share that a smooth curve over
each of them explains. It says where to look, not what the cause is.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np
import scipy

from cg_sysid.report.curves import Curve

SMOOTHED_S = 0.08  # window over which the error is differentiated
BINS = 20
LEAST_SAMPLES = 400
CHANCE = 0.02  # share that a curve of this many bins explains of noise
WORTH_NAMING = 0.2  # share from which an error is said to follow a quantity


def leftover(
    curves: Sequence[Curve], channel: int, unit: str, inputs: Sequence[str]
) -> dict[str, Any]:
    """Character of the error that is left in one output.

    Args:
        curves: Records to judge on.
        channel: Index of the output.
        unit: Its unit; of a rate the first derivative is taken.
        inputs: Names of the inputs.

    Returns:
        `median_frequency_hz`, below which half of the error's power lies (in the record with
        most of it), and `follows`: quantity -> share of the variance explained, 0 to 1; empty
        where there is too little data.
    """
    pieces = [p for p in (_pieces(c, channel, unit) for c in curves) if p is not None]
    if not pieces:
        return {'median_frequency_hz': None, 'follows': {}}
    names = ['angle', 'rate', *inputs]
    columns = [np.concatenate(part) for part in zip(*(p[1:] for p in pieces), strict=True)]
    acceleration, *quantities = columns
    follows: dict[str, float] = {}
    if len(acceleration) >= LEAST_SAMPLES:
        follows = {
            name: explained(x, acceleration)
            for name, x in zip(names, quantities, strict=True)
            if np.ptp(x) > 0
        }
    return {
        'median_frequency_hz': max(p[0] for p in pieces)[1],
        'follows': follows,
    }


def _pieces(curve: Curve, channel: int, unit: str) -> tuple[Any, ...] | None:
    """(Power, median frequency), then the error's acceleration, angle, rate and each input."""
    present = np.isfinite(curve.measured[:, channel])
    if present.sum() < LEAST_SAMPLES // 4:
        return None
    time = curve.time[present]
    step = float(np.median(np.diff(time)))
    grid = np.arange(time[0], time[-1], step)

    def regular(values: np.ndarray) -> np.ndarray:
        return np.interp(grid, time, values[present])

    error = regular((curve.after - curve.measured)[:, channel])
    window = max(5, 2 * int(0.5 * SMOOTHED_S / step) + 1)
    if len(grid) < 3 * window:
        return None
    order = 1 if unit.endswith('/s') else 2
    acceleration = scipy.signal.savgol_filter(error, window, 3, deriv=order, delta=step)
    inner = slice(window, -window)
    power = np.abs(np.fft.rfft(error * np.hanning(len(error)))) ** 2
    share = np.cumsum(power) / power.sum() if power.sum() > 0 else np.ones(len(power))
    median = float(np.fft.rfftfreq(len(error), step)[np.searchsorted(share, 0.5)])
    quantities = [curve.position[:, channel], curve.rate[:, channel], *curve.inputs.T]
    columns = [acceleration, *(regular(x) for x in quantities)]
    return (float(np.var(error)), median), *(column[inner] for column in columns)


def explained(x: np.ndarray, y: np.ndarray) -> float:
    """Share of the variance of y that a curve over x explains, beyond what chance would.

    Args:
        x: Shape (n,).
        y: Shape (n,).
    """
    edges = np.unique(np.quantile(x, np.linspace(0, 1, BINS + 1)[1:-1]))
    index = np.searchsorted(edges, x)
    count = np.bincount(index, minlength=BINS)
    mean = np.bincount(index, y, minlength=BINS) / np.maximum(count, 1)
    total = float(np.mean((y - y.mean()) ** 2))
    if total <= 0:
        return 0.0
    left = float(np.mean((y - mean[index]) ** 2))
    return float(np.clip((1 - left / total - CHANCE) / (1 - CHANCE), 0.0, 1.0))


def followed(follows: dict[str, float]) -> str | None:
    """The quantity that an error follows; None where none stands out."""
    if not follows:
        return None
    best = max(follows, key=lambda name: follows[name])
    return best if follows[best] >= WORTH_NAMING else None
