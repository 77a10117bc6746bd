"""Native parameters of a MuJoCo model, each with the effect of our library that it stands for.

What no parameter of the robot's bodies, joints, tendons, actuators and sensors expresses is not
here: a peer that identifies one fixed structure cannot name it.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from mujoco import sysid

from cg_dynamics.effects import LIBRARY
from peers import Case
from peers.mujoco_robot import CHANNELS, put_body

BIG = 1e3
CYCLES = tuple(range(4, 64, 2))


@dataclass
class Native:
    """One or more native parameters that one effect of our library stands for.

    Attributes:
        effect: The effect.
        start: Where the search sets out, in units of `write`'s change worth noticing.
        low: Lower bounds.
        high: Upper bounds.
        write: Puts values into a spec; None for parameters of sensors.
        read: Changes the simulated channels (n, 3), given the values and the sampling time.
    """

    effect: str
    start: Sequence[float]
    low: Sequence[float]
    high: Sequence[float]
    write: Callable | None = None
    read: Callable | None = None


def joint(name, attribute, place, scale):
    def write(spec, z):
        found = spec.joint(name)
        if found is None:
            return
        if place is None:
            setattr(found, attribute, scale * z[0])
        else:
            values = np.array(getattr(found, attribute))
            values[place] = scale * z[0]
            setattr(found, attribute, values)

    return write


def tendons(attribute, place, scale, relative=False, names=('spring',)):
    def write(spec, z):
        for tendon in spec.tendons:
            if tendon.name.startswith(names):
                values = np.array(getattr(tendon, attribute))
                values[place] = scale * z[0] * (tendon.stiffness[0] if relative else 1.0)
                setattr(tendon, attribute, values)

    return write


def channel(index, scale, relative):
    """Gain or bias of a sensor, by sysid.apply_gain and apply_bias."""

    def read(ts, z):
        change = scale * z[0]
        parameter = sysid.Parameter('change', 1 + change if relative else change, -10, 10)
        apply = sysid.apply_gain if relative else sysid.apply_bias
        return apply(ts, CHANNELS[index], parameter)

    return read


def delayed(indices, scale):
    def read(ts, z):
        for index in indices:
            ts = sysid.apply_delay(ts, CHANNELS[index], sysid.Parameter('d', scale * z[0], -1, 1))
        return ts

    return read


def motor(**changes):
    def write(spec, z):
        for name, change in changes.items():
            setattr(spec.actuator('motor'), name, change(z))

    return write


def _prm(index, value):
    found = np.zeros(10)
    found[0] = 1.0
    found[index] = value
    return found


def filtered(spec, z):
    found = spec.actuator('motor')
    found.dyntype = mujoco.mjtDyn.mjDYN_FILTER
    found.dynprm = _prm(0, max(0.01 * z[0], 1e-6))


def bias(spec, z):
    spec.actuator('motor').biasprm = [0.1 * z[0]] + [0.0] * 9


def limited(spec, z):
    found = spec.actuator('motor')
    found.forcelimited, found.forcerange = 1, [-z[0], z[0]]


def slope(spec, z, g=9.81):
    spec.option.gravity = [g * np.sin(0.01 * z[0]), 0, -g * np.cos(0.01 * z[0])]


def passive(**fields):
    """A motor that nobody commands: its cogging or its friction acts on the hip."""

    def write(spec, z):
        found = spec.actuator('passive') or spec.add_actuator(name='passive')
        found.trntype, found.target = mujoco.mjtTrn.mjTRN_JOINT, 'hip'
        found.gear = np.array(spec.actuator('motor').gear)
        found.set_to_dcmotor(motorconst=[1e-6, 1e-6], resistance=1.0,
                             **{name: make(z) for name, make in fields.items()})  # fmt: skip

    return write


NATIVE = [
    Native('torque_constant', [1], [-15], [40], motor(gainprm=lambda z: _prm(0, 1 + 0.05 * z[0]))),
    Native('torque_bias', [1], [-BIG], [BIG], bias),
    Native('actuator_delay', [1], [0], [25],
           motor(delay=lambda z: 0.004 * z[0], nsample=lambda z: 60, interp=lambda z: 1)),
    Native('actuator_lag', [1], [0.01], [30], filtered),
    Native('torque_saturation', [8], [0.5], [100], limited),
    Native('rotor_inertia', [1], [0], [BIG], joint('hip', 'armature', None, 0.02)),
    Native('quadratic_friction', [1], [-BIG], [BIG], joint('hip', 'damping', 1, 0.1)),
    Native('ankle_friction', [1], [-BIG], [BIG], joint('stance', 'damping', 0, 0.2)),
    Native('foot_compliance', [1], [-BIG], [BIG], joint('stance', 'stiffness', 0, 1.0)),
    Native('aerodynamic_drag', [1], [-BIG], [BIG],
           tendons('damping', 1, 0.1, names=('inner', 'outer'))),
    Native('spring_damping', [1], [-BIG], [BIG], tendons('damping', 0, 0.2)),
    Native('spring_nonlinearity', [1], [-20], [BIG], tendons('stiffness', 2, 0.05, True)),
    Native('ground_slope', [1], [-30], [30], slope),
    Native('imu_offset', [1], [-BIG], [BIG], read=channel(0, 0.005, False)),
    Native('imu_scale', [1], [-50], [50], read=channel(0, 0.01, True)),
    Native('gyro_bias', [1], [-BIG], [BIG], read=channel(1, 0.01, False)),
    Native('gyro_scale', [1], [-50], [50], read=channel(1, 0.01, True)),
    Native('encoder_offset', [1], [-BIG], [BIG], read=channel(2, 0.005, False)),
    Native('encoder_scale', [1], [-50], [50], read=channel(2, 0.01, True)),
    Native('sensor_delay', [1], [0], [25], read=delayed((0, 1, 2), 0.004)),
    Native('imu_lag', [1], [0], [25], read=delayed((0, 1), 0.004)),
    # Its bristles are as stiff as the sampling time allows, its level far out is small.
    Native('stribeck_friction', [1, 1], [0, 0.2], [BIG, 10],
           passive(lugre=lambda z: [60.0, 0.5, 0.1, 0.1 + 0.5 * z[0], 0.3 * z[1]])),
    Native('coulomb_friction', [1], [0], [BIG], joint('hip', 'frictionloss', None, 0.5)),
    Native('viscous_friction', [1], [-BIG], [BIG], joint('hip', 'damping', 0, 0.2)),
    Native('presliding_friction', [1, 1], [0, 0.2], [BIG, 100],
           passive(lugre=lambda z: [50.0 * z[1], 0.0, max(0.5 * z[0], 1e-3),
                                    max(0.5 * z[0], 1e-3), 1.0])),
]  # fmt: skip


def natives(case: Case) -> list[list[Native]]:
    """All that a MuJoCo model can have and the nominal one has not; a ripple by two phases."""
    present = {effect.name for effect in case.nominal.effects}
    found = [[n] for n in NATIVE if n.effect in LIBRARY and n.effect not in present]
    for leg in ('inner', 'outer'):
        for distance in (0.2, 0.6, 1.0):

            def load(spec, z, leg=leg):
                put_body(spec.body(f'load_{leg}'), max(0.5 * z[0], 1e-9), z[1], 1e-12)

            found.append([Native('payload', [1, distance], [0, 0], [BIG, 3], load)])
    ripple = passive(cogging=lambda z: [0.4 * z[0], 5 * z[1], z[2]])
    found += [
        [Native('cogging_torque', [1, cycles / 5, phase], [0, 0.2, -10], [BIG, 80, 10], ripple)
         for phase in (0.0, np.pi / 2)]
        for cycles in CYCLES
    ]  # fmt: skip
    return found
