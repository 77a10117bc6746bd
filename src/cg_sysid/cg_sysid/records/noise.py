"""Measurement noise and resolution of a channel, from the recording itself.

White noise is what local polynomials do not explain. For n neighbouring samples at times t_i the
weights w_i = 1 / prod_(j != i) (t_i - t_j) (a divided difference) vanish on every polynomial of
degree n - 2; scaled to unit norm, sum_i w_i y_i has the variance of the noise, at regular and
irregular sampling alike. Motion leaks in as dt^(n-1) times the (n-1)th derivative, so that the
smallest answer over several n is the one least touched by motion.

Noise that is correlated from sample to sample (a filtered sensor) is not white and is
underestimated here.
"""

from dataclasses import dataclass
from math import sqrt

import numpy as np

from cg_sysid.records.record import Record

WIDTHS = (5, 7, 9)  # samples per local polynomial
BLOCK = 64  # contrasts per block; the median over blocks forgets impacts and rests
SAME_VALUE = 1e-9  # values closer than this fraction of the range are one value, [1]
WHOLE_MULTIPLE = 0.05  # how far a spacing may be from a whole number of quanta, [quanta]
WHOLE_SHARE = 0.98  # share of the spacings that must be whole numbers of quanta, [1]


@dataclass(frozen=True)
class ChannelNoise:
    """Noise of one channel.

    Attributes:
        sigma: Standard deviation of the white noise without the rounding, in the channel's unit.
        quantum: Resolution in the channel's unit; 0 where the values are not quantised.
    """

    sigma: float
    quantum: float

    @property
    def sigma_floor(self) -> float:
        """Smallest error that any model can have, sqrt(sigma^2 + quantum^2 / 12)."""
        return sqrt(self.sigma**2 + self.quantum**2 / 12.0)


def measure_noise(record: Record) -> dict[str, ChannelNoise]:
    """Noise and resolution of every output of a record.

    Args:
        record: The record.

    Returns:
        Channel -> noise. A channel with too few samples for an answer has sigma 0.
    """
    return {channel: channel_noise(*record.samples(channel)) for channel in record.outputs}


def channel_noise(time: np.ndarray, values: np.ndarray) -> ChannelNoise:
    """Noise and resolution of one sampled signal.

    Args:
        time: Increasing sample times in s, shape (M,).
        values: Finite samples, shape (M,).

    Returns:
        White noise, with the share q^2/12 of the rounding taken out, and resolution.
    """
    quantum = resolution(values)
    total = white_sigma(time, values)
    # Where the signal rests on one count, rounding is no noise and nothing must be taken out.
    return ChannelNoise(sqrt(max(0.0, total**2 - quantum**2 / 12.0)), quantum)


def white_sigma(time: np.ndarray, values: np.ndarray) -> float:
    """Standard deviation of the white part of a signal, rounding included.

    Args:
        time: Increasing sample times in s, shape (M,).
        values: Finite samples, shape (M,).

    Returns:
        Standard deviation in the unit of the values; 0 for fewer than 9 samples.
    """
    if len(values) < max(WIDTHS):
        return 0.0
    values = values - values[0]  # so that a constant has no rounding either
    return min(_blockwise(contrasts(time, values, width)) for width in WIDTHS)


def contrasts(time: np.ndarray, values: np.ndarray, width: int) -> np.ndarray:
    """Unit-norm divided differences of each run of `width` neighbouring samples.

    Args:
        time: Increasing sample times in s, shape (M,).
        values: Finite samples, shape (M,).
        width: Samples per run, at least 2.

    Returns:
        Contrasts in the unit of the values, shape (M - width + 1,).
    """
    times = np.lib.stride_tricks.sliding_window_view(time, width)
    span = times[:, -1:] - times[:, :1]
    times = (times - times[:, :1]) / span
    distance = times[:, :, None] - times[:, None, :] + np.eye(width)
    weights = 1.0 / np.prod(distance, axis=2)
    weights /= np.linalg.norm(weights, axis=1, keepdims=True)
    return np.sum(weights * np.lib.stride_tricks.sliding_window_view(values, width), axis=1)


def _blockwise(values: np.ndarray) -> float:
    """Median over blocks of the root mean square of each block."""
    blocks = max(1, len(values) // BLOCK)
    return float(np.median([np.sqrt(np.mean(b**2)) for b in np.array_split(values, blocks)]))


def resolution(values: np.ndarray) -> float:
    """Quantum of a quantised signal.

    Args:
        values: Finite samples, shape (M,).

    Returns:
        The step of which every spacing between values is a whole number, or 0 if there is none.
    """
    levels = np.unique(values)
    if len(levels) < 3:
        return float(levels[-1] - levels[0]) if len(levels) == 2 else 0.0
    spacing = np.diff(levels)
    spacing = spacing[spacing > SAME_VALUE * (levels[-1] - levels[0])]
    if len(spacing) < 2:
        return float(spacing.max(initial=0.0))
    # The smallest spacing is the quantum unless a value off the grid (a limit, say) made it.
    lengths = np.quantile(spacing, [0.0, 0.1, 0.5], method='nearest')
    candidates = [_mean_near(spacing, float(q)) for q in lengths]
    return max((q for q in candidates if _is_quantum(q, spacing)), default=0.0)


def _mean_near(spacing: np.ndarray, candidate: float) -> float:
    """Mean of the spacings that are about as long as a candidate."""
    return float(np.mean(spacing[np.abs(spacing / candidate - 1.0) < 0.25]))


def _is_quantum(candidate: float, spacing: np.ndarray) -> bool:
    """Whether nearly every spacing is a whole number of a candidate."""
    multiples = spacing / candidate
    whole = np.abs(multiples - np.rint(multiples)) < WHOLE_MULTIPLE
    # Continuous values have a chance of 2 x WHOLE_MULTIPLE each to look whole.
    return bool(np.mean(whole & (multiples > 0.5)) >= WHOLE_SHARE)
