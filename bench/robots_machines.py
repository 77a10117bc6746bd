"""Robots of a URDF that share no code with the models, and what is wrong with each.

MuJoCo reads the URDF and integrates it (RK4). Dry friction that a sound robot has turns over some
0.01 rad/s, by another law than the model's; friction that is hidden, or hard, is MuJoCo's own, a
constraint with true rest. What else is wrong is a number or a body of MuJoCo's where it has one,
or a law of this file at every stage of its integrator:

    ROBOTS    five of them, their URDFs in robots_urdf
    EFFECTS   an effect of the library -> what is wrong, drawn for a joint, a link or the robot
    SITES     where recordings of a robot can show it
    RIGHT     what else is right as a name, where physics leaves no difference
"""

import functools
import sys
import xml.etree.ElementTree as Xml
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import mujoco
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / 'src/cg_sysid/test'))

from mujoco_tree import wander

ENGINE = 2.5e-4  # s, longest step of the engine
FINE = 1.25e-4  # s, where a constraint or teeth act: what MuJoCo's friction is off goes with it
REST = 2 * FINE  # s, in which MuJoCo's dry friction stops a joint (solref), the least it can
TURNS = 0.01  # rad/s or m/s, over which smooth dry friction turns
POINT = 1e-9  # kg m^2, of a body that is a point
TEETH_DEFLECTION = 5e-4  # rad or m that teeth give way under the largest torque
Law = Callable[[float, np.ndarray, np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Robot:
    """One robot and how it is recorded.

    Attributes:
        name: Of its URDF.
        joints: All that move.
        driven: Those with a drive.
        tip: Link that carries payloads.
        reach: How far each joint goes, rad or m; of a robot that swings freely unused.
        frequencies: Lowest and highest of its ways, or of the torque of one that swings, Hz.
        push: RMS of the torque of one that swings freely, N m or N; 0 of one under control.
        rate: Rows a second.
        records: How many.
        seconds: Length of each.
        noise: Of the encoders, rad or m.
        counts: Of the encoders by rad or m.
    """

    name: str
    joints: tuple[str, ...]
    driven: tuple[str, ...]
    tip: str
    reach: tuple[float, ...]
    frequencies: tuple[float, float]
    noise: tuple[float, ...]
    counts: tuple[float, ...]
    push: float = 0.0
    rate: float = 500.0
    records: int = 6
    seconds: float = 8.0

    @property
    def urdf(self) -> str:
        """Its description."""
        return (Path(__file__).parent / 'robots_urdf' / f'{self.name}.urdf').read_text()

    @property
    def links(self) -> tuple[str, ...]:
        """That move, each the child of its joint."""
        child = {j.get('name'): j.find('child').get('link')
                 for j in Xml.fromstring(self.urdf).iter('joint')}  # fmt: skip
        return tuple(child[joint] for joint in self.joints)

    def friction(self) -> np.ndarray:
        """Dry friction of each joint by its URDF, read without the code that is to be judged."""
        robot = Xml.fromstring(self.urdf)
        found = {joint.get('name'): joint.find('dynamics') for joint in robot.iter('joint')}
        return np.array([float(found[name].get('friction')) for name in self.joints])

    def place(self, joint: str) -> int:
        """Of a joint in the rows."""
        return self.joints.index(joint)

    def slides(self, joint: str) -> bool:
        """Whether it moves along a line."""
        return joint == 'cart_joint'


TURN = 2 * np.pi
ROBOTS = {
    robot.name: robot
    for robot in (
        Robot('arm2', ('shoulder_joint', 'elbow_joint'), ('shoulder_joint', 'elbow_joint'),
              'tool0', (1.3, 1.6), (0.15, 0.9), (5e-5, 5e-5), (2**17 / TURN, 2**17 / TURN)),
        Robot('leg3', ('abduction_joint', 'hip_joint', 'knee_joint'),
              ('abduction_joint', 'hip_joint', 'knee_joint'), 'foot', (0.6, 1.1, 1.4),
              (0.3, 1.7), (8e-5, 6e-5, 7e-5), (2**14 / TURN, 2**14 / TURN, 2**14 / TURN)),
        Robot('cartpole', ('cart_joint', 'pole_joint'), ('cart_joint',), 'pole', (0.3, 0.6),
              (0.3, 2.2), (1.5e-5, 1e-4), (22000.0, 4096 / TURN), push=3.0),
        Robot('furuta', ('arm_joint', 'pendulum_joint'), ('arm_joint',), 'pendulum', (0.8, 0.7),
              (0.3, 2.6), (1e-4, 1e-4), (4096 / TURN, 4096 / TURN), push=0.05),
        Robot('arm6', ('pan_joint', 'lift_joint', 'elbow_joint', 'wrist_1_joint',
                       'wrist_2_joint', 'wrist_3_joint'),
              ('pan_joint', 'lift_joint', 'elbow_joint', 'wrist_1_joint', 'wrist_2_joint',
               'wrist_3_joint'), 'tool0', (1.4, 0.9, 1.2, 1.4, 1.5, 1.8), (0.1, 0.6),
              (5e-5,) * 6, (2**17 / TURN,) * 6, rate=250.0, records=8, seconds=10.0),
        Robot('small_furuta', ('arm_joint', 'pendulum_joint'), ('arm_joint',), 'pendulum',
              (0.8, 0.7), (0.4, 3.5), (1e-4, 1e-4), (2048 / TURN, 2048 / TURN), push=0.0011),
    )
}  # fmt: skip


@dataclass(frozen=True)
class Secret:
    """What is wrong with a machine, beyond its URDF.

    Attributes:
        damping: Joint -> viscous friction more, N m s/rad.
        dry: Joint -> dry friction more, N m.
        fade: Joint -> (dry friction more at rest, N m, rate at which it has faded).
        armature: Joint -> inertia of the rotor seen from the joint, kg m^2.
        payload: (link, mass in kg, place in its frame in m), or None.
        tilt: Of the base about its x and y axes, rad.
        rotor: Joint -> (inertia of a rotor apart from it, its coupling's stiffness and damping,
            and its play), or None.
        torque: Joint torques more, of (time, q, v).
        delivered: Torque of the motors, of the commanded one.
        read: Readings of the encoders, of the true positions, (n, joints).
        push: Who pushes in one of the recordings, or None.
        command_delay: Of the drives, s.
        sensor_delay: Of the encoders, s.
        turns: Rate over which the robot's own dry friction turns; 0 for MuJoCo's.
    """

    damping: Mapping[str, float] = field(default_factory=dict)
    dry: Mapping[str, float] = field(default_factory=dict)
    fade: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    armature: Mapping[str, float] = field(default_factory=dict)
    payload: tuple[str, float, tuple[float, float, float]] | None = None
    tilt: tuple[float, float] = (0.0, 0.0)
    rotor: tuple[str, float, float, float, float] | None = None
    torque: Law | None = None
    delivered: Callable[[np.ndarray], np.ndarray] = lambda torque: torque
    read: Callable[[np.ndarray], np.ndarray] = lambda q: q
    push: 'Push | None' = None
    command_delay: float = 0.0
    sensor_delay: float = 0.0
    turns: float = TURNS


@dataclass(frozen=True)
class Push:
    """A force at a point of a link, a half sine of time.

    Attributes:
        link: Which.
        point: In its frame, m.
        force: Its largest, in the frame of the base, N.
        middle: When it is that, s.
        width: How long it lasts, s.
        recording: In which it happens.
    """

    link: str
    point: tuple[float, float, float]
    force: tuple[float, float, float]
    middle: float
    width: float
    recording: int

    def act(self, data: mujoco.MjData) -> None:
        """Acts at this instant."""
        late, body = (data.time - self.middle) / self.width, data.body(self.link)
        force = np.cos(np.pi * late) * np.array(self.force) if abs(late) < 0.5 else np.zeros(3)
        place = body.xpos + body.xmat.reshape(3, 3) @ self.point
        body.xfrc_applied[:] = [*force, *np.cross(place - body.xipos, force)]


@dataclass(frozen=True)
class Recording:
    """Rows of a robot: s; rad or m, as its encoders say; N m or N, as its drives were told."""

    time: np.ndarray
    position: np.ndarray
    effort: np.ndarray
    rates: np.ndarray  # true ones; no recording has them


def compiled(robot: Robot, secret: Secret, step: float) -> mujoco.MjModel:
    """The engine's model."""
    extension = (
        '<mujoco><compiler fusestatic="false" discardvisual="true" balanceinertia="false" '
        'boundmass="0" boundinertia="0"/></mujoco>'
    )
    spec = mujoco.MjSpec.from_string(robot.urdf.replace('</robot>', f'{extension}</robot>'))
    if secret.payload:
        link, mass, place = secret.payload
        load = spec.body(link).add_body(name='payload', pos=place)
        # Without a place of its own, the centre would be put at `pos` once more.
        load.ipos, load.iquat = [0, 0, 0], [1, 0, 0, 0]
        load.mass, load.inertia, load.explicitinertial = mass, [POINT] * 3, True
    if secret.rotor:
        rotor = spec.worldbody.add_body(name='rotor')
        rotor.mass, rotor.inertia, rotor.explicitinertial = POINT, [POINT] * 3, True
        rotor.add_joint(name='rotor', armature=secret.rotor[1])
    for joint in spec.joints:
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.solref_friction = [REST, 1]
        joint.solimp_friction = [0.99, 0.999, 1e-6, 0.5, 2]
    model = spec.compile()
    for name in robot.joints:
        dof = model.joint(name).dofadr[0]
        model.dof_damping[dof] += secret.damping.get(name, 0.0)
        if secret.turns:  # _own_friction has it
            model.dof_frictionloss[dof] = 0.0
        model.dof_frictionloss[dof] += secret.dry.get(name, 0.0)
        model.dof_armature[dof] += secret.armature.get(name, 0.0)
    # A base turned by x, then by y: what falls turns the other way in its frame.
    (sx, sy), (cx, cy) = np.sin(secret.tilt), np.cos(secret.tilt)
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    model.opt.gravity = (about_y @ about_x).T @ [0, 0, -9.81]
    model.opt.timestep = step
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return model


def record(robot: Robot, secret: Secret, seed: int, number: int = 0) -> Recording:
    """A robot moves, from rest.

    Args:
        robot: The robot.
        secret: What is wrong with it.
        seed: Of its way and its noise.
        number: Of the recording.
    """
    push = secret.push if secret.push and secret.push.recording == number else None
    hard = bool(secret.dry or secret.fade or not secret.turns)
    stiff = secret.rotor is not None and secret.rotor[4] > 0
    row = 1 / robot.rate
    step = row / round(row / (FINE if stiff or hard else ENGINE))
    model = compiled(robot, secret, step)
    data = mujoco.MjData(model)
    place = [model.joint(name).dofadr[0] for name in robot.joints]
    drives = [robot.place(name) for name in robot.driven]
    # Where a motor turns apart from its joint, it is the motor that is driven and controlled.
    motors = list(place)
    if secret.rotor:
        joint, (k, d, gap) = robot.place(secret.rotor[0]), secret.rotor[2:]
        motors[joint] = model.joint('rotor').dofadr[0]
    command = _controlled(robot, model, place, seed) if not robot.push else _pushed(robot, seed)
    rows, steps = round(robot.seconds * robot.rate) + 1, round(row / step)
    time = np.arange(rows) * row
    fine = np.zeros(((rows - 1) * steps + 1, len(place)))
    effort, rates = np.zeros((2, rows, len(place)))
    late = round(secret.command_delay / step)
    pipe: list[np.ndarray] = []
    dry = model.dof_frictionloss.copy()
    own = robot.friction()

    def forces(model: mujoco.MjModel, data: mujoco.MjData) -> None:
        # At each stage of a step: a law held over a step would lag by half of it.
        if secret.turns:
            v = data.qvel[place]
            data.qfrc_passive[place] -= own * v / np.hypot(v, secret.turns)
        if secret.torque:
            data.qfrc_passive[place] += secret.torque(
                data.time, data.qpos[place], data.qvel[place]
            )
        if secret.rotor:
            a, b = motors[joint], place[joint]
            wound = data.qpos[a] - data.qpos[b]
            wound -= np.clip(wound, -gap / 2, gap / 2)
            apart = gap == 0 or wound != 0
            coupled = k * wound + d * (data.qvel[a] - data.qvel[b]) * apart
            data.qfrc_passive[b] += coupled
            data.qfrc_passive[a] -= coupled

    mujoco.mj_forward(model, data)
    mujoco.set_mjcb_passive(forces)
    try:
        for i in range(rows):
            rates[i] = data.qvel[place]
            effort[i, drives] = command(time[i], data.qpos[motors], data.qvel[motors])[drives]
            for s in range(steps if i + 1 < rows else 0):
                fine[i * steps + s] = data.qpos[place]
                pipe.append(effort[i])
                told = pipe[max(0, len(pipe) - 1 - late)]
                data.qfrc_applied[:] = 0
                data.qfrc_applied[motors] = secret.delivered(told)
                for name, (more, rate) in secret.fade.items():
                    dof = model.joint(name).dofadr[0]
                    faded = np.exp(-((data.qvel[dof] / rate) ** 2))
                    model.dof_frictionloss[dof] = dry[dof] + more * faded
                if push:
                    push.act(data)
                mujoco.mj_step(model, data)
        fine[-1] = data.qpos[place]
    finally:
        mujoco.set_mjcb_passive(None)
    before = np.maximum(np.arange(rows) * steps - secret.sensor_delay / step, 0.0)
    ticks = np.arange(len(fine))
    true = np.column_stack([np.interp(before, ticks, fine[:, j]) for j in range(len(place))])
    random = np.random.default_rng([seed, 1])
    seen = secret.read(true) + robot.noise * random.standard_normal(true.shape)
    counts = np.array(robot.counts)
    return Recording(time, np.round(seen * counts) / counts, effort, rates)


def inertias(model: mujoco.MjModel) -> np.ndarray:
    """Mass matrix at 0."""
    data, whole = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, whole)
    return whole


def _controlled(robot: Robot, model: mujoco.MjModel, place: list[int], seed: int) -> Callable:
    """Control along a way, with a bandwidth of 4 Hz and the mass matrix at 0."""
    way, _ = wander(
        np.random.default_rng(seed), len(place), np.array(robot.reach), *robot.frequencies
    )
    inertia, bandwidth = inertias(model)[np.ix_(place, place)], 2 * np.pi * 4.0

    def command(time: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        where, how_fast = way(time)
        return inertia @ (bandwidth**2 * (where - q) + 2 * bandwidth * (how_fast - v))

    return command


def _pushed(robot: Robot, seed: int) -> Callable:
    """A torque of random phases at the first joint, which a soft spring draws back to 0."""
    random = np.random.default_rng(seed)
    w = 2 * np.pi * np.linspace(*robot.frequencies, 14) * random.uniform(0.97, 1.03, 14)
    phase = random.uniform(0, 2 * np.pi, 14)
    size = robot.push * np.sqrt(2 / 14)

    def command(time: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        torque = np.zeros(len(q))
        torque[0] = size * np.sin(w * time + phase).sum()
        torque[0] -= robot.push * (q[0] / robot.reach[0] + 0.1 * v[0] / robot.reach[0])
        return torque

    return command


@dataclass(frozen=True)
class Usual:
    """What a joint does in a sound machine: RMS of torque and rate, largest torque, inertia."""

    torque: np.ndarray
    rate: np.ndarray
    largest: np.ndarray
    inertia: np.ndarray


@functools.cache
def usual(name: str) -> Usual:
    """Of a robot by its name."""
    robot = ROBOTS[name]
    seen = record(robot, Secret(), 1)
    model = compiled(robot, Secret(), ENGINE)
    place = [model.joint(joint).dofadr[0] for joint in robot.joints]
    torque = np.sqrt(np.mean(seen.effort**2, axis=0))
    # A joint without a drive moves by what speeds it up.
    inertia = np.diag(inertias(model))[place]
    moved = inertia * np.std(np.gradient(seen.rates, seen.time, axis=0), axis=0)
    torque = np.where(torque > 0, torque, moved)
    return Usual(
        torque, np.sqrt(np.mean(seen.rates**2, axis=0)), np.abs(seen.effort).max(axis=0),
        inertia,
    )  # fmt: skip


def at_joint(robot: Robot, joint: str, law: Callable[[float, float], float]) -> Secret:
    """A torque of its position and rate."""
    j = robot.place(joint)

    def torque(time: float, q: np.ndarray, v: np.ndarray) -> np.ndarray:
        more = np.zeros_like(q)
        more[j] = law(q[j], v[j])
        return more

    return Secret(torque=torque)


def of_motor(robot: Robot, joint: str, law: Callable[[float], float]) -> Secret:
    """A torque of its motor by the one that was commanded."""
    j = robot.place(joint)

    def delivered(torque: np.ndarray) -> np.ndarray:
        changed = torque.copy()
        changed[j] = law(torque[j])
        return changed

    return Secret(delivered=delivered)


def of_encoder(robot: Robot, joint: str, law: Callable[[np.ndarray], np.ndarray]) -> Secret:
    """A reading of its position by the true one."""
    j = robot.place(joint)

    def read(q: np.ndarray) -> np.ndarray:
        seen = q.copy()
        seen[:, j] = law(q[:, j])
        return seen

    return Secret(read=read)


def either(random: np.random.Generator, low: float, high: float) -> float:
    """A size with a random sign."""
    return float(random.choice([-1, 1]) * random.uniform(low, high))


Wrong = Callable[[Robot, str, np.random.Generator], tuple[Secret, dict[str, float]]]


def _numbers(robot: Robot, joint: str) -> tuple[float, float, float, float]:
    found, j = usual(robot.name), robot.place(joint)
    return found.torque[j], found.rate[j], found.largest[j], found.inertia[j]


def viscous(robot, joint, random):
    torque, rate, _, _ = _numbers(robot, joint)
    coefficient = random.uniform(0.1, 0.3) * torque / rate
    return Secret(damping={joint: coefficient}), {'coefficient': coefficient}


def coulomb(robot, joint, random):
    level = random.uniform(0.1, 0.3) * _numbers(robot, joint)[0]
    return Secret(dry={joint: level}), {'torque': level}


def stribeck(robot, joint, random):
    torque, rate, _, _ = _numbers(robot, joint)
    more, fades = random.uniform(0.15, 0.35) * torque, random.uniform(0.15, 0.4) * rate
    return Secret(fade={joint: (more, fades)}), {'torque': more, 'stribeck_rate': fades}


def payload(robot, link, random):
    mass = float(random.uniform(0.5, 0.9)) * CARRIED[robot.name]
    place = tuple(x + random.uniform(-0.02, 0.02) for x in TIPS[robot.name])
    values = {'mass': mass, **dict(zip('xyz', place, strict=True))}
    return Secret(payload=(link, mass, place)), values


def rotor(robot, joint, random):
    inertia = random.uniform(0.4, 0.9) * _numbers(robot, joint)[3]
    return Secret(armature={joint: inertia}), {'inertia': inertia}


def constant(robot, joint, random):
    error = either(random, 0.1, 0.25)
    return of_motor(robot, joint, lambda u: (1 + error) * u), {'error': error}


def bias(robot, joint, random):
    more = either(random, 0.1, 0.3) * _numbers(robot, joint)[0]
    return of_motor(robot, joint, lambda u: u + more), {'bias': more}


def saturation(robot, joint, random):
    limit = random.uniform(0.45, 0.65) * _numbers(robot, joint)[2]
    return of_motor(robot, joint, lambda u: np.clip(u, -limit, limit)), {'limit': limit}


def command_delay(robot, site, random):
    late = round(random.uniform(0.005, 0.015) / ENGINE) * ENGINE
    return Secret(command_delay=late), {'delay': late}


def sensor_delay(robot, site, random):
    late = float(random.uniform(0.005, 0.015))
    return Secret(sensor_delay=late), {'delay': late}


def cogging(robot, joint, random):
    amplitude = random.uniform(0.15, 0.35) * _numbers(robot, joint)[0]
    reach = robot.reach[robot.place(joint)]
    cycles = float(random.integers(*np.ceil(np.array([2.5, 6.0]) * np.pi / reach)))
    phase = random.uniform(0.1, 3.0)
    law = at_joint(robot, joint, lambda q, v: amplitude * np.sin(cycles * q + phase))
    return law, {'amplitude': amplitude, 'cycles': cycles, 'phase': phase}


def eccentricity(robot, channel, random):
    amplitude, phase = random.uniform(0.015, 0.03), random.uniform(-3, 3)
    joint = channel.removesuffix('_position')
    law = of_encoder(robot, joint, lambda q: q + amplitude * np.sin(q + phase))
    return law, {'amplitude': amplitude, 'phase': phase}


def offset(robot, channel, random):
    zero = either(random, 0.015, 0.04)
    return of_encoder(robot, channel.removesuffix('_position'), lambda q: q + zero), {
        'offset': zero
    }


def slope(robot, site, random):
    x, y = either(random, 0.015, 0.04), either(random, 0.015, 0.04)
    if robot.name in ('arm2', 'cartpole'):
        x = 0.0  # about which nothing turns there
    return Secret(tilt=(x, y)), {'x': x, 'y': y}


def flexible(robot, joint, random):
    torque, _, _, inertia = _numbers(robot, joint)
    stiffness = torque / random.uniform(0.01, 0.03)
    turning = random.uniform(0.15, 0.4) * inertia
    damping = 2 * random.uniform(0.1, 0.3) * np.sqrt(stiffness * turning)
    values = {'stiffness': stiffness, 'rotor_inertia': turning, 'damping': damping}
    return Secret(rotor=(joint, turning, stiffness, damping, 0.0)), values


def play(robot, joint, random):
    _, _, largest, inertia = _numbers(robot, joint)
    gap = random.uniform(0.012, 0.03) * (0.2 if robot.slides(joint) else 1.0)
    stiffness, turning = largest / TEETH_DEFLECTION, random.uniform(0.15, 0.4) * inertia
    damping = 0.6 * np.sqrt(stiffness * turning)
    values = {'gap': gap, 'rotor_inertia': turning, 'stiffness': stiffness, 'damping': damping}
    return Secret(rotor=(joint, turning, stiffness, damping, gap)), values


def push(robot, link, random):
    model = compiled(robot, Secret(), ENGINE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    near = TIPS[robot.name] if link == robot.tip else model.body(link).ipos
    point = near + random.uniform(-0.02, 0.02, 3)
    body, jacobian = data.body(link), np.zeros((3, model.nv))
    place = body.xpos + body.xmat.reshape(3, 3) @ point
    mujoco.mj_jac(model, data, jacobian, None, place, body.id)
    direction = random.standard_normal(3)
    torque = (jacobian.T @ direction)[[model.joint(j).dofadr[0] for j in robot.joints]]
    # A multiple of the torque that a joint has anyway, where it is largest by that measure.
    most = np.max(np.abs(torque) / usual(robot.name).torque)
    force = direction * random.uniform(1.0, 2.5) / most
    middle, width = random.uniform(0.3, 0.7) * robot.seconds, random.uniform(0.08, 0.2)
    number = int(random.integers(robot.records))
    secret = Push(link, tuple(point), tuple(force), float(middle), float(width), number)
    return Secret(push=secret), {'instant': secret.middle, 'recording': number}


# Effect of the library -> what is wrong. Of friction the file has none at that joint.
EFFECTS: dict[str, Wrong] = {
    'viscous_friction': viscous,
    'coulomb_friction': coulomb,
    'stribeck_friction': stribeck,
    'payload': payload,
    'rotor_inertia': rotor,
    'torque_constant': constant,
    'torque_bias': bias,
    'torque_saturation': saturation,
    'actuator_delay': command_delay,
    'sensor_delay': sensor_delay,
    'cogging_torque': cogging,
    'encoder_eccentricity': eccentricity,
    'encoder_offset': offset,
    'ground_slope': slope,
    'joint_flexibility': flexible,
    'backlash': play,
    'external_push': push,
}
CARRIED = {
    'arm2': 1.58,
    'leg3': 0.4,
    'cartpole': 0.236,
    'furuta': 0.121,
    'arm6': 1.4,
    'small_furuta': 0.02,
}  # kg
TIPS = {
    'arm2': (0.0, 0.0, -0.03), 'leg3': (0.0, 0.0, -0.02), 'cartpole': (0.0, 0.0, -0.55),
    'furuta': (0.01, 0.0, -0.29), 'arm6': (0.0, 0.05, 0.06), 'small_furuta': (0.004, 0.0, -0.125),
}  # fmt: skip
JOINT = (
    'viscous_friction', 'coulomb_friction', 'stribeck_friction', 'torque_constant',
    'torque_bias', 'torque_saturation', 'cogging_torque', 'joint_flexibility', 'backlash',
)  # fmt: skip
WHOLE = ('actuator_delay', 'sensor_delay', 'ground_slope')


def sites(robot: Robot, effect: str) -> tuple[str, ...]:
    """Where recordings of a robot can show an effect.

    Not: a rotor at the first joint, as that is inertia of its link; an offset of the encoder of
    the last one, as that is its link's mass turned about the joint, nor of one that no force tells
    from another angle; the torque constant of an only drive, as all masses are in its unit.
    """
    first, last = robot.joints[0], robot.joints[-1]
    if effect in WHOLE:
        return ('all',)
    if effect == 'payload':
        return (robot.tip,)
    if effect == 'external_push':
        return (*robot.links[:-1], robot.tip)
    if effect == 'rotor_inertia':
        return tuple(j for j in robot.driven if j != first)
    if effect == 'encoder_offset':
        still = () if robot.name in ('arm2', 'leg3') else (first,)
        told = [j for j in robot.joints if j not in (*still, last)]
        return tuple(f'{j}_position' for j in told)
    if effect == 'encoder_eccentricity':
        return tuple(f'{j}_position' for j in robot.joints if not robot.slides(j))
    if effect == 'torque_constant' and len(robot.driven) == 1:
        return ()
    if effect == 'viscous_friction':
        return robot.joints
    return robot.driven


def right(robot: Robot, effect: str, site: str) -> tuple[tuple[str, str], ...]:
    """What is right as a name: (effect, site).

    A delay is late torque as well as late readings. A robot in a plane, tilted in it, and one
    whose first encoder is off fall alike. A rail that is not level pulls its cart.
    """
    also = {
        'actuator_delay': (('sensor_delay', 'all'),),
        'sensor_delay': (('actuator_delay', 'all'),),
    }.get(effect, ())
    if (robot.name, effect) in (('cartpole', 'ground_slope'), ('cartpole', 'torque_bias')):
        also = (('ground_slope', 'all'), ('torque_bias', 'cart_joint'))
    if robot.name == 'arm2' and effect in ('ground_slope', 'encoder_offset'):
        also = (('ground_slope', 'all'), ('encoder_offset', 'shoulder_joint_position'))
    if (robot.name, effect, site) == ('leg3', 'encoder_offset', 'abduction_joint_position'):
        also = (('ground_slope', 'all'),)
    return ((effect, site), *also)


def with_small_faults(robot: Robot, secret: Secret, random: np.random.Generator) -> Secret:
    """The same with a millisecond of delay, encoders a little off, and friction that is harder."""
    zero = 3e-4 * random.choice([-1.0, 1.0], len(robot.joints))
    return replace(
        secret, command_delay=secret.command_delay + 1e-3, turns=secret.turns / 2,
        read=lambda q: secret.read(q) + zero,
    )  # fmt: skip
