"""The law of motion that a recording itself shows, with no model of the robot.

Whatever the robot is, the acceleration of a joint follows from its torque, the angles and the
rates. That relation is fitted as

    d2(angle)/dt2 = a torque + b . (1, sin angle, sin 2 angle, cos angle, rate, sign of the rate)

with the angles and rates of every joint. Where bodies hang on each other (`coupled`) sums and
differences of angles, torques through cos and sin of an angle and products of rates come in too.
Derivatives of noisy samples are never taken: both sides
are averaged with a smooth weight of compact support, and integration by parts moves the
derivatives to the weight (weak form). The torque's factor a is an inverse inertia and so positive
whatever the robot, and the law is the same from the first second to the last.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial import Polynomial

from cg_sysid.checks.signals import Signal

HALF_WIDTH_S = 0.08  # of the weight, in s: accelerations up to some 5 Hz
LEAST_HALF_WIDTH = 8  # samples
WEIGHT = Polynomial([1.0, 0.0, -1.0]) ** 4  # (1 - s^2)^4 on -1..1: three smooth derivatives
SLIDING = (0.03, 0.3)  # of the usual rate, at which friction has its full size, [1]
MOVES = 10.0  # an angle that moves over this many noise floors belongs to the law, [1]
FEWEST_FOR_LAW = 60  # averages that a law needs
NEGLIGIBLE = 1e-7  # singular values below this share are dropped, [1]


@dataclass(frozen=True)
class Motion:
    """Weighted averages along a recording, all of shape (m,), half a weight apart.

    Attributes:
        time: Centres of the averages in s.
        torque: Torque channel -> average in N m.
        angle: Angle channel -> average in rad.
        rate: Angle channel -> average rate in rad/s.
        acceleration: Angle channel -> average acceleration in rad/s^2.
        half_width: Half the length of an average in s.
        coupled: Whether joints carry each other, so that the law of one needs those of all.
    """

    time: np.ndarray
    torque: Mapping[str, np.ndarray]
    angle: Mapping[str, np.ndarray]
    rate: Mapping[str, np.ndarray]
    acceleration: Mapping[str, np.ndarray]
    half_width: float
    coupled: bool = False

    def mirrored(self, channels: tuple[str, ...], since: float = -np.inf) -> 'Motion':
        """The same with the opposite sign of some channels from an instant on."""
        sign = np.where(self.time > since, -1.0, 1.0)

        def turned(signals: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
            return {c: v * sign if c in channels else v for c, v in signals.items()}

        return replace(
            self,
            torque=turned(self.torque),
            angle=turned(self.angle),
            rate=turned(self.rate),
            acceleration=turned(self.acceleration),
        )

    def away_from(self, instant: float) -> np.ndarray:
        """Which averages do not reach over an instant, shape (m,)."""
        return np.abs(self.time - instant) > self.half_width


@dataclass(frozen=True)
class Law:
    """The fitted law of one joint.

    Attributes:
        factor: Of the torque, in rad/s^2 per N m.
        error: Standard error of the factor.
        extra: Factors of further terms, shape (k,).
        extra_error: Their standard errors, shape (k,).
        unexplained: Share of the acceleration's variance that the law leaves, [1].
        share: Size of what the torque does that no other term could do, over that of the
            acceleration, [1].
        rest: What the law leaves of the acceleration in rad/s^2, one for each average used.
        wanted: That acceleration.
    """

    factor: float
    error: float
    extra: np.ndarray
    extra_error: np.ndarray
    unexplained: float
    share: float
    rest: np.ndarray
    wanted: np.ndarray


def motion_of(signals: Mapping[str, Signal], coupled: bool = False) -> Motion | None:
    """Averages of torques and moving angles; None where there is nothing to tell.

    Args:
        signals: Channel -> samples.
        coupled: As of `Motion`.
    """
    moving = {
        name: s
        for name, s in signals.items()
        if s.is_position and np.std(s.values) > MOVES * max(s.noise.sigma_floor, 1e-9)
    }
    torques = {name: s for name, s in signals.items() if s.is_torque}
    every = [*moving.values(), *torques.values()]
    if not moving or not any(np.ptp(s.values) > 0 for s in torques.values()):
        return None
    start, stop = max(s.time[0] for s in every), min(s.time[-1] for s in every)
    spacing = max(float(np.median(np.diff(s.time))) for s in moving.values())
    reach = max(LEAST_HALF_WIDTH, round(HALF_WIDTH_S / spacing))
    if (stop - start) / (0.5 * reach * spacing) < FEWEST_FOR_LAW:
        return None
    grid = np.arange(start, stop, spacing)
    weights = [_weight(reach, spacing, order) for order in range(3)]
    stride = max(1, reach // 2)

    def average(values: np.ndarray, order: int) -> np.ndarray:
        return np.correlate(values, weights[order], 'valid')[::stride] * (-1) ** order

    sampled = {name: np.interp(grid, s.time, s.values) for name, s in moving.items()}
    return Motion(
        time=grid[reach:-reach][::stride],
        torque={n: average(np.interp(grid, s.time, s.values), 0) for n, s in torques.items()},
        angle={n: average(v, 0) for n, v in sampled.items()},
        rate={n: average(v, 1) for n, v in sampled.items()},
        acceleration={n: average(v, 2) for n, v in sampled.items()},
        half_width=reach * spacing,
        coupled=coupled and len(moving) > 1,
    )


def _weight(reach: int, spacing: float, order: int) -> np.ndarray:
    """The derivative of the weight of that order, shape (2 reach + 1,)."""
    s = np.arange(-reach, reach + 1) / reach
    return WEIGHT.deriv(order)(s) / (reach * spacing) ** order / WEIGHT(s).sum()


def fit_law(
    motion: Motion,
    torque: str,
    angle: str,
    extra: tuple[np.ndarray, ...] = (),
    rows: np.ndarray | None = None,
) -> Law:
    """The law of one angle.

    Args:
        motion: Averages.
        torque: The torque whose factor is wanted.
        angle: The angle whose acceleration is explained.
        extra: Further terms, each of shape (m,).
        rows: Which averages to use, shape (m,); all by default.
    """
    rows = np.ones(len(motion.time), bool) if rows is None else rows
    columns = [motion.torque[torque], *extra, np.ones(len(motion.time))]
    columns += [v for name, v in motion.torque.items() if name != torque]
    for name in _distinct(motion):
        value, rate = motion.angle[name], motion.rate[name]
        usual = max(float(np.sqrt(np.mean(rate**2))), 1e-12)
        columns += [np.sin(value), np.sin(2 * value), np.cos(value), rate]
        columns += [np.tanh(rate / (share * usual)) for share in SLIDING]
    if motion.coupled:
        columns += _couplings(motion)
    design = np.column_stack(columns)[rows]
    size = np.maximum(np.linalg.norm(design, axis=0), 1e-300)
    inverse = np.linalg.pinv(design / size, rcond=NEGLIGIBLE)
    wanted = motion.acceleration[angle][rows]
    solution = inverse @ wanted
    rest = wanted - design @ (solution / size)
    freedom = max(1, len(wanted) - design.shape[1])
    errors = np.linalg.norm(rest) / np.sqrt(freedom) * np.linalg.norm(inverse, axis=1) / size
    own, others = design[:, 0], design[:, 1 + len(extra) :]
    alone = own - others @ (
        np.linalg.pinv(others / size[1 + len(extra) :], rcond=NEGLIGIBLE)
        @ own
        / size[1 + len(extra) :]
    )
    k = 1 + len(extra)
    return Law(
        factor=float(solution[0] / size[0]),
        error=float(errors[0]),
        extra=solution[1:k] / size[1:k],
        extra_error=errors[1:k],
        unexplained=float(rest @ rest / max(wanted @ wanted, 1e-300)),
        share=float(
            abs(solution[0] / size[0])
            * np.linalg.norm(alone)
            / max(np.linalg.norm(wanted), 1e-300)
        ),
        rest=rest,
        wanted=wanted,
    )


def _couplings(motion: Motion) -> list[np.ndarray]:
    """What joints that carry each other do to one another, to second order in rates."""
    names = _distinct(motion)
    waves = [f(motion.angle[name]) for name in names for f in (np.cos, np.sin)]
    columns = [wave * torque for wave in waves for torque in motion.torque.values()]
    for k, a in enumerate(names):
        for b in names[k:]:
            rates = motion.rate[a] * motion.rate[b]
            columns += [wave * rates for wave in (1.0, *waves)]
            if b != a:
                both = motion.angle[a] + motion.angle[b], motion.angle[a] - motion.angle[b]
                columns += [f(angle) for angle in both for f in (np.sin, np.cos)]
    return columns


def _distinct(motion: Motion) -> list[str]:
    """Angles that are not one and the same, as hip and IMU are while the outer legs are fixed."""
    names: list[str] = []
    for name, value in motion.angle.items():
        copies = (
            min(np.std(value - motion.angle[n]), np.std(value + motion.angle[n])) for n in names
        )
        if all(rest > 0.01 * np.std(value) for rest in copies):
            names.append(name)
    return names
