"""Torque samples that were lost: filled where the torque in between is known well enough.

A drive latches a set-point with every sample. Where the stamps show that some were lost, a curve
through the neighbours stands for them; how well it does is measured on the same recording, on
stretches of the same length that are there.
"""

from dataclasses import dataclass

import numpy as np

from cg_interfaces.stamps import NS_PER_S

ON_GRID = 0.35  # a gap is a whole number of spacings to within this many of them
STEADY = 0.15  # the spacings beside it too, or the loop that stamps was only slow there
# Impulse that may be unknown in a gap, as that of the RMS torque over this time, in s: a hundredth
# of a quarter of a second, in which a leg's motion answers a torque.
KNOWN_S = 0.0025
QUANTILE = 0.95  # of the errors of such fills elsewhere
FEWEST_SPACINGS = 40  # samples, or stretches, from which anything is concluded
MOST_SPACINGS = 0.9  # share of the spacings that must fit the grid, [1]


@dataclass(frozen=True)
class TorqueGap:
    """A hole in a torque.

    Attributes:
        sample: Index of the last sample before it.
        lost: Samples that are missing; 0 where stamps are irregular and nothing can be filled.
        error: What a fill is wrong by, at most, in 95 % of such places, in N m.
        known: Whether that is little enough.
    """

    sample: int
    lost: int
    error: float
    known: bool


def grid_spacing(stamp_ns: np.ndarray) -> float:
    """Spacing in ns of which most spacings are whole multiples; 0 where there is none."""
    spacing = np.diff(stamp_ns)
    if len(spacing) < FEWEST_SPACINGS:
        return 0.0
    short = spacing < 1.5 * np.quantile(spacing, 0.1)
    usual = float(np.median(spacing[short])) if short.any() else 0.0
    if usual <= 0:
        return 0.0
    off = np.abs(spacing / usual - np.rint(spacing / usual))
    return usual if np.mean(off < 0.25) > MOST_SPACINGS else 0.0


def torque_gaps(stamp_ns: np.ndarray, values: np.ndarray) -> list[TorqueGap]:
    """The holes in a regularly sampled torque.

    Args:
        stamp_ns: Increasing stamps in ns, shape (M,).
        values: Torque in N m, shape (M,).
    """
    usual = grid_spacing(stamp_ns)
    if not usual:
        return []
    spacing = np.diff(stamp_ns) / usual
    rms = float(np.sqrt(np.mean(values**2)))
    whole = np.abs(spacing - 1.0) < ON_GRID
    noise = _fill_error(values, whole, 1)
    off = np.abs(spacing - np.rint(spacing))
    gaps, errors = [], {1: noise}
    for k in np.flatnonzero(spacing > 1.0 + ON_GRID):
        lost = round(spacing[k]) - 1
        beside = [*off[max(0, k - 1) : k], *off[k + 1 : k + 2]]
        if lost < 1 or off[k] > ON_GRID or max(beside, default=0.0) > STEADY:
            continue
        if lost not in errors:
            errors[lost] = _fill_error(values, whole, lost)
        grown = np.sqrt(max(0.0, errors[lost] ** 2 - noise**2))
        unknown = grown * lost * usual / NS_PER_S
        gaps.append(TorqueGap(int(k), lost, errors[lost], unknown <= KNOWN_S * rms))
    return gaps


def fill_torque(stamp_ns: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and torque with the known gaps filled; shapes (M + filled,)."""
    stamps, torques = [], []
    for gap in torque_gaps(stamp_ns, values):
        if not gap.known:
            continue
        k = gap.sample
        share = np.arange(1, gap.lost + 1) / (gap.lost + 1)
        stamps.append(stamp_ns[k] + np.rint(share * (stamp_ns[k + 1] - stamp_ns[k])).astype(int))
        before, after = values[max(0, k - 1)], values[min(k + 2, len(values) - 1)]
        torques.append(_between(before, values[k], values[k + 1], after, share, gap.lost + 1))
    if not stamps:
        return stamp_ns, values
    every = np.concatenate([stamp_ns, *stamps])
    order = np.argsort(every, kind='stable')
    return every[order], np.concatenate([values, *torques])[order]


def over_gap(time: np.ndarray, values: np.ndarray, first: int, last: int) -> np.ndarray:
    """Values between two samples of a smooth signal, as the slopes outside them tell.

    Args:
        time: Regular times in s, shape (M,).
        values: Samples, shape (M,); those between `first` and `last` are not used.
        first: Index of the sample before the gap, at least 1.
        last: Index of the sample after it, at most M - 2.

    Returns:
        Values at samples first + 1 .. last - 1.
    """
    share = (time[first + 1 : last] - time[first]) / (time[last] - time[first])
    before, start, stop, after = values[[first - 1, first, last, last + 1]]
    return _between(before, start, stop, after, share, last - first)


def _between(before, start, stop, after, share, steps):
    """Cubic over a gap of `steps` samples that goes on with the slopes beside it."""
    left, right = (start - before) * steps, (after - stop) * steps
    s, r = share, 1.0 - share
    return (1 + 2 * s) * r**2 * start + (1 + 2 * r) * s**2 * stop + s * r * (r * left - s * right)


def _fill_error(values: np.ndarray, whole: np.ndarray, lost: int) -> float:
    """Error in N m of such fills in the middle of stretches that are there.

    Args:
        values: Torque in N m, shape (M,).
        whole: Whether no sample is missing up to the next one, shape (M - 1,).
        lost: Samples to fill.
    """
    steps = lost + 1
    if len(whole) < steps + 2:
        return float('inf')
    n = len(values) - steps - 2
    there = np.lib.stride_tricks.sliding_window_view(whole, steps + 2).all(axis=1)
    if there.sum() < FEWEST_SPACINGS:
        return float('inf')
    before, start = values[:n], values[1 : n + 1]
    stop, after = values[1 + steps : n + 1 + steps], values[2 + steps : n + 2 + steps]
    middle = steps // 2
    filled = _between(before, start, stop, after, middle / steps, steps)
    errors = np.abs(filled - values[1 + middle : n + 1 + middle])[there]
    return float(np.quantile(errors, QUANTILE))
