"""A cart on a rail, which a drive moves, and a pole that swings from it freely."""

import numpy as np

from cg_dynamics.rig import Setup
from cg_sysid.experiments.rehearsal import rehearse

CART_POLE = """\
format: cg_model/1
name: cart_pole
mechanism: urdf
robot:
  driven: [slide]
  urdf: |
    <robot name="cart_pole"><link name="rail"/>
    <link name="cart"><inertial><mass value="0.94"/><origin xyz="0.01 0 0.02"/>
    <inertia ixx="0.002" iyy="0.003" izz="0.004" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <link name="pole"><inertial><mass value="0.24"/><origin xyz="0 0.01 -0.29"/>
    <inertia ixx="0.007" iyy="0.007" izz="0.0001" ixy="0" ixz="0" iyz="0"/></inertial></link>
    <joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/>
    <axis xyz="1 0 0"/><limit effort="20" velocity="4" lower="-2" upper="2"/></joint>
    <joint name="pivot" type="continuous"><parent link="cart"/><child link="pole"/>
    <axis xyz="0 1 0"/></joint></robot>
effects:
- {name: viscous_friction, at: slide, parameters: {coefficient: {value: 3.0, unit: N s/m}}}
- {name: viscous_friction, at: pivot, parameters: {coefficient: {value: 0.003, unit: N m s/rad}}}
sensors:
  slide_position: {noise: {value: 2.0e-5, unit: m}}
  pivot_position: {noise: {value: 4.0e-4, unit: rad}}
"""


def ride(machine, k):
    return rehearse(
        f'ride_{k}', machine, Setup(), [0.0, 0.2 + 0.1 * k, 0.0, 0.0],
        [lambda t: 7.0 * np.sin((4.0 + k) * t) + 5.0 * np.sin(9.0 * t)], 6.0, 0.004, k,
    )  # fmt: skip
