"""A finger on one knuckle: 1/15 000 of a leg's inertia, and a drive that nobody has told of."""

import numpy as np

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare

FINGER = """\
format: cg_model/1
name: finger
mechanism: urdf
robot:
  urdf: |
    <robot name="finger"><link name="palm"/>
    <link name="tip"><inertial><mass value="0.03"/><origin xyz="0.004 0 -0.04"/>
    <inertia ixx="1.5e-5" iyy="1.6e-5" izz="2e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="knuckle" type="continuous"><parent link="palm"/><child link="tip"/>
    <axis xyz="0 1 0"/></joint></robot>
effects:
- {name: viscous_friction, parameters: {coefficient: {value: 2.0e-4, unit: N m s/rad}}}
sensors:
  knuckle_position: {noise: {value: 4.0e-4, unit: rad}}
"""


def finger():
    return Model.from_text(FINGER)


def data(machine, count, seconds=4.0):
    return prepare(finger(), [
        rehearse(
            f'record_{k}', machine, Setup(), [0.3 - 0.2 * k, 0.0],
            [lambda t, k=k: 0.005 * np.sin((9.0 + k) * t) + 0.003 * np.sin((23.0 - k) * t)],
            seconds, 0.004, k,
        )
        for k in range(count)
    ])  # fmt: skip
