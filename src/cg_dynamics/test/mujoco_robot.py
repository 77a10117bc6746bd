"""The compass gait in MuJoCo: recordings with hidden effects, from an engine that is not ours.

The rigid bodies are MJCF text, effects are joint torques in a callback. Nothing is shared with
cg_dynamics but the meaning of signs and angles (conventions.md). The hip body that bisects
the legs cannot be a plain link, so the robot has none: c3 and c6 must vanish (`two_links`).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

FINE_STEP = 2.5e-4
NEGLIGIBLE = 1e-6


@dataclass(frozen=True)
class Hidden:
    """What is wrong with the robot, or true of it. All SI units; the defaults do nothing.

    Attributes:
        payload: (leg, mass, distance from that leg's foot) of a point mass, or None.
        viscous: Hip friction per rate in N m s/rad.
        coulomb: Level of dry hip friction in N m, turned smoothly by tanh(rate/transition_rate).
        transition_rate: In rad/s.
        at_hip: Any other torque at the hip, (time, angle, rate, torque so far) -> what adds to it.
        at_stance: A torque between stance leg and ground, (time, angle, rate) -> N m.
        on_leg: A torque on each leg from outside, its own rate -> N m.
        flexibility: (stiffness, rotor inertia, damping) between motor and hip, or None.
        motor_share: Share of viscous and dry friction that acts on the rotor.
        gap: Total play of that in rad: within it nothing is transmitted.
        spring_damping: N s/m of each spring.
        torque_delay: Time in s by which the torque acts late.
        sensor_delay: Time in s by which all sensors are late.
        torque_gain: Delivered over reported torque.
        torque_bias: Torque in N m that adds to the delivered one.
        slope: Pitch in rad of the ground to which angles refer, positive when it falls ahead.
        offsets: Channel -> what the sensor adds.
        noise: Channel -> standard deviation.
    """

    payload: tuple[str, float, float] | None = None
    viscous: float = 0.0
    coulomb: float = 0.0
    transition_rate: float = 0.01
    at_hip: Callable[[float, float, float, float], float] | None = None
    at_stance: Callable[[float, float, float], float] | None = None
    on_leg: Callable[[float], float] | None = None
    flexibility: tuple[float, float, float] | None = None
    motor_share: float = 0.0
    gap: float = 0.0
    spring_damping: float = 0.0
    torque_delay: float = 0.0
    sensor_delay: float = 0.0
    torque_gain: float = 1.0
    torque_bias: float = 0.0
    slope: float = 0.0
    offsets: Mapping[str, float] = field(default_factory=dict)
    noise: Mapping[str, float] = field(default_factory=dict)


def two_links(values: Mapping[str, float]) -> dict[str, float]:
    """Parameters of the same robot without the hip body; ranges of model files still hold."""
    rigid = {name: value for name, value in values.items() if '.' not in name}
    return rigid | {'c3': 1e-7, 'c6': 0.0}


def simulate_mujoco(
    values: Mapping[str, float],
    setup,
    torque: np.ndarray,
    sample_time: float,
    motion: np.ndarray,
    hidden: Hidden | None = None,
    seed: int = 0,
    fine_step: float = FINE_STEP,
) -> dict[str, np.ndarray]:
    """Record a motion.

    Args:
        values: leg_length, total_mass, gravity, c1 .. c6 with c3 and c6 negligible.
        setup: Anything with `stance`, `fixture` and `springs` as in interfaces.md, "Setup".
        torque: What the drive reports at each sample, held until the next, N m, shape (n,).
        sample_time: In s.
        motion: (q_inner, q_outer) and their rates at the start, of the legs that can move only
            where the fixture holds or ties some, shape (4,) or (2,).
        hidden: Effects.
        seed: Of the noise.
        fine_step: Longest step of the engine in s.

    Returns:
        'time', 'hip_torque' (as reported), 'imu_angle', 'imu_rate', 'hip_angle' as the sensors
        report them, and the truth as 'q', 'v', shapes (n, 2).
    """
    hidden = hidden or Hidden()
    if abs(values['c3']) > NEGLIGIBLE or abs(values['c6']) > NEGLIGIBLE:
        raise ValueError('c3 and c6 must be negligible: use two_links(values)')
    robot = _Robot(values, setup, hidden)
    robot.place(np.asarray(motion, float))
    torque = np.asarray(torque, float).ravel()
    time = np.arange(len(torque)) * sample_time
    changes = time + hidden.torque_delay
    reports = time - hidden.sensor_delay
    q, v = np.empty((len(time), 2)), np.empty((len(time), 2))
    late_q, late_v = q.copy(), v.copy()
    edges = np.unique(np.round(np.concatenate([[0.0], time, changes, reports[reports > 0]]), 12))
    edges = edges[edges <= time[-1] + 1e-12]
    early = reports <= 0
    with robot.callback():
        # Before the first sample, angles and rates are taken to have run straight.
        robot.torque = hidden.torque_gain * torque[0] + hidden.torque_bias
        mujoco.mj_forward(robot.model, robot.data)
        start_q, start_v = robot.legs()
        late_q[early] = start_q + np.outer(reports[early], start_v)
        late_v[early] = start_v + np.outer(reports[early], robot.accelerations())
        for index, begin in enumerate(edges):
            _keep(q, v, time, begin, robot)
            _keep(late_q, late_v, np.where(early, np.nan, reports), begin, robot)
            if index + 1 == len(edges):
                break
            row = np.searchsorted(changes, begin + 1e-10, side='right') - 1
            reported = torque[max(row, 0)]
            robot.torque = hidden.torque_gain * reported + hidden.torque_bias
            robot.advance(edges[index + 1] - begin, fine_step)
    channels = {
        'imu_angle': late_q[:, 0],
        'imu_rate': late_v[:, 0],
        'hip_angle': late_q[:, 0] - late_q[:, 1],
    }
    for channel, stream in zip(channels, np.random.SeedSequence(seed).spawn(3), strict=True):
        noise = np.random.default_rng(stream).standard_normal(len(time))
        channels[channel] = (
            channels[channel]
            + hidden.offsets.get(channel, 0.0)
            + hidden.noise.get(channel, 0.0) * noise
        )
    return {'time': time, 'hip_torque': torque, **channels, 'q': q, 'v': v}


def _keep(q, v, instants, now, robot) -> None:
    for row in np.flatnonzero(np.abs(instants - now) < 1e-10):
        q[row], v[row] = robot.legs()


class _Robot:
    def __init__(self, values, setup, hidden: Hidden):
        self.hidden, self.setup = hidden, setup
        self.torque = 0.0
        self.model = mujoco.MjModel.from_xml_string(mjcf(values, setup, hidden))
        self.data = mujoco.MjData(self.model)
        # The hip joint turns the swing leg on the stance leg; the hip angle is inner - outer.
        self.sign = 1.0 if setup.stance == 'outer' else -1.0
        self.joint = {}
        for name in ('stance', 'hip', 'rotor'):
            index = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_JOINT, name)
            self.joint[name] = self.model.jnt_qposadr[index] if index >= 0 else None

    def place(self, motion: np.ndarray) -> None:
        half = len(motion) // 2
        for full, part in ((self.data.qpos, motion[:half]), (self.data.qvel, motion[half:])):
            stance = self.joint['stance']
            if half == 1:
                full[self.joint['stance' if stance is not None else 'hip']] = part[0]
            else:
                standing, swinging = part if self.setup.stance == 'inner' else part[::-1]
                full[stance], full[self.joint['hip']] = standing, swinging - standing
        if self.joint['rotor'] is not None:
            # Wound up by nothing, moving with the hip.
            angle, rate = self._hip()
            self.data.qpos[self.joint['rotor']] = angle
            self.data.qvel[self.joint['rotor']] = rate
        mujoco.mj_forward(self.model, self.data)

    def legs(self) -> tuple[np.ndarray, np.ndarray]:
        """(q_inner, q_outer) and rates."""
        return self._absolute(self.data.qpos), self._absolute(self.data.qvel)

    def accelerations(self) -> np.ndarray:
        """Second derivatives of (q_inner, q_outer)."""
        return self._absolute(self.data.qacc)

    def _absolute(self, joints) -> np.ndarray:
        standing = 0.0 if self.joint['stance'] is None else joints[self.joint['stance']]
        swinging = standing + (0.0 if self.joint['hip'] is None else joints[self.joint['hip']])
        pair = [standing, swinging]
        return np.array(pair if self.setup.stance == 'inner' else pair[::-1])

    def advance(self, duration: float, fine_step: float) -> None:
        steps = max(1, math.ceil(duration / fine_step - 1e-9))
        self.model.opt.timestep = duration / steps
        mujoco.mj_step(self.model, self.data, steps)

    def callback(self):
        return _PassiveForces(self.apply)

    def apply(self, model, data) -> None:
        """All torques at the hip; called at every stage of every step."""
        stance, hip, hidden = self.joint['stance'], self.joint['hip'], self.hidden
        if stance is not None:
            data.qfrc_passive[stance] += self._from_outside(data, stance, hip)
        if hip is None:
            return
        angle, rate = self.sign * data.qpos[hip], self.sign * data.qvel[hip]
        torque = self.torque
        if self.joint['rotor'] is not None:
            rotor = self.joint['rotor']
            torque = self._through(data.qpos[rotor] - angle, data.qvel[rotor] - rate)
            opposing = hidden.motor_share * self._friction(data.qvel[rotor])
            data.qfrc_passive[rotor] += self.torque + opposing - torque
        if hidden.at_hip is not None:
            torque += hidden.at_hip(data.time, angle, rate, torque)
        torque += (1 - hidden.motor_share) * self._friction(rate)
        data.qfrc_passive[hip] += self.sign * torque
        if hidden.on_leg is not None:
            turning = data.qvel[hip] + (0.0 if stance is None else data.qvel[stance])
            data.qfrc_passive[hip] += hidden.on_leg(turning)

    def _from_outside(self, data, stance, hip) -> float:
        angle, rate, hidden = data.qpos[stance], data.qvel[stance], self.hidden
        torque = 0.0 if hidden.at_stance is None else hidden.at_stance(data.time, angle, rate)
        if hidden.on_leg is not None:
            torque += hidden.on_leg(rate) + hidden.on_leg(
                rate + (0.0 if hip is None else data.qvel[hip])
            )
        return torque

    def _friction(self, rate) -> float:
        hidden = self.hidden
        dry = hidden.coulomb * math.tanh(rate / hidden.transition_rate)
        return -hidden.viscous * rate - dry

    def _through(self, twist, twist_rate) -> float:
        stiffness, _, damping = self.hidden.flexibility
        free = self.hidden.gap / 2
        if abs(twist) < free:
            return 0.0
        return stiffness * (twist - math.copysign(free, twist)) + damping * twist_rate

    def _hip(self) -> tuple[float, float]:
        hip = self.joint['hip']
        return self.sign * self.data.qpos[hip], self.sign * self.data.qvel[hip]


class _PassiveForces:
    """Installs the engine's callback, which is one for the whole process, and takes it out."""

    def __init__(self, function):
        self.function = function

    def __enter__(self):
        mujoco.set_mjcb_passive(self.function)

    def __exit__(self, *exc):
        mujoco.set_mjcb_passive(None)


def mjcf(values: Mapping[str, float], setup, hidden: Hidden | None = None) -> str:
    """MJCF text of the robot in a set-up."""
    hidden = hidden or Hidden()
    l, mt, g = values['leg_length'], values['total_mass'], values['gravity']
    legs = _legs(values)
    swing_name = 'outer' if setup.stance == 'inner' else 'inner'
    standing, swinging = legs[setup.stance], legs[swing_name]
    hip_mass = mt - standing.mass - swinging.mass
    free = setup.fixture not in ('inner_fixed', 'outer_fixed')
    stance_joint = '<joint name="stance" type="hinge" axis="0 1 0"/>' if free else ''
    hip_joint = (
        '' if setup.fixture == 'legs_tied' else '<joint name="hip" type="hinge" axis="0 1 0"/>'
    )
    extra = {'inner': '', 'outer': ''}

    def along(leg, distance):
        return distance if leg == setup.stance else distance - l

    if hidden.payload is not None:
        leg, mass, distance = hidden.payload
        extra[leg] += (
            f'<body pos="0 0 {along(leg, distance)}">'
            f'<inertial pos="0 0 0" mass="{mass}" diaginertia="1e-12 1e-12 1e-12"/></body>'
        )
    anchors = tendons = ''
    for i, spring in enumerate(setup.springs):
        x, z = spring.anchor
        anchors += f'<site name="anchor{i}" pos="{x} 0 {z}"/>'
        extra[spring.body] += (
            f'<site name="hook{i}" pos="0 0 {along(spring.body, spring.point)}"/>'
        )
        tendons += (
            f'<spatial stiffness="{spring.stiffness}" springlength="{spring.free_length}" '
            f'damping="{hidden.spring_damping}">'
            f'<site site="anchor{i}"/><site site="hook{i}"/></spatial>'
        )
    rotor = ''
    if hidden.flexibility is not None:
        inertia = hidden.flexibility[1]
        rotor = (
            '<body pos="0 1 0"><joint name="rotor" type="hinge" axis="0 1 0"/>'
            f'<inertial pos="0 0 0" mass="1" diaginertia="{inertia} {inertia} {inertia}"/></body>'
        )
    down = f'{g * math.sin(hidden.slope)!r} 0 {-g * math.cos(hidden.slope)!r}'
    return f"""
<mujoco>
  <option gravity="{down}" integrator="RK4" timestep="{FINE_STEP}"/>
  <compiler angle="radian"/>
  <worldbody>
    {anchors}{rotor}
    <body>
      {stance_joint}
      {standing.inertial(l - standing.below_hip)}
      {extra[setup.stance]}
      <body pos="0 0 {l}">
        <inertial pos="0 0 0" mass="{hip_mass!r}" diaginertia="1e-12 1e-12 1e-12"/>
      </body>
      <body pos="0 0 {l}">
        {hip_joint}
        {swinging.inertial(-swinging.below_hip)}
        {extra[swing_name]}
      </body>
    </body>
  </worldbody>
  <tendon>{tendons}</tendon>
</mujoco>"""


@dataclass(frozen=True)
class _Leg:
    mass: float
    below_hip: float
    inertia: float

    def inertial(self, height: float) -> str:
        i = repr(self.inertia)
        return f'<inertial pos="0 0 {height!r}" mass="{self.mass!r}" diaginertia="{i} {i} {i}"/>'


def _legs(values) -> dict[str, _Leg]:
    """Masses that have these lumps: the least a leg can weigh, and a third of what is left."""
    l, mt = values['leg_length'], values['total_mass']
    about_hip = {'inner': values['c1'] * mt * l**2, 'outer': values['c2'] * mt * l**2}
    moment = {'inner': values['c4'] * mt * l, 'outer': values['c5'] * mt * l}
    least = {leg: moment[leg] ** 2 / about_hip[leg] for leg in about_hip}
    slack = mt - sum(least.values())
    if slack <= 0:
        raise ValueError(f'no real bodies have these lumps: the legs alone weigh {mt - slack} kg')
    legs = {}
    for leg in about_hip:
        mass = least[leg] + slack / 3
        below = moment[leg] / mass
        legs[leg] = _Leg(mass, below, about_hip[leg] - mass * below**2)
    return legs
