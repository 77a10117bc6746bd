"""Robots of a URDF in MuJoCo, with secrets: what a lab would record of a machine that is not ours.

The rigid bodies, the integrator, dry friction, damping, armature and payloads are MuJoCo's. Other
laws are functions of the caller's that act on joints at every step of the engine.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import mujoco
import numpy as np

SAMPLE = 0.002  # s, between two commands and two readings
ENGINE = 0.0005  # s, between two steps of the engine
Law = Callable[[float, np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def nothing(time: float, q: np.ndarray, v: np.ndarray, torque: np.ndarray) -> np.ndarray:
    """No torque more."""
    return np.zeros_like(q)


@dataclass(frozen=True)
class Secret:
    """What a machine has that its URDF does not say; joints and links by name.

    Attributes:
        damping: Joint -> viscous friction, N m s/rad.
        dry: Joint -> dry friction, N m: MuJoCo's frictionloss.
        armature: Joint -> inertia of the rotor seen from the joint, kg m^2.
        payload: (link, mass in kg, place in its frame in m), or None.
        torque: Joint torques more, of (time, q, v, commanded torque), each of all joints.
        delivered: Torque of the motors, of (time, commanded torque).
        read: Readings of the encoders, of (time, true positions), each (n,) and (n, joints).
        delay: Of the drives, s.
    """

    damping: Mapping[str, float] = field(default_factory=dict)
    dry: Mapping[str, float] = field(default_factory=dict)
    armature: Mapping[str, float] = field(default_factory=dict)
    payload: tuple[str, float, tuple[float, float, float]] | None = None
    torque: Law = nothing
    delivered: Callable[[float, np.ndarray], np.ndarray] = lambda time, torque: torque
    read: Callable[[np.ndarray, np.ndarray], np.ndarray] = lambda time, q: q
    delay: float = 0.0


@dataclass(frozen=True)
class Recording:
    """What was recorded: rows of SAMPLE.

    Attributes:
        time: s, shape (n,).
        position: Of each joint in the order asked for, rad or m, shape (n, joints).
        effort: Torque that each drive was told to give, N m or N, held until the next row.
    """

    time: np.ndarray
    position: np.ndarray
    effort: np.ndarray


def compiled(urdf: str, secret: Secret) -> 'mujoco.MjModel':
    """The engine's model of a robot."""
    extension = (
        '<mujoco><compiler fusestatic="false" discardvisual="true" balanceinertia="false" '
        'boundmass="0" boundinertia="0"/></mujoco>'
    )
    spec = mujoco.MjSpec.from_string(urdf.replace('</robot>', f'{extension}</robot>'))
    if secret.payload:
        link, mass, place = secret.payload
        load = spec.body(link).add_body(name='payload', pos=place)
        load.ipos, load.iquat = [0, 0, 0], [1, 0, 0, 0]  # by default once more where the body is
        load.mass, load.inertia, load.explicitinertial = mass, [1e-9, 1e-9, 1e-9], True
    for joint in spec.joints:
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
        joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
        # Dry friction as stiff as the engine can hold it.
        joint.solref_friction, joint.solimp_friction = [0.002, 1], [0.99, 0.999, 1e-6, 0.5, 2]
    model = spec.compile()
    for k in range(model.njnt):
        dof, name = model.jnt_dofadr[k], model.joint(k).name
        model.dof_damping[dof] = secret.damping.get(name, 0.0)
        model.dof_frictionloss[dof] = secret.dry.get(name, 0.0)
        model.dof_armature[dof] = secret.armature.get(name, 0.0)
    model.opt.timestep = ENGINE
    model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return model


def record(
    urdf: str,
    joints: tuple[str, ...],
    command: Callable[[float, np.ndarray, np.ndarray], np.ndarray],
    seconds: float,
    start: np.ndarray,
    secret: Secret = Secret(),
    noise: float = 0.0,
    counts: float = 0.0,
    seed: int = 0,
) -> Recording:
    """A robot moves, from rest.

    Args:
        urdf: Its description.
        joints: All that move, in the order of the rows.
        command: Torque of each joint from time and the true positions and rates.
        seconds: How long.
        start: Positions at the start.
        secret: What the URDF does not say.
        noise: Standard deviation of a reading.
        counts: Counts of an encoder per rad or m; 0 for one without steps.
        seed: Of the noise.
    """
    model = compiled(urdf, secret)
    data = mujoco.MjData(model)
    place = [model.joint(name).dofadr[0] for name in joints]
    data.qpos[place] = start
    mujoco.mj_forward(model, data)
    rows, steps = round(seconds / SAMPLE) + 1, round(SAMPLE / ENGINE)
    time = np.arange(rows) * SAMPLE
    position, effort = np.zeros((2, rows, len(joints)))
    pipe: list[np.ndarray] = []  # what was told before each step of the engine
    late = round(secret.delay / ENGINE)
    held = np.zeros(len(joints))

    def forces(model: 'mujoco.MjModel', data: 'mujoco.MjData') -> None:
        # At each stage of a step: a law held over a step would lag by half of it.
        more = secret.torque(data.time, data.qpos[place], data.qvel[place], held)
        data.qfrc_passive[place] += more

    mujoco.set_mjcb_passive(forces)
    try:
        for k in range(rows):
            position[k] = data.qpos[place]
            effort[k] = command(time[k], position[k], data.qvel[place].copy())
            for i in range(steps if k + 1 < rows else 0):
                pipe.append(effort[k])
                told = pipe[max(0, len(pipe) - 1 - late)]
                held[:] = secret.delivered(time[k] + i * ENGINE, told)
                data.qfrc_applied[place] = held
                mujoco.mj_step(model, data)
    finally:
        mujoco.set_mjcb_passive(None)
    random = np.random.default_rng(seed)
    seen = secret.read(time, position) + noise * random.standard_normal(position.shape)
    if counts:
        seen = np.round(seen * counts) / counts
    return Recording(time, seen, effort)


def wander(
    random: np.random.Generator, joints: int, reach: np.ndarray, slowest: float, fastest: float
) -> tuple[Callable[[float], tuple[np.ndarray, np.ndarray]], np.ndarray]:
    """A smooth way for each joint: five sines, from rest at the first instant on.

    Args:
        random: Draws it.
        joints: How many.
        reach: How far each goes from 0, shape (joints,).
        slowest: Lowest frequency in Hz.
        fastest: Highest.

    Returns:
        Position and rate at a time, and the position at 0.
    """
    w = 2 * np.pi * random.uniform(slowest, fastest, (joints, 5))
    phase, size = random.uniform(0, 2 * np.pi, (joints, 5)), random.uniform(0.3, 1.0, (joints, 5))
    size *= reach[:, None] / size.sum(axis=1, keepdims=True)

    def at(time: float) -> tuple[np.ndarray, np.ndarray]:
        grown = 1 - np.exp(-((time / 0.5) ** 2))
        growing = 2 * time / 0.25 * np.exp(-((time / 0.5) ** 2))
        wave = (size * np.sin(w * time + phase)).sum(axis=1)
        slope = (size * w * np.cos(w * time + phase)).sum(axis=1)
        return grown * wave, grown * slope + growing * wave

    return at, np.zeros(joints)
