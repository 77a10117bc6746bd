"""Checks of the IMU against itself: its rate must be the derivative of its angle.

This is kinematics; no model of the robot is needed. Whether an encoder or a torque has the
wrong sign is not decidable this way, and is left to the diagnosis.
"""

from collections.abc import Iterator

import numpy as np

from cg_sysid.check_signals import SHIFT, Signal, largest_step
from cg_sysid.findings import Finding

WINDOW_S = 0.1  # angles are compared with integrated rates over spans of this length, in s
SCALE_TOLERANCE = 0.2  # of the rate against the derivative of the angle, [1]
CORRELATED = 0.7  # below this correlation nothing is said about sign and scale, [1]
DEGREES = 180.0 / np.pi
UNIT_TOLERANCE = 0.15  # how close a scale must be to 57.3 to be called degrees, [1]
STUCK_S = 0.1  # shortest span in which an angle that does not follow its rate is looked at, in s


def check_kinematics(signals: dict[str, Signal]) -> Iterator[Finding]:
    """Findings about the IMU's angle against its rate."""
    if 'imu_angle' not in signals or 'imu_rate' not in signals:
        return
    angle, rate = signals['imu_angle'], signals['imu_rate']
    time, at_angle, at_rate = np.intersect1d(angle.time, rate.time, return_indices=True)
    if len(time) < 50:
        return
    values = angle.values[at_angle]
    speed = rate.values[at_rate]
    dt = np.diff(time)
    integral = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]) * dt)])
    span = max(2, round(WINDOW_S / float(np.median(dt))))
    if len(time) < 4 * span:
        return
    turned, integrated = values[span:] - values[:-span], integral[span:] - integral[:-span]
    moved = float(np.std(integrated))
    noise = np.sqrt(2.0) * angle.noise.sigma_floor
    if moved < 5.0 * noise or np.std(turned) < 2.0 * noise:
        yield from _stuck(angle, time, values, integrated, turned, span, noise)
        return
    correlation = float(np.corrcoef(turned, integrated)[0, 1])
    centred = integrated - integrated.mean()
    scale = float(np.sum(centred * centred) / np.sum(centred * (turned - turned.mean())))
    if correlation < -CORRELATED:
        yield Finding('sign', 'error', 'imu_rate',
                      f'the rate has the opposite sign of the derivative of imu_angle '
                      f'(correlation {correlation:.2f})', value=correlation, allowed=1.0)
        return
    if correlation < CORRELATED:
        yield from _stuck(angle, time, values, integrated, turned, span, noise)
        yield Finding('rate_mismatch', 'warning', 'imu_rate',
                      f'the rate is not the derivative of imu_angle (correlation '
                      f'{correlation:.2f})', value=correlation, allowed=CORRELATED)
        return
    yield from _scale(scale)
    yield from _stuck(angle, time, values, integrated / scale, turned, span, noise)
    yield from _shift(angle, time, values, integral / scale, at_angle)


def _scale(scale: float) -> Iterator[Finding]:
    if abs(scale - 1.0) <= SCALE_TOLERANCE:
        return
    for factor, what in ((DEGREES, 'the rate is in deg/s'), (1 / DEGREES, 'the angle is in deg')):
        if abs(scale / factor - 1.0) < UNIT_TOLERANCE:
            yield Finding('unit', 'error', 'imu_rate', f'imu_rate is {scale:.3g} times the '
                          f'derivative of imu_angle: {what}', value=scale, allowed=1.0)
            return
    yield Finding('scale', 'warning', 'imu_rate',
                  f'imu_rate is {scale:.3g} times the derivative of imu_angle', value=scale,
                  allowed=1.0)


def _stuck(
    angle: Signal, time: np.ndarray, values: np.ndarray, integrated: np.ndarray,
    turned: np.ndarray, span: int, noise: float,
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
        yield Finding('stuck', 'error', angle.channel,
                      'does not change while imu_rate says that the body turns',
                      float(time[hits[0]]), float(time[hits[-1] + span]),
                      int(angle.sample[hits[0]]), float(np.abs(integrated[hits]).max()), limit)


def _shift(
    angle: Signal, time: np.ndarray, values: np.ndarray, integral: np.ndarray,
    at_angle: np.ndarray,
) -> Iterator[Finding]:
    """A step of the angle that the rate does not know of."""
    rest = values - integral
    k, size = largest_step(time, rest, angle.step_floor, angle.noise.quantum)
    if k < 0 or largest_step(time, values, angle.step_floor, angle.noise.quantum)[0] >= 0:
        return  # none, or one that is large enough to be found without the rate
    yield Finding('zero_shift', 'error', angle.channel,
                  f'jumps by {size:.4g} rad while imu_rate shows no such motion',
                  float(time[k - 1]), float(time[k]), int(angle.sample[at_angle[k]]), size,
                  SHIFT * angle.step_floor)
