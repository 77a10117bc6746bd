"""Instants of sampling that are not where their stamps say, told from the samples alone.

A sample taken eps too late reads v eps too much, v being the rate of the channel. An error of
timing therefore makes noise that is white in time and grows with the rate, by one and the same
factor in every channel of a sensor, while the noise of the sensor does not know of the rate:

    E[c^2] = sigma^2 + sigma_t^2 v^2

with the contrasts c of noise.py, on which motion leaves nothing. The line is fitted to the medians
of c^2 among samples of like rate, as knocks and steps are few. Resonances and ripples that go with
the rate are not white: they shrink from contrast to wider contrast, and the least answer counts.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cg_sysid.records.noise import WIDTHS, contrasts, resolution

CLASSES = 12  # of like rate, each with as many samples
PARTS = 10  # of the record, in time: they show how sure the answer is
FEWEST_FOR_JITTER = 600  # samples; 50 in each class
MEDIAN = 0.4549  # median of the square of a standard normal number
REACH = 3  # samples on either side that the rate is the slope over
CERTAIN = 3.5  # standard errors from which the slope is one: the errors are of ten parts
FELT = 1.0  # variance that the timing adds at speed over that of the sensor: less hurts no fit
# Quanta^2. At three counts in two samples the error of rounding alternates between +-1/4: the
# widest contrast makes 0.32 of it, and a median of equal squares seems 2.2 times as much: 0.7 in
# all, and that is what FELT asks for above this.
ROUNDING = 0.35
LEAST = 0.03  # of the spacing: to this share steps.py takes any instant to be known, [1]
ALIKE = 2.0  # ratio of the answers of two channels of one sensor that are one answer, [1]


@dataclass(frozen=True)
class TimingError:
    """How far instants of sampling are from their stamps.

    Attributes:
        sigma: Root mean square in s.
        error: Standard error of that in s.
        channels: The channels that show it.
    """

    sigma: float
    error: float
    channels: tuple[str, ...]


@dataclass(frozen=True)
class _Line:
    """The fitted line of one channel: variances at rest and at speed, slope and its error."""

    rest: float
    speed: float
    slope: float
    error: float

    @property
    def certain(self) -> bool:
        return self.slope > CERTAIN * self.error and self.speed > (1.0 + FELT) * self.rest


def timing_error(
    channels: Mapping[str, tuple[np.ndarray, np.ndarray]],
) -> TimingError | None:
    """The error of timing that all moving channels of one sensor show alike.

    Args:
        channels: Channel -> (increasing times in s, samples), both of shape (M,).

    Returns:
        None where there is none to be seen, or where the channels contradict each other.
    """
    lines = {name: _line(*samples) for name, samples in channels.items()}
    shown = {name: line for name, line in lines.items() if line is not None and line.certain}
    if not shown:
        return None
    weight = np.array([line.error**-2 for line in shown.values()])
    slope = float(weight @ [line.slope for line in shown.values()] / weight.sum())
    spacing = min(float(np.median(np.diff(channels[name][0]))) for name in shown)
    if slope < (LEAST * spacing) ** 2:
        return None
    for line in lines.values():
        if line is not None and _contradicts(line, slope):
            return None
    sigma = float(np.sqrt(slope))
    error = float(weight.sum() ** -0.5) / (2.0 * sigma)
    return TimingError(sigma, error, tuple(shown))


def _contradicts(line: _Line, slope: float) -> bool:
    """Whether a channel would have shown that slope, and shows another."""
    low, high = line.slope - CERTAIN * line.error, line.slope + CERTAIN * line.error
    return high < slope / ALIKE**2 or low > slope * ALIKE**2


def _line(time: np.ndarray, values: np.ndarray) -> _Line | None:
    """The line of a channel; None where it has too few samples that move."""
    if len(values) < FEWEST_FOR_JITTER or np.ptp(values) == 0.0:
        return None
    rate = np.zeros(len(values))
    reach = slice(2 * REACH, None), slice(None, -2 * REACH)
    rate[REACH:-REACH] = (values[reach[0]] - values[reach[1]]) / (time[reach[0]] - time[reach[1]])
    # Rounding is noise of its own only where neighbours differ by more than a count.
    spacing = float(np.median(np.diff(time)))
    moving = np.abs(rate) * spacing > resolution(values)
    found = [_fitted(time, values, rate, moving, width) for width in WIDTHS]
    lines = [line for line in found if line is not None]
    # What leaks in from motion is less in wider contrasts; what is white is not.
    return min(lines, key=lambda line: line.slope) if len(lines) == len(WIDTHS) else None


def _fitted(
    time: np.ndarray, values: np.ndarray, rate: np.ndarray, moving: np.ndarray, width: int
) -> _Line | None:
    half = width // 2
    inner = slice(half, len(values) - half)
    use = moving[inner]
    use[:REACH] = use[-REACH:] = False
    if use.sum() < FEWEST_FOR_JITTER:
        return None
    square = contrasts(time, values - values[0], width)[use] ** 2
    speed = rate[inner][use] ** 2
    part = np.arange(len(square)) * PARTS // len(square)
    classes = _of_like(speed)
    levels, rates = (_medians(each, classes, part) for each in (square, speed))
    *without, whole = (_slope(*each) for each in zip(levels / MEDIAN, rates, strict=True))
    slopes = np.array([slope for _, slope in without])
    error = float(np.sqrt((PARTS - 1) / PARTS * np.sum((slopes - slopes.mean()) ** 2)))
    rest, slope = max(whole[0], ROUNDING * resolution(values) ** 2), whole[1]
    return _Line(rest, rest + slope * float(rates[-1, -1]), slope, max(error, 1e-300))


def _of_like(speed: np.ndarray) -> np.ndarray:
    """Samples by classes of like rate, as many in each: indices, -1 where a row is shorter."""
    rows = np.arange(len(speed)) * CLASSES // len(speed)
    sizes = np.bincount(rows, minlength=CLASSES)
    table = np.full((CLASSES, sizes.max()), -1)
    table[np.arange(sizes.max()) < sizes[:, None]] = np.argsort(speed, kind='stable')
    return table


def _medians(values: np.ndarray, classes: np.ndarray, part: np.ndarray) -> np.ndarray:
    """Medians of each class, without each part of the record in turn, and of the whole at last.

    Of each class the values are sorted once: without a part, those in the middle are others.

    Args:
        values: Shape (M,).
        classes: Indices of samples, -1 for none, shape (CLASSES, K).
        part: Of each sample, 0 to PARTS - 1, shape (M,).

    Returns:
        Shape (PARTS + 1, CLASSES); NaN where no sample is left.
    """
    rows = np.arange(len(classes))
    ordered = np.where(classes >= 0, values[classes], np.inf)
    order = np.argsort(ordered, axis=1)
    ordered = np.take_along_axis(ordered, order, axis=1)
    parts = np.take_along_axis(np.where(classes >= 0, part[classes], PARTS), order, axis=1)
    kept = (parts != np.arange(PARTS + 1)[:, None, None]) & (parts < PARTS)
    counted = np.cumsum(kept, axis=2)
    count = counted[:, :, -1:]
    lower, upper = (np.argmax(counted > rank // 2, axis=2) for rank in (count - 1, count))
    middle = (ordered[rows, lower] + ordered[rows, upper]) / 2.0
    return np.where(count[:, :, 0] > 0, middle, np.nan)


def _slope(level: np.ndarray, at: np.ndarray) -> tuple[float, float]:
    """Intercept and slope of the variance over the squared rate, of the classes with samples."""
    present = np.isfinite(level)
    level, at = level[present], at[present]
    # A variance is known to a share of itself.
    weight = 1.0 / np.maximum(level, 1e-3 * level.max() + 1e-300)
    design = np.column_stack([np.ones(len(at)), at]) * weight[:, None]
    scale = np.linalg.norm(design, axis=0)
    solution = np.linalg.lstsq(design / scale, level * weight, rcond=None)[0] / scale
    return float(solution[0]), float(solution[1])
