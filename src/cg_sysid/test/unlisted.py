"""Laws that no library has, and machines that have them.

Each is a small class; what is true of it is what the class computes.
"""

import math
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from cg_dynamics.effects.effect import TIME, Effect, reading_rate
from cg_dynamics.rig import Setup, Spring
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse

SAMPLE = 0.004
DURATION = 6.0
PITCH = 0.21  # rad, of the detent
TOOTH = 0.15  # rad
HERTZ = 3.7


class DetentTorque(Effect):
    """Magnets that pull the hip to one of many angles, hard and only nearby."""

    name, place, parameters = 'hidden_detent', 'joint', ()

    def acts(self, values):
        return True

    @staticmethod
    def function(s):
        n = 2 * np.pi / PITCH
        return -1.14 * np.sin(n * s) * np.exp(3 * (np.cos(n * s) - 1))

    def joint_torque(self, angle, rate, load, z, p):
        n = 2 * math.pi / PITCH
        return -1.14 * ca.sin(n * angle) * ca.exp(3 * (ca.cos(n * angle) - 1)), []


class SoftStop(DetentTorque):
    """A rubber block that the hip runs into at 0.15 rad."""

    name = 'hidden_stop'

    @staticmethod
    def function(s):
        x = s - 0.15
        return -10 * (x + np.sqrt(x**2 + 0.02**2)) / 2

    def joint_torque(self, angle, rate, load, z, p):
        x = angle - 0.15
        return -10 * (x + ca.sqrt(x**2 + 0.02**2)) / 2, []


class Pulsation(DetentTorque):
    """A torque that pulsates with the clock."""

    name, extra_inputs = 'hidden_pulsation', (TIME,)

    @staticmethod
    def function(s):
        return 0.6 * np.sin(2 * np.pi * HERTZ * s + 0.4)

    def joint_torque(self, angle, rate, load, z, p):
        return 0.6 * ca.sin(2 * math.pi * HERTZ * p[TIME] + 0.4), []


class BentImu(DetentTorque):
    """A lean angle that is off by a fifth of its square."""

    name, place = 'hidden_imu_error', 'sensor'

    @staticmethod
    def function(s):
        return 0.2 * s**2

    def joint_torque(self, angle, rate, load, z, p):
        return ca.SX(0), []

    def read(self, outputs, z, p):
        angle = outputs['imu_angle']
        return {**outputs, 'imu_angle': angle + 0.2 * angle**2}, []


class SaturatingGyro(BentImu):
    """A gyro that reports ever less of a fast rate."""

    name = 'hidden_gyro_error'

    @staticmethod
    def function(s):
        return 2 * np.tanh(s / 2) - s

    def read(self, outputs, z, p):
        return {**outputs, 'imu_rate': 2 * ca.tanh(outputs['imu_rate'] / 2)}, []


class CrossFriction(DetentTorque):
    """A cable that rubs at the hip the more, the further the outer legs lean."""

    name = 'hidden_cross_friction'

    @staticmethod
    def function(s):
        return 12 * s**2

    def joint_torque(self, angle, rate, load, z, p):
        return ca.SX(0), []

    def force(self, body, z, p):
        rate = body.v[0] - body.v[1]
        torque = -12 * body.q[1] ** 2 * ca.tanh(rate / 0.01)
        return ca.vertcat(torque, -torque), []


class FadingMotor(DetentTorque):
    """A motor that warms up and pulls a quarter less."""

    name, place, extra_inputs = 'hidden_fading', 'command', (TIME,)

    @staticmethod
    def function(s):
        return -0.25 * (1 - np.exp(-s / 2))

    def joint_torque(self, angle, rate, load, z, p):
        return ca.SX(0), []

    def deliver(self, torque, z, p):
        return torque * (1 - 0.25 * (1 - ca.exp(-p[TIME] / 2))), []


class TorsionSpring(DetentTorque):
    """A cable loom across the hip that is stiff."""

    name = 'hidden_torsion_spring'

    @staticmethod
    def function(s):
        return -5.0 * s

    def joint_torque(self, angle, rate, load, z, p):
        return -5.0 * angle, []


class TiltedGyro(BentImu):
    """A gyro that gravity pulls at."""

    name = 'hidden_gravity_in_gyro'

    @staticmethod
    def function(s):
        return 0.15 * np.sin(s)

    def read(self, outputs, z, p):
        pulled = outputs['imu_rate'] + 0.15 * ca.sin(outputs['imu_angle'])
        return {**outputs, 'imu_rate': pulled}, []


class StiffeningSpring(DetentTorque):
    """A rubber band across the hip that hardly pulls at first."""

    name = 'hidden_stiffening_spring'

    @staticmethod
    def function(s):
        return -60.0 * s**3

    def joint_torque(self, angle, rate, load, z, p):
        return -60.0 * angle**3, []


class LopsidedDrive(DetentTorque):
    """A drive that gives a sixth more one way and a sixth less the other way."""

    name, place = 'hidden_lopsided_drive', 'command'

    @staticmethod
    def function(s):
        return 0.15 * np.abs(s)

    def joint_torque(self, angle, rate, load, z, p):
        return ca.SX(0), []

    def deliver(self, torque, z, p):
        return torque * (1 + 0.15 * ca.tanh(torque / 0.02)), []


class TorqueRipple(DetentTorque):
    """A gear whose teeth take a part of the torque, tooth by tooth."""

    name = 'hidden_torque_ripple'

    @staticmethod
    def function(s):
        return -0.2 * np.sin(2 * np.pi * s / TOOTH)

    def joint_torque(self, angle, rate, load, z, p):
        return -0.2 * ca.sin(2 * math.pi * angle / TOOTH) * load, []


class SlowMotor(DetentTorque):
    """A motor that pulls less, the faster it turns."""

    name = 'hidden_slow_motor'

    @staticmethod
    def function(s):
        return -0.12 * np.sqrt(s**2 + 1e-4)

    def joint_torque(self, angle, rate, load, z, p):
        return -0.12 * ca.sqrt(rate**2 + 1e-4) * load, []


class HangingEncoder(BentImu):
    """An encoder that hangs behind by a fixed angle, whichever way it turns."""

    name = 'hidden_hanging_encoder'

    @staticmethod
    def function(s):
        return -0.0015 * np.tanh(s / 0.02)

    def read(self, outputs, z, p):
        behind = 0.0015 * ca.tanh(p[reading_rate('hip_angle')] / 0.02)
        return {**outputs, 'hip_angle': outputs['hip_angle'] - behind}, []


class Gust(DetentTorque):
    """A gust against the inner legs."""

    name, place, extra_inputs = 'hidden_gust', 'environment', (TIME,)

    @staticmethod
    def function(s):
        return 0.8 * np.exp(-(((s - 3) / 0.8) ** 2))

    def joint_torque(self, angle, rate, load, z, p):
        return ca.SX(0), []

    def force(self, body, z, p):
        return ca.vertcat(0.8 * ca.exp(-(((p[TIME] - 3) / 0.8) ** 2)), 0), []


class ViscoelasticHip(DetentTorque):
    """Rubber in the hip that gives way within a third of a second: a law with a memory."""

    name, states = 'hidden_viscoelastic_hip', ('stretch',)

    def joint_torque(self, angle, rate, load, z, p):
        return -8.0 * z[0], [rate - z[0] / 0.3]


@dataclass(frozen=True)
class Case:
    """What is hidden, what may be tried, and what has to be said."""

    hidden: type[Effect]
    listed: tuple[str, ...]
    label: str
    where: str
    follows: str
    parity: str = ''
    period: float | None = None
    error: float = 0.1  # of the function, RMS over its own RMS, where it is seen


CASES = (
    # Four harmonics of this detent leave 7 % of it (the fifth is b_n = n I_n(3)).
    Case(DetentTorque, ('cogging_torque', 'position_dependent_friction'),
         'unmodelled_joint_torque_periodic_in_angle', 'joint', 'angle:hip', 'odd', PITCH,
         error=0.14),
    Case(SoftStop, ('ground_slope', 'payload'),
         'unmodelled_joint_torque_of_angle', 'joint', 'angle:hip'),
    Case(Pulsation, ('torque_bias', 'friction_drift'),
         'unmodelled_joint_torque_periodic_in_time', 'joint', 'time', '', 1 / HERTZ),
    Case(BentImu, ('imu_scale', 'imu_offset'),
         'unmodelled_angle_error_of_angle', 'sensor', 'angle:imu_angle', 'even'),
    Case(SaturatingGyro, ('gyro_scale', 'gyro_bias'),
         'unmodelled_rate_error_of_rate', 'sensor', 'rate:imu_rate', 'odd'),
    Case(TorsionSpring, ('spring_nonlinearity', 'payload'),
         'unmodelled_joint_torque_of_angle', 'joint', 'angle:hip', 'odd'),
    Case(TiltedGyro, ('gyro_bias', 'imu_offset'),
         'unmodelled_rate_error_of_angle', 'sensor', 'angle:imu_angle', 'odd'),
    Case(FadingMotor, ('torque_constant', 'friction_drift'),
         'unmodelled_torque_gain_of_time', 'torque path', 'time'),
)  # fmt: skip
# Too many for tests: bench/unlisted.py has them as well.
MORE = (
    Case(CrossFriction, ('position_dependent_friction', 'asymmetric_friction'),
         'unmodelled_joint_friction_of_body_angle@hip:q_outer', 'joint', 'angle:q_outer', 'even'),
    Case(StiffeningSpring, (), 'unmodelled_joint_torque_of_angle', 'joint', 'angle:hip', 'odd'),
    Case(LopsidedDrive, (), 'unmodelled_joint_torque_of_torque', 'torque path', 'torque:hip',
         'even'),
    Case(TorqueRipple, (), 'unmodelled_torque_gain_periodic_in_angle', 'torque path', 'angle:hip',
         'odd', TOOTH),
    Case(SlowMotor, (), 'unmodelled_torque_gain_of_rate', 'torque path', 'rate:hip', 'even'),
    Case(HangingEncoder, (), 'unmodelled_angle_error_of_rate', 'sensor', 'rate:hip_angle', 'odd'),
    Case(Gust, (), 'unmodelled_outer_torque_of_time', 'outside', 'time'),
)  # fmt: skip


def springs(leg):
    return tuple(Spring(leg, 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3))


SETUPS = (
    (Setup('inner', springs=springs('inner')), [0.1, -0.1, 0.5, -1.0]),
    (Setup('outer', springs=springs('outer')), [0.1, -0.1, -0.8, 0.5]),
) * 2


def hide(nominal, hidden):
    """The machine: numbers off by some percent, and the effect in it."""
    off = {'c1': 1.08, 'c2': 0.93, 'c5': 1.06, 'viscous_friction.coefficient': 0.9}
    machine = nominal.with_values({n: f * nominal.values[n] for n, f in off.items()})
    return replace(machine, effects=(*machine.effects, hidden(machine.mechanism)))


def records(machine, seed=0, duration=DURATION):
    found = []
    for k, (setup, start) in enumerate(SETUPS):
        settings = ExcitationSettings(
            amplitude=6.0, f_min=0.1, f_max=2.5, duration=duration, seed=10 * seed + k
        )
        found.append(
            rehearse(f'record_{k}', machine, setup, start, [make_signal(settings)], duration,
                     SAMPLE, 10 * seed + k)
        )  # fmt: skip
    return found
