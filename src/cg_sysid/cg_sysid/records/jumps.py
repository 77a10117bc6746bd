"""Steps in a sampled angle: two samples between which no motion can have happened.

A body has one position and, but for knocks, one rate. Parabolas through the samples before and
after an instant meet there, to within noise; rate and acceleration may change, as they do when
friction reverses or something knocks, but the value may not. The size of a step is the distance
of the two parabolas, and it counts where spans of different length agree on it.
"""

from dataclasses import dataclass

import numpy as np

SPANS = (6, 12, 25, 50)  # samples on each side
CERTAIN = 5.0  # standard deviations of the distance that noise makes, [1]
ROUNDING = 4.0  # resolution may make a distance of so many quanta, [1]
JITTER = 0.03  # an instant of measurement is known to this share of the spacing, [1]
USUAL = 3.0  # distance over that around it, where the motion is rougher than parabolas, [1]
AROUND = 3  # spans on each side that show what is usual, but 100 samples at least
AGREE = 0.3  # distances of two spans differ by less than this share, and noise
KNOCK_S = 0.02  # s within which two branches meet that a knock, or some bounces, part
# A fit tells the zero of a recording to 0.3 to 0.6 mrad (results.md): less cannot be seen.
FINE = {'rad': 1e-3, 'm': 1e-4}
FINE_SHARE = 1e-3  # of the motion: the torques that follow from an angle are off by no more, [1]
HOLE = 1.8  # spacing over the usual one in which a motion may turn unseen, [1]


@dataclass(frozen=True)
class Step:
    """A step of an angle.

    Attributes:
        sample: Index of the first sample after it.
        time: Its time in s.
        size: Value after less value before, in rad.
        before: Value just before it in rad, and `after`.
        after: Value just after it.
        rate_before: Rate just before it in rad/s.
        rate_after: Rate just after it.
        rate_sigma: Standard deviation of these rates.
        sigma: Standard deviation of the size.
        limit: Smallest size that counts here; 0 where it was not asked for.
    """

    sample: int
    time: float
    size: float
    before: float
    after: float
    rate_before: float
    rate_after: float
    rate_sigma: float
    sigma: float
    limit: float


def find_step(
    time: np.ndarray,
    values: np.ndarray,
    sigma: float,
    quantum: float,
    spans: tuple[int, ...] = SPANS,
    knocks: bool = False,
    timing: float = 0.0,
) -> Step | None:
    """The clearest step of a signal; None if there is none.

    Args:
        time: Increasing sample times in s, shape (M,).
        values: Samples, shape (M,).
        sigma: White noise, in the unit of the values.
        quantum: Resolution, in the unit of the values.
        spans: Samples on each side of an instant, in increasing order.
        knocks: The body may be knocked, as a foot that lands does: then branches of different
            rate that meet close by are no step.
        timing: Error of the instants of sampling in s, root mean square, where one is known.
    """
    spacing = np.diff(time)
    usual = float(np.median(spacing))
    grid, sampled = on_grid(time, values)
    if len(grid) < 4 * spans[-1] or len(grid) > 2 * len(time):
        return None
    holes = np.flatnonzero(spacing > HOLE * usual)
    moved = _usual_move(sampled, 2 * spans[0] + 1)
    score = np.zeros((len(spans), len(grid)))
    size = np.zeros_like(score)
    for i, span in enumerate(spans):
        distance = _distance(sampled, span)
        least = CERTAIN * sigma * _spread(span) + ROUNDING * quantum + 1e-9 * np.ptp(values)
        least = least + CERTAIN * JITTER * moved
        least = least + CERTAIN * (timing / usual) * moved * _spread(span)
        limit = np.maximum(least, USUAL * _usual(np.abs(distance), span))
        for k in holes:
            a, b = np.searchsorted(grid, [time[k], time[k + 1]])
            limit[max(0, a - span) : b + span] = np.inf
        score[i], size[i] = np.abs(distance) / limit, distance
    # Two spans must agree; the better of such pairs counts.
    agreed = np.zeros(len(grid))
    for i in range(len(spans) - 1):
        pair = np.minimum(score[i], score[i + 1])
        apart = np.abs(size[i] - size[i + 1])
        larger = np.maximum(np.abs(size[i]), np.abs(size[i + 1]))
        agree = apart < AGREE * larger + 2.0 * sigma * _spread(spans[i])
        agreed = np.maximum(agreed, np.where(agree, pair, 0.0))
    while True:
        best = int(np.argmax(agreed))
        if agreed[best] <= 1.0:
            return None
        widest = int(np.argmax(score[:, best]))
        limit = abs(size[widest, best]) / score[widest, best]
        step = _step(time, grid, sampled, best, spans[widest], sigma, quantum, float(limit))
        if not (knocks and _knocked(step)):
            return step
        agreed[max(0, best - spans[-1]) : best + spans[-1]] = 0.0


def zero_known_to(values: np.ndarray, unit: str) -> float:
    """How well the zero of an angle is known at best; a shift by less hurts no fit.

    Args:
        values: The angle.
        unit: Its unit, rad or m.
    """
    return max(FINE[unit], FINE_SHARE * float(np.ptp(values)))


def _knocked(step: Step) -> bool:
    """Whether the rate jumps, and the branches before and after meet close by."""
    jump = step.rate_after - step.rate_before
    sure = abs(jump) > CERTAIN * np.sqrt(2.0) * step.rate_sigma
    return bool(sure and abs(step.size) < KNOCK_S * abs(jump))


def step_at(
    time: np.ndarray, values: np.ndarray, sigma: float, quantum: float, instant: float
) -> Step | None:
    """What a signal does at an instant at which another one has a step; None near the ends."""
    grid, sampled = on_grid(time, values)
    k = int(np.searchsorted(grid, instant - 0.5 * (grid[1] - grid[0])))
    span = SPANS[1]
    if k < span or k > len(grid) - span:
        return None
    return _step(time, grid, sampled, k, span, sigma, quantum, 0.0)


def on_grid(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times at the usual spacing, and the values there."""
    usual = float(np.median(np.diff(time)))
    grid = time[0] + usual * np.arange(round((time[-1] - time[0]) / usual) + 1)
    return grid, np.interp(grid, time, values)


def _step(time, grid, sampled, k, span, sigma, quantum, limit) -> Step:
    """What the step between the grid's samples k - 1 and k is like."""
    noise = float(np.hypot(sigma, quantum / np.sqrt(12.0)))
    left, right = sampled[k - span : k], sampled[k : k + span]
    at = (np.arange(span) + 0.5) * (grid[1] - grid[0])
    solve = np.linalg.pinv(np.vander(at, 3, increasing=True))
    before, after = solve @ left[::-1], solve @ right
    size = float(after[0] - before[0])
    return Step(
        sample=int(np.searchsorted(time, grid[k] - 0.5 * (grid[1] - grid[0]))),
        time=float(grid[k]),
        size=size,
        before=float(before[0]),
        after=float(after[0]),
        rate_before=float(-before[1]),
        rate_after=float(after[1]),
        rate_sigma=noise * float(np.linalg.norm(solve[1])),
        sigma=noise * _spread(span),
        limit=limit,
    )


def _edge(span: int) -> np.ndarray:
    """Weights of the parabola through `span` samples at its edge, nearest sample first."""
    at = np.arange(span) + 0.5
    return np.linalg.pinv(np.vander(at, 3, increasing=True))[0]


def _spread(span: int) -> float:
    """Standard deviation of a distance in that of a sample."""
    return float(np.sqrt(2.0) * np.linalg.norm(_edge(span)))


def _distance(values: np.ndarray, span: int) -> np.ndarray:
    """Distance of the parabolas between samples k - 1 and k, 0 near the ends, shape (M,)."""
    weights = np.concatenate([-_edge(span)[::-1], _edge(span)])
    distance = np.zeros(len(values))
    distance[span : len(values) - span + 1] = np.correlate(values, weights, 'valid')
    return distance


def _usual_move(values: np.ndarray, width: int) -> np.ndarray:
    """How far a signal moves from sample to sample around each, a step left out, shape (M,)."""
    moved = np.pad(np.diff(values), (width // 2, width // 2 + 1), mode='edge')
    return np.abs(np.median(np.lib.stride_tricks.sliding_window_view(moved, width), axis=1))


def _usual(distance: np.ndarray, span: int) -> np.ndarray:
    """Usual distance around each sample, without those that the same step makes, shape (M,)."""
    block = 10
    levels = np.array([b.max() for b in np.array_split(distance, max(1, len(distance) // block))])
    reach, own = max(100, AROUND * span) // block, span // block + 1
    padded = (
        np.pad(levels, reach, mode='reflect')
        if len(levels) > reach
        else np.pad(levels, reach, mode='edge')
    )
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    others = np.abs(np.arange(-reach, reach + 1)) > own
    usual = np.quantile(around[:, others], 0.75, axis=1)
    centres = (np.arange(len(levels)) + 0.5) * len(distance) / len(levels)
    return np.interp(np.arange(len(distance)), centres, usual)
