"""What is wrong with robots that share no code with the model: laws for MuJoCo's compass gait.

The robot is MuJoCo's (src/cg_dynamics/test/mujoco_robot.py): its rigid bodies, its integrator.
What is wrong with it is written down here from its physics, half of it by the laws that the
library's effects are named after, and half by what other simulators and the literature have:

    LAWS        an effect of the library, by its own law or (name/law) by another
    FRICTIONS   dry friction of sound robots, by the laws of other simulators
    UNLISTED    what no effect of the library is

Not here: feet that roll, and springs of the rig that harden, which this robot does not have; nor
`boom_mass`: to an engine a mass is a mass.
"""

import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / 'src/cg_dynamics/test'))

SAMPLE = 0.002
FINE = 4  # rows of the simulation for one of the record: filters run on these
TEETH = 3000.0, 4.0  # N m/rad and N m s/rad of teeth that touch; the library's are 4000 and 5
STIFF_TEETH = 2e4, 20.0
TURN = 0.01  # rad/s, over which dry friction turns
HALF_SINE = np.sqrt(1 / 4 - 2 / np.pi**2)  # standard deviation of a half sine over its length
RECTANGLE = np.sqrt(1 / 12)
WARMING = 16.0  # s, over which the straight law of warming grease goes to its opposite

IMU = 'imu_angle', 'imu_rate'

Channels = dict[str, np.ndarray]


@dataclass(frozen=True)
class Secret:
    """What is wrong with the machine.

    Attributes:
        robot: Attributes of mujoco_robot.Hidden.
        command: Reported torque and step in s -> delivered torque, shape (n,).
        read: True channels and time -> what the sensors show.
        step: Longest of the engine, in s.
    """

    robot: Mapping[str, Any] = field(default_factory=dict)
    command: Callable[[np.ndarray, float], np.ndarray] = lambda torque, dt: torque
    read: Callable[[Channels, np.ndarray], Channels] = lambda channels, time: channels
    step: float = SAMPLE / FINE


@dataclass(frozen=True)
class Machine:
    """What a law may know of the robot and of the recording.

    Attributes:
        leg_length: In m.
        index: Number of the recording, from 0.
        pushed: Number of the one with the push, if there is one.
        begin: Time of its start in the session, s.
        rng: Of what is random in the law.
    """

    leg_length: float
    index: int
    pushed: int
    begin: float
    rng: np.random.Generator


def dry(level: Callable) -> Secret:
    """Dry friction at the hip of a level (time, angle, rate, torque) -> N m."""

    def torque(time, angle, rate, load):
        return -level(time, angle, rate, load) * np.tanh(rate / TURN)

    return Secret({'at_hip': torque})


def sensor(channel: str, change: Callable) -> Secret:
    """A channel (value, time) -> as it is shown."""
    return Secret(read=lambda c, time: {**c, channel: change(c[channel], time)})


def half_sine(t: float, length: float) -> float:
    """A pulse of area one about t = 0, in 1/s."""
    return np.pi / (2 * length) * np.cos(np.pi * t / length) if abs(t) < length / 2 else 0.0


def lagged_torque(torque: np.ndarray, dt: float, constant: float) -> np.ndarray:
    """Mean over each row of T y' = u - y, u held."""
    kept = np.exp(-dt / constant)
    mean, y = np.empty_like(torque), torque[0]
    for k, u in enumerate(torque):
        mean[k] = u + (y - u) * constant / dt * (1 - kept)
        y = u + (y - u) * kept
    return mean


def filtered(x: np.ndarray, dt: float, constant: float) -> np.ndarray:
    """T y' = x - y, x straight between rows, as after a while at the first rate."""
    kept, slopes = np.exp(-dt / constant), np.diff(x) / dt
    y = np.empty_like(x)
    y[0] = x[0] - constant * slopes[0]
    for k, s in enumerate(slopes):
        y[k + 1] = x[k + 1] - s * constant + (y[k] - x[k] + s * constant) * kept
    return y


class Bristle:
    """Dry friction of LuGre's kind: a bristle that bends before it slides.

    z' = v - |v| z / deflection(v), torque = -stiffness z; exact for a rate that stays from call to
    call of the engine.

    Args:
        level: |rate| in rad/s -> N m at which it slides.
        stiffness: Of the bristle, N m/rad.
    """

    def __init__(self, level: Callable[[float], float], stiffness: float):
        self.level, self.stiffness = level, stiffness
        self.time = self.bend = 0.0

    def __call__(self, time: float, angle: float, rate: float, load: float) -> float:
        """Torque in N m at the hip."""
        if time > self.time:
            deflection = max(self.level(abs(rate)), 1e-9) / self.stiffness
            kept = np.exp(-abs(rate) * (time - self.time) / deflection)
            slid = np.sign(rate) * deflection
            self.bend = slid + (self.bend - slid) * kept
            self.time = time
        return -self.stiffness * self.bend


class Creep:
    """A foot pad with a memory: a spring in series with a damper (Maxwell), by the lean."""

    def __init__(self, stiffness: float, time_constant: float):
        self.stiffness, self.constant = stiffness, time_constant
        self.time = self.crept = 0.0

    def __call__(self, time: float, lean: float, rate: float) -> float:
        """Torque in N m between stance leg and ground."""
        if time > self.time:
            kept = np.exp(-(time - self.time) / self.constant)
            self.crept = lean + (self.crept - lean) * kept
            self.time = time
        return -self.stiffness * (lean - self.crept)


def _three(law: Callable[[float, float, float], float]) -> Callable:
    """A law of time, angle and rate, where there is a load too."""
    return lambda time, angle, rate, load: law(time, angle, rate)


def heated(torque: np.ndarray, dt: float) -> np.ndarray:
    """A motor whose magnets lose a hundredth of their pull for each 20 (N m)^2 s of heat."""
    heat = np.cumsum(torque**2) * dt
    return torque * (1 - 0.01 * heat / 20.0)


def triangle(phase: float) -> float:
    """A wave between -1 and 1 with the period and the signs of a sine."""
    return 2 / np.pi * np.arcsin(np.sin(phase))


def at_hip(torque: Callable[[float, float, float, float], float]) -> Secret:
    """A torque at the hip by (time, angle, rate, torque so far)."""
    return Secret({'at_hip': torque})


def pushed(shape: Callable[[float, Mapping[str, float]], float]) -> Callable:
    """A horizontal force at the hip: shape(time from the instant, values) in N."""

    def secret(v: Mapping[str, float], m: Machine) -> Secret:
        if m.index != m.pushed:
            return Secret()  # somebody pushed once
        return Secret({'at_stance': lambda t, angle, rate:
            shape(t - v['instant'], v) * m.leg_length * np.cos(angle)})  # fmt: skip

    return secret


def rectangle(t: float, length: float) -> float:
    """A pulse of area one about t = 0, in 1/s."""
    return 1 / length if abs(t) < length / 2 else 0.0


def uneven(torque: np.ndarray, dt: float, delay: float, rng: np.random.Generator) -> np.ndarray:
    """A torque that comes late by whole samples: now one fewer, now one more."""
    rows = np.arange(0, len(torque), FINE)
    late = round(delay / (FINE * dt)) + rng.integers(-1, 2, len(rows))
    kept = torque[::FINE][np.maximum(np.arange(len(rows)) - late, 0)]
    return np.repeat(kept, FINE)[: len(torque)]


def jittered(c: Channels, time: np.ndarray, sigma: float, rng: np.random.Generator) -> Channels:
    """Channels that were sampled off their stamps by `sigma` in s."""
    off = np.repeat(rng.normal(0.0, sigma, -(-len(time) // FINE)), FINE)[: len(time)]
    return {name: np.interp(time + off, time, x) for name, x in c.items()}


LAGS = 'actuator_delay', 'sensor_delay'  # one and the same but for the first moments of a record

# (values of the effect, Machine) -> what is wrong with the machine. The effect is the name up to
# the slash; sizes are drawn as those of the library's effect.
LAWS: dict[str, Callable[[Mapping[str, float], Machine], Secret]] = {
    'actuator_delay': lambda v, m: Secret({'torque_delay': v['delay']}),
    'actuator_lag': lambda v, m: Secret(
        command=lambda u, dt: lagged_torque(u, dt, v['time_constant'])),
    'torque_constant': lambda v, m: Secret({'torque_gain': 1 + v['error']}),
    'torque_bias': lambda v, m: Secret({'torque_bias': v['bias']}),
    'torque_saturation': lambda v, m: Secret(
        command=lambda u, dt: np.clip(u, -v['limit'], v['limit'])),
    'cogging_torque': lambda v, m: Secret({
        'at_hip': lambda t, angle, rate, load:
            v['amplitude'] * np.sin(v['cycles'] * angle + v['phase'])}),
    'joint_flexibility': lambda v, m: Secret({
        'flexibility': (v['stiffness'], v['rotor_inertia'], v['damping'])}),
    'backlash': lambda v, m: Secret({
        'flexibility': (TEETH[0], v['rotor_inertia'], TEETH[1]), 'gap': v['gap']},
        step=SAMPLE / 20),
    'quadratic_friction': lambda v, m: Secret({
        'at_hip': lambda t, angle, rate, load: -v['coefficient'] * rate * abs(rate)}),
    'asymmetric_friction': lambda v, m: dry(
        lambda t, angle, rate, load: v['excess'] * (rate > 0)),
    'stribeck_friction': lambda v, m: dry(
        lambda t, angle, rate, load:
            v['torque'] * np.exp(-((rate / v['stribeck_rate']) ** 2))),
    'load_dependent_friction': lambda v, m: dry(
        lambda t, angle, rate, load: v['coefficient'] * abs(load)),
    'position_dependent_friction': lambda v, m: dry(
        lambda t, angle, rate, load:
            v['torque'] * (1 + np.cos(angle - v['tightest'])) / 2),
    'friction_drift': lambda v, m: dry(
        lambda t, angle, rate, load: v['excess'] * np.exp(-t / v['time_constant'])),
    'payload': lambda v, m: Secret({'payload': ('outer', v['mass'], v['distance'])}),
    'ground_slope': lambda v, m: Secret({'slope': v['angle']}),
    'aerodynamic_drag': lambda v, m: Secret({
        'on_leg': lambda rate: -v['coefficient'] * rate * abs(rate)}),
    'ankle_friction': lambda v, m: Secret({
        'at_stance': lambda t, angle, rate: -v['coefficient'] * rate}),
    'tether_force': lambda v, m: Secret({
        'at_stance': lambda t, angle, rate: v['force'] * m.leg_length * np.cos(angle)}),
    'spring_damping': lambda v, m: Secret({'spring_damping': v['coefficient']}),
    'encoder_offset': lambda v, m: sensor('hip_angle', lambda x, t: x + v['offset']),
    'encoder_scale': lambda v, m: sensor('hip_angle', lambda x, t: (1 + v['error']) * x),
    'encoder_eccentricity': lambda v, m: sensor(
        'hip_angle', lambda x, t: x + v['amplitude'] * np.sin(x + v['phase'])),
    'gyro_bias': lambda v, m: sensor('imu_rate', lambda x, t: x + v['bias']),
    'gyro_scale': lambda v, m: sensor('imu_rate', lambda x, t: (1 + v['error']) * x),
    'imu_offset': lambda v, m: sensor('imu_angle', lambda x, t: x + v['offset']),
    'imu_scale': lambda v, m: sensor('imu_angle', lambda x, t: (1 + v['error']) * x),
    'imu_drift': lambda v, m: sensor('imu_angle', lambda x, t: x + v['rate'] * t),
    'imu_lag': lambda v, m: Secret(read=lambda c, time: {
        **c, **{n: filtered(c[n], time[1], v['time_constant']) for n in IMU}}),
    'sensor_delay': lambda v, m: Secret({'sensor_delay': v['delay']}),
    'presliding_friction': lambda v, m: at_hip(
        Bristle(lambda rate: v['torque'], v['torque'] / v['deflection'])),
    'torque_dead_zone': lambda v, m: Secret(
        command=lambda u, dt: u - np.clip(u, -v['half_width'], v['half_width'])),
    'torque_quantisation': lambda v, m: Secret(
        command=lambda u, dt: v['step'] * np.round(u / v['step'])),
    'foot_creep': lambda v, m: Secret(
        {'at_stance': Creep(v['stiffness'], v['time_constant'])}),
    'joint_creep': lambda v, m: at_hip(_three(Creep(v['stiffness'], v['time_constant']))),
    # Other laws: Tustin's fade, a fade with slow tails, LuGre's bristle.
    'stribeck_friction/exponential': lambda v, m: dry(
        lambda t, angle, rate, load:
            v['torque'] * np.exp(-abs(rate) / v['stribeck_rate'])),
    'stribeck_friction/tails': lambda v, m: dry(
        lambda t, angle, rate, load:
            v['torque'] / (1 + (rate / v['stribeck_rate']) ** 2)),
    'stribeck_friction/bristle': lambda v, m: at_hip(
        Bristle(lambda rate: v['torque'] * np.exp(-((rate / v['stribeck_rate']) ** 2)),
                v['torque'] / 0.002)),
    # Dry friction that turns slowly, as simulators smooth it, one way only.
    'asymmetric_friction/arctan': lambda v, m: at_hip(
        lambda t, angle, rate, load:
            -v['excess'] * (rate > 0) * 2 / np.pi * np.arctan(rate / TURN)),
    # The iron of the motor saturates.
    'torque_saturation/tanh': lambda v, m: Secret(
        command=lambda u, dt: v['limit'] * np.tanh(u / v['limit'])),
    # A gear out of round, and a wave generator that is so twice a turn of the motor.
    'position_dependent_friction/twice_a_turn': lambda v, m: dry(
        lambda t, angle, rate, load:
            v['torque'] * (1 + np.cos(2 * angle - v['tightest'])) / 2),
    'position_dependent_friction/ten_a_turn': lambda v, m: dry(
        lambda t, angle, rate, load:
            v['torque'] / 4 * (1 + np.cos(10 * angle - v['tightest'])) / 2),
    # Grease that warms on from one recording to the next, or along a straight line.
    'friction_drift/straight': lambda v, m: dry(
        lambda t, angle, rate, load: v['excess'] * (1 - t / WARMING)),
    'friction_drift/session': lambda v, m: dry(
        lambda t, angle, rate, load:
            v['excess'] * np.exp(-(m.begin + t) / (6 * v['time_constant']))),
    'cogging_torque/triangle': lambda v, m: at_hip(
        lambda t, angle, rate, load:
            v['amplitude'] * triangle(v['cycles'] * angle + v['phase'])),
    # A harmonic drive has its friction on the motor's side.
    'joint_flexibility/friction_at_motor': lambda v, m: Secret({
        'flexibility': (v['stiffness'], v['rotor_inertia'], v['damping']),
        'motor_share': 1.0}),
    'backlash/stiff_teeth': lambda v, m: Secret({
        'flexibility': (STIFF_TEETH[0], v['rotor_inertia'], STIFF_TEETH[1]),
        'gap': v['gap']}, step=SAMPLE / 40),
    'actuator_lag/second_order': lambda v, m: Secret(
        command=lambda u, dt: lagged_torque(
            lagged_torque(u, dt, v['time_constant'] / 2), dt, v['time_constant'] / 2)),
    # A drive that wakes up slowly.
    'torque_dead_zone/round': lambda v, m: Secret(
        command=lambda u, dt: np.sign(u) * (np.hypot(u, v['half_width']) - v['half_width'])),
    'torque_quantisation/towards_zero': lambda v, m: Secret(
        command=lambda u, dt: v['step'] * np.trunc(u / v['step'])),
    # Rubber creeps with more than one time constant.
    'foot_creep/two_constants': lambda v, m: beside(
        Secret({'at_stance': Creep(v['stiffness'] / 2, v['time_constant'] / 2)}),
        Secret({'at_stance': Creep(v['stiffness'] / 2, v['time_constant'] * 2)})),
    'actuator_delay/uneven': lambda v, m: Secret(
        command=lambda u, dt: uneven(u, dt, v['delay'], m.rng)),
    'imu_lag/second_order': lambda v, m: Secret(read=lambda c, time: {**c, **{
        n: filtered(filtered(c[n], time[1], v['time_constant'] / 2), time[1],
                    v['time_constant'] / 2) for n in IMU}}),
    'quadratic_friction/cubic': lambda v, m: at_hip(
        lambda t, angle, rate, load: -v['coefficient'] * rate**3 / 2),
    'external_push/half_sine': pushed(
        lambda t, v: v['impulse'] * half_sine(t, v['duration'] / HALF_SINE)),
    'external_push/rectangle': pushed(
        lambda t, v: v['impulse'] * rectangle(t, v['duration'] / RECTANGLE)),
    'external_push/short': pushed(
        lambda t, v: v['impulse'] * half_sine(t, 0.1 * v['duration'] / HALF_SINE)),
}  # fmt: skip

# What besides the effect is right as a name.
RIGHT: dict[str, tuple[str, ...]] = {
    'actuator_delay': LAGS,
    'sensor_delay': LAGS,
    'stribeck_friction/bristle': ('presliding_friction',),
    'joint_flexibility/friction_at_motor': ('motor_side_friction',),
    'actuator_delay/uneven': LAGS,
    'torque_quantisation/towards_zero': ('torque_dead_zone',),
    'actuator_lag/second_order': LAGS,
}

# Level 1 N m at a rate in rad/s; the numbers are those of a sound robot.
FRICTIONS: dict[str, Callable[[], Callable[[float, float, float, float], float]]] = {
    'tanh': lambda: lambda t, a, rate, load: -np.tanh(rate / TURN),
    'tanh, three times as smooth': lambda: lambda t, a, rate, load: -np.tanh(rate / (3 * TURN)),
    'arctan': lambda: lambda t, a, rate, load: -2 / np.pi * np.arctan(rate / TURN),
    'arctan, three times as smooth': lambda: (
        lambda t, a, rate, load: -2 / np.pi * np.arctan(rate / (3 * TURN))),
    'root': lambda: lambda t, a, rate, load: -rate / np.sqrt(rate**2 + TURN**2),
    'straight between': lambda: lambda t, a, rate, load: -np.clip(rate / TURN, -1, 1),
    'bristle': lambda: Bristle(lambda rate: 1.0, 1 / 0.0005),
}  # fmt: skip

UNLISTED: dict[str, Callable[[Machine], Secret]] = {
    'a motor that fades with its heat': lambda m: Secret(command=heated),
    'a hip that is stiff one way': lambda m: at_hip(
        lambda t, angle, rate, load: -8.0 * max(angle, 0.0)),
    'a gust against the leg that stands': lambda m: Secret({
        'at_stance': lambda t, angle, rate: 1.2 * np.exp(-(((t - 4) / 0.8) ** 2))}),
    'magnets at the hip': lambda m: at_hip(
        lambda t, angle, rate, load: -1.14 * np.sin(30 * angle)
        * np.exp(3 * (np.cos(30 * angle) - 1))),
    'a rubber stop at 0.15 rad': lambda m: at_hip(
        lambda t, angle, rate, load: -20.0 * max(angle - 0.15, 0.0)),
    'a torque that pulsates': lambda m: at_hip(
        lambda t, angle, rate, load: 0.6 * np.sin(2 * np.pi * 3.7 * (m.begin + t) + 0.4)),
    'a spring at the hip that hardens': lambda m: at_hip(
        lambda t, angle, rate, load: -12.0 * angle**3),
    'stamps that are regular, sampling that is not': lambda m: Secret(
        read=lambda c, time: jittered(c, time, 4e-4, m.rng)),
    'an IMU that bends with the lean': lambda m: sensor(
        'imu_angle', lambda x, t: x + 0.01 * np.sin(6 * x)),
    'a gyroscope that feels gravity': lambda m: Secret(
        read=lambda c, time: {**c, 'imu_rate': c['imu_rate'] + 0.1 * np.sin(c['imu_angle'])}),
}  # fmt: skip


def beside(a: Secret, b: Secret) -> Secret:
    """Both of them.

    Raises:
        ValueError: if both are the same part of the machine.
    """
    robot = dict(a.robot)
    for name, value in b.robot.items():
        if name not in robot:
            robot[name] = value
        elif callable(value):
            robot[name] = _sum(robot[name], value)
        else:
            raise ValueError(f'both have a {name}')
    return Secret(
        robot, lambda u, dt: b.command(a.command(u, dt), dt),
        lambda c, time: b.read(a.read(c, time), time), min(a.step, b.step),
    )  # fmt: skip


def _sum(f: Callable, g: Callable) -> Callable:
    return lambda *at: f(*at) + g(*at)
