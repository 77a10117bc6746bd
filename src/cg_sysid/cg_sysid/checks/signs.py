"""Checks of signs: which channels have to be turned for all of them to agree.

Some pairs of channels tell whether they have the same sign, with no model of the robot: the IMU's
rate is the derivative of its angle, a torque drives its joint up, and while the outer legs are
fixed the hip encoder and the IMU measure one angle. A model, if there is one, tells about all
angles and torques together, but for the mirror image of everything. The fewest sensors with which
turned all of this is satisfied have the wrong sign; where several sets are as small, the recording
leaves it open which one it is.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import combinations

import casadi as ca
import numpy as np

from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.model import Model
from cg_sysid.checks.dynamics import drives
from cg_sysid.checks.kinematics import agreement_of_imu
from cg_sysid.checks.law import Motion, fit_law, motion_of
from cg_sysid.checks.signals import Signal
from cg_sysid.identification.data_set import sensor_matrix
from cg_sysid.records.findings import Finding
from cg_sysid.records.raw import RawRecording

CERTAIN = 8.0  # factor of a torque over its standard error, [1]
SHARE = 0.05  # a torque that does less of the acceleration than this has no sign to tell, [1]
CORRELATED = 0.7  # of the IMU's angle and rate, [1]
ONE_ANGLE = 0.9  # correlation of two sensors of one angle, [1]
BETTER = 0.5  # what a mirrored channel leaves over what any other choice leaves, [1]
POOR = 0.1  # share of the accelerations up to which the model is right as it is, [1]
MOVING = 0.02  # spread of a coordinate in rad from which its acceleration says anything


@dataclass(frozen=True)
class Relation:
    """What a recording says about the signs of some channels.

    Attributes:
        channels: The channels.
        turned: Which of them have to be turned, all others of them not; or just the others.
        text: Why.
    """

    channels: tuple[str, ...]
    turned: frozenset[str]
    text: str

    def satisfied(self, turned: frozenset[str]) -> bool:
        """Whether turning those channels does it."""
        mine = turned & set(self.channels)
        return mine in (self.turned, set(self.channels) - self.turned)


def check_signs(
    raw: RawRecording, signals: Mapping[str, Signal], model: Model | None = None
) -> Iterator[Finding]:
    """Channels that have the wrong sign throughout.

    Args:
        raw: The recording, its clocks mended.
        signals: Its channels, without those that are known to be broken.
        model: Nominal model of the machine.
    """
    relations = list(_relations(raw, signals))
    if model is not None:
        relations += _by_model(raw, signals, model)
    known = sorted({channel for relation in relations for channel in relation.channels})
    sets = [
        frozenset(chosen)
        for size in range(len(known) + 1)
        for chosen in combinations(known, size)
        if all(relation.satisfied(frozenset(chosen)) for relation in relations)
    ]
    if not sets:
        return

    def effort(chosen: frozenset[str]) -> tuple[int, int]:
        # A sensor that is mounted the wrong way round turns all its channels.
        return len({signals[channel].topic for channel in chosen}), len(chosen)

    least = min(effort(chosen) for chosen in sets)
    sets = [chosen for chosen in sets if effort(chosen) == least]
    why = '; '.join(r.text for r in relations if not r.satisfied(frozenset()))
    for channel in sorted(frozenset().union(*sets)):
        others = sorted({' and '.join(sorted(s)) for s in sets if channel not in s})
        also = f', or {" or ".join(others)} in its place' if others else ''
        yield Finding('sign_error', 'error', channel, f'has the wrong sign{also}: {why}')


def _relations(raw: RawRecording, signals: Mapping[str, Signal]) -> Iterator[Relation]:
    """Pairs of channels that tell whether they have the same sign."""
    angle, rate, hip = 'imu_angle', 'imu_rate', 'hip_angle'
    agreement = agreement_of_imu(signals)
    if abs(agreement) > CORRELATED:
        yield _pair(
            angle,
            rate,
            agreement > 0,
            f'imu_rate is the derivative of imu_angle, and their correlation is {agreement:.2f}',
        )
    known = raw.mechanism
    motion = _motion(raw, signals)
    if motion is None:
        return
    joints = [(torque, known.position_of(torque)) for torque in known.input_names]
    if raw.setup.fixture == 'outer_fixed' and {angle, hip} <= set(motion.angle):
        same = float(np.corrcoef(motion.angle[angle], motion.angle[hip])[0, 1])
        if abs(same) > ONE_ANGLE:
            yield _pair(
                angle,
                hip,
                same > 0,
                'imu_angle and hip_angle are one angle while the '
                f'outer legs are fixed, and their correlation is {same:.2f}',
            )
        joints += [(torque, angle) for torque in known.input_names]
    for torque, joint in joints:
        if joint not in motion.angle or not drives(signals, torque):
            continue
        law = fit_law(motion, torque, joint)
        if abs(law.factor) > CERTAIN * law.error and law.share > SHARE:
            yield _pair(
                torque,
                joint,
                law.factor > 0,
                f'{torque} drives {joint} up, and '
                f'accelerates it by {law.factor:.3g} {signals[joint].unit}/s^2 per '
                f'{signals[torque].unit}',
            )


def _pair(first: str, second: str, same: bool, text: str) -> Relation:
    return Relation((first, second), frozenset() if same else frozenset({first}), text)


def _motion(raw: RawRecording, signals: Mapping[str, Signal]) -> Motion | None:
    known = raw.mechanism
    return motion_of(
        {n: signals[n] for n in (*known.input_names, *known.output_names) if n in signals}
    )


def _by_model(
    raw: RawRecording, signals: Mapping[str, Signal], model: Model
) -> Iterator[Relation]:
    """The one choice of signs with which a model explains the motion far better than others.

    Numbers that are 20 % off, or an effect that the model lacks, leave some of the accelerations
    unexplained; a wrong sign leaves more than all of them.
    """
    motion = _motion(raw, signals)
    if motion is None or raw.setup.fixture != 'none' or len(motion.angle) < 2:
        return  # one free coordinate looks the same when angle and torque are mirrored
    channels = (*motion.angle, *motion.torque)
    if not {*model.mechanism.inputs} <= set(motion.torque):
        return
    robot = _Equations(raw, model)
    left = {
        turned: robot.unexplained(motion.mirrored(turned))
        for turned in ((), *((channel,) for channel in channels))
    }
    best, second = sorted(left, key=lambda turned: left[turned])[:2]
    as_is = left[()]
    if left[best] > BETTER * left[second] or (best and as_is < POOR):
        return
    what = f'with {best[0]} turned' if best else 'as it is'
    yield Relation(
        channels,
        frozenset(best),
        f'the model leaves {left[best]:.0%} of the '
        f'accelerations {what}, and {left[second if not best else ()]:.0%} otherwise',
    )


class _Equations:
    """A model's accelerations in the set-up of a recording."""

    def __init__(self, raw: RawRecording, model: Model):
        e = assemble(model, raw.setup)
        self._m, self._inputs = e.coordinates, model.mechanism.inputs
        self._channels = model.mechanism.outputs
        self._sensors = sensor_matrix(model.mechanism, raw.setup)[:, : self._m]
        self._parameters = parameter_vector(model, raw.setup)
        self._shape = (e.x.numel(), e.u.numel())
        self._accelerations = ca.Function('a', [e.x, e.u, e.p], [e.rates[self._m : 2 * self._m]])

    def unexplained(self, motion: Motion) -> float:
        """Share of the accelerations that the model leaves, mean over moving coordinates."""
        names = [channel for channel in self._channels if channel in motion.angle]
        solve = np.linalg.pinv(self._sensors[[self._channels.index(name) for name in names]])
        angle, rate, wanted = (
            solve @ np.array([part[name] for name in names])
            for part in (motion.angle, motion.rate, motion.acceleration)
        )
        m, count = self._m, len(motion.time)
        x, u = np.zeros((self._shape[0], count)), np.ones((self._shape[1], count))
        x[:m], x[m : 2 * m] = angle, rate
        u[: len(self._inputs)] = np.array([motion.torque[name] for name in self._inputs])
        p = np.tile(self._parameters[:, None], count)
        found = np.asarray(self._accelerations.map(count)(x, u, p))
        moving = np.std(angle, axis=1) > MOVING
        shares = np.sum((wanted - found) ** 2, axis=1) / np.sum(wanted**2, axis=1)
        return float(np.mean(shares[moving])) if moving.any() else 0.0
