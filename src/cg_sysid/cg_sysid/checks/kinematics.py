"""Checks of the IMU against itself: its rate must be the derivative of its angle.

This is kinematics; no model of the robot is needed. Signs are compared in check_signs.py.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from cg_sysid.checks.sampling import timing_errors
from cg_sysid.checks.signals import Signal
from cg_sysid.records.findings import Finding
from cg_sysid.records.jumps import find_step, zero_known_to

WINDOW_S = 0.1  # angles are compared with integrated rates over spans of this length, in s
BIAS_WINDOW_S = 0.25  # and over spans of this length where the zero of the rate is in question
SCALE_TOLERANCE = 0.2  # of the rate against the derivative of the angle, [1]
SCALE_CHANGE = 1.3  # ratio of that scale before and after that only wrong stamps make, [1]
CORRELATED = 0.7  # below this correlation nothing is said about sign and scale, [1]
DEGREES = 180.0 / np.pi
UNIT_TOLERANCE = 0.15  # how close a scale must be to 57.3 to be called degrees, [1]
STUCK_S = 0.1  # shortest span in which an angle that does not follow its rate is looked at, in s
SIDE = 5  # fewest spans before and after a change of scale
BIAS_SIDE = 2  # and before and after one of the rate's zero
FREEDOM = 6  # fewest spans beyond those that the fit of a shift uses up
SHIFTED = 8.0  # standard errors of a shift of the rate's zero, [1]
FASTEST = 0.95  # quantile of the rates that errors of timing are taken at
REST_SPANS = (12, 25, 50, 100)  # the angle less the integrated rate is smooth over longer spans


@dataclass(frozen=True)
class Imu:
    """Angle and rate of an IMU at common times.

    Attributes:
        angle: Channel of the angle.
        rate: Channel of the rate.
        time: Common times in s, shape (M,).
        values: Angle in rad, shape (M,).
        speed: Rate in rad/s, shape (M,).
        integral: Integral of the rate in rad, shape (M,).
        sample: Index of each sample within the topic of the angle, shape (M,).
    """

    angle: Signal
    rate: Signal
    time: np.ndarray
    values: np.ndarray
    speed: np.ndarray
    integral: np.ndarray
    sample: np.ndarray

    def steps(self, length_s: float) -> int:
        """Samples in a span of that length."""
        return max(2, round(length_s / float(np.median(np.diff(self.time)))))

    @property
    def noise(self) -> float:
        """Noise of the difference of two angles in rad."""
        return float(np.sqrt(2.0) * self.angle.noise.sigma_floor)


def check_kinematics(signals: dict[str, Signal]) -> Iterator[Finding]:
    """Findings about the IMU's angle against its rate."""
    imu = _read(signals)
    if imu is None:
        return
    turned, integrated, span = _turned(imu)
    moves = _moves(imu, turned, integrated)
    scale = 1.0
    if moves:
        change = _change_of_scale(imu, turned, integrated, span)
        if change is not None:
            yield change
            return
        correlation = float(np.corrcoef(turned, integrated)[0, 1])
        if correlation < -CORRELATED:
            return  # one of the two has the wrong sign: check_signs.py
        if correlation > CORRELATED:
            scale = 1.0 / _slope(integrated, turned)
            yield from _scale(scale)
        else:
            yield Finding(
                'rate_mismatch',
                'warning',
                'imu_rate',
                f'the rate is not the derivative of imu_angle (correlation {correlation:.2f})',
                value=correlation,
                allowed=CORRELATED,
            )
            moves = False
    stuck = list(
        _stuck(imu.angle, imu.time, imu.values, integrated / scale, turned, span, imu.noise)
    )
    yield from stuck
    if not stuck:
        shifts = list(_shift_of_rate(imu, moves))
        yield from shifts or _shift_of_angle(imu, imu.integral / scale)


def agreement_of_imu(signals: Mapping[str, Signal]) -> float:
    """Correlation of the IMU's angle with its integrated rate; 0 where there is none to tell."""
    imu = _read(signals)
    if imu is None:
        return 0.0
    turned, integrated, _ = _turned(imu)
    if not _moves(imu, turned, integrated):
        return 0.0
    return float(np.corrcoef(turned, integrated)[0, 1])


def _read(signals: Mapping[str, Signal]) -> Imu | None:
    if 'imu_angle' not in signals or 'imu_rate' not in signals:
        return None
    angle, rate = signals['imu_angle'], signals['imu_rate']
    time, at_angle, at_rate = np.intersect1d(angle.time, rate.time, return_indices=True)
    if len(time) < 50:
        return None
    speed = rate.values[at_rate]
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * np.diff(time))])
    imu = Imu(angle, rate, time, angle.values[at_angle], speed, integral, angle.sample[at_angle])
    return imu if len(time) >= 4 * imu.steps(WINDOW_S) else None


def _turned(imu: Imu) -> tuple[np.ndarray, np.ndarray, int]:
    """How far the angle turns over each span, and by its rate, in rad; samples in a span."""
    span = imu.steps(WINDOW_S)
    return (
        imu.values[span:] - imu.values[:-span],
        imu.integral[span:] - imu.integral[:-span],
        span,
    )


def _moves(imu: Imu, turned: np.ndarray, integrated: np.ndarray) -> bool:
    return bool(np.std(integrated) > 5.0 * imu.noise and np.std(turned) > 2.0 * imu.noise)


def _slope(x: np.ndarray, y: np.ndarray) -> float:
    """Slope of y over x, both about their means."""
    x = x - x.mean()
    return float(x @ (y - y.mean()) / (x @ x))


def _change_of_scale(
    imu: Imu, turned: np.ndarray, integrated: np.ndarray, span: int
) -> Finding | None:
    """An angle that follows its rate by one factor first and by another one later."""
    first, last = turned[::span], integrated[::span]
    count, best = len(first), None
    for k in range(SIDE, count - SIDE):
        parts = [(last[:k], first[:k]), (last[k:], first[k:])]
        if any(np.std(x) < 5.0 * imu.noise or np.std(y) < 2.0 * imu.noise for x, y in parts):
            continue
        slopes = [_slope(x, y) for x, y in parts]
        rest = sum(
            float(np.sum((y - s * x) ** 2)) for s, (x, y) in zip(slopes, parts, strict=True)
        )
        if best is None or rest < best[0]:
            best = (rest, k, slopes, [float(np.corrcoef(x, y)[0, 1]) for x, y in parts])
    if best is None or min(abs(c) for c in best[3]) < CORRELATED:
        return None
    _, k, (before, after), _ = best
    at = float(imu.time[k * span])
    if before * after < 0:
        # The channel that changed its sign is the one that jumps to its mirror image, or both.
        return Finding(
            'sign_error',
            'error',
            'imu_rate' if after < 0 else 'imu_angle',
            'imu_rate is the derivative of imu_angle in one part of the recording, and '
            'its negative in the other',
            at,
            float(imu.time[-1]),
            int(imu.sample[k * span]),
            after,
            before,
        )
    ratio = after / before
    if 1.0 / SCALE_CHANGE < ratio < SCALE_CHANGE:
        return None
    return Finding(
        'sampling_rate_change',
        'error',
        imu.angle.topic,
        f'from here on the angle turns {ratio:.2f} times as far as its rate says, as '
        'it did not before: the stamps are wrong',
        at,
        float(imu.time[-1]),
        int(imu.sample[k * span]),
        ratio,
        1.0,
    )


def _scale(scale: float) -> Iterator[Finding]:
    if abs(scale - 1.0) <= SCALE_TOLERANCE:
        return
    for factor, what in ((DEGREES, 'the rate is in deg/s'), (1 / DEGREES, 'the angle is in deg')):
        if abs(scale / factor - 1.0) < UNIT_TOLERANCE:
            yield Finding(
                'unit',
                'error',
                'imu_rate',
                f'imu_rate is {scale:.3g} times the derivative of imu_angle: {what}',
                value=scale,
                allowed=1.0,
            )
            return
    yield Finding(
        'scale',
        'warning',
        'imu_rate',
        f'imu_rate is {scale:.3g} times the derivative of imu_angle',
        value=scale,
        allowed=1.0,
    )


def _shift_of_angle(imu: Imu, integral: np.ndarray) -> Iterator[Finding]:
    """A step of the angle that the rate does not know of."""
    noise = imu.angle.noise
    if find_step(imu.angle.time, imu.angle.values, noise.sigma, noise.quantum):
        return  # large enough to be found without the rate
    # Where instants of sampling are off, the angle is, by that times the rate.
    late = timing_errors({s.channel: s for s in (imu.angle, imu.rate)})
    sigma = noise.sigma
    if late:
        sigma = float(
            np.hypot(sigma, late[imu.angle.topic].sigma * np.quantile(np.abs(imu.speed), FASTEST))
        )
    step = find_step(imu.time, imu.values - integral, sigma, noise.quantum, REST_SPANS)
    if step:
        grave = abs(step.size) >= zero_known_to(imu.values, imu.angle.unit)
        yield Finding(
            'zero_shift',
            'error' if grave else 'warning',
            imu.angle.channel,
            f'jumps by {step.size:.4g} rad while imu_rate shows no such motion',
            float(imu.time[step.sample - 1]),
            step.time,
            int(imu.sample[step.sample]),
            step.size,
            step.limit,
        )


def _shift_of_rate(imu: Imu, moves: bool) -> Iterator[Finding]:
    """A zero of the rate that moves: the angle turns by a constant less from then on."""
    span = imu.steps(BIAS_WINDOW_S)
    count = len(imu.time) // span
    means = np.array(
        [
            signal[: count * span].reshape(count, span).mean(axis=1)
            for signal in (imu.time, imu.values, imu.integral, imu.speed)
        ]
    )
    elapsed, turned, integrated, faster = np.diff(means, axis=1)
    at = span * np.arange(1, count)  # where one span ends and the next begins
    excess = (integrated - turned) / elapsed
    columns = [np.ones(len(at)), np.linspace(-1.0, 1.0, len(at))]
    if moves:  # a wrong scale, and a delay between angle and rate
        columns += [integrated / elapsed, faster / elapsed]
    if len(at) < len(columns) + 3 + FREEDOM:
        return
    best = (0.0, 0.0, 0)
    for k in range(BIAS_SIDE + 2, len(at) - BIAS_SIDE + 1):
        # The span in which it moves counts for neither side, in both differences that it is in.
        moving = np.eye(len(at))[k - 2 : k]
        design = np.column_stack([*columns, *moving, np.arange(len(at)) >= k])
        inverse = np.linalg.pinv(design)
        solution = inverse @ excess
        rest = excess - design @ solution
        spread = np.linalg.norm(rest) / np.sqrt(max(1, len(at) - design.shape[1]))
        error = spread * np.linalg.norm(inverse[-1])
        if abs(solution[-1]) > best[0] * error:
            best = (abs(solution[-1]) / max(error, 1e-300), float(solution[-1]), k)
    score, size, k = best
    if score < SHIFTED:
        return
    k = _bend(imu, int(at[k - 1]), span)
    grave = abs(size) > imu.rate.noise.sigma_floor
    yield Finding(
        'zero_shift',
        'error' if grave else 'warning',
        imu.rate.channel,
        f'changes by {size:.3g} rad/s against the derivative of imu_angle, and stays so',
        float(imu.time[k]),
        float(imu.time[k]),
        int(imu.sample[k]),
        size,
        SHIFTED * abs(size) / score,
    )


def _bend(imu: Imu, k: int, span: int) -> int:
    """Sample near k where the integrated rate leaves the angle along another line."""
    near = slice(max(0, k - 2 * span), min(len(imu.time), k + 2 * span))
    time, rest = imu.time[near] - imu.time[k], (imu.integral - imu.values)[near]
    candidates = np.arange(span // 4, len(time) - span // 4, max(1, span // 50))
    best = (np.inf, k)
    for i in candidates:
        design = np.column_stack([np.ones(len(time)), time, np.maximum(time - time[i], 0.0)])
        left = rest - design @ np.linalg.lstsq(design, rest, rcond=None)[0]
        best = min(best, (float(left @ left), near.start + int(i)))
    return best[1]


def _stuck(
    angle: Signal,
    time: np.ndarray,
    values: np.ndarray,
    integrated: np.ndarray,
    turned: np.ndarray,
    span: int,
    noise: float,
) -> Iterator[Finding]:
    """An angle that stays exactly where it is while the rate says that the body turns."""
    usual = float(np.std(integrated))
    limit = max(10.0 * noise, 4.0 * angle.noise.quantum, 0.3 * usual)
    still = (turned == 0.0) & (np.abs(integrated) > limit)
    # One exact zero over a span can be chance: every sample in between must agree.
    constant = np.lib.stride_tricks.sliding_window_view(values, span + 1)
    still &= np.ptp(constant, axis=1) == 0.0
    hits = np.flatnonzero(still)
    if len(hits) and time[hits[-1] + span] - time[hits[0]] >= STUCK_S:
        yield Finding(
            'stuck',
            'error',
            angle.channel,
            'does not change while imu_rate says that the body turns',
            float(time[hits[0]]),
            float(time[hits[-1] + span]),
            int(angle.sample[hits[0]]),
            float(np.abs(integrated[hits]).max()),
            limit,
        )
