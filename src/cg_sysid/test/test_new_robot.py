"""The model file that `cg new-robot` makes of a URDF."""

from cg_description.robot_description import parse
from cg_dynamics.model import Model
from cg_sysid.cli.new_robot import template

CART_POLE = """<robot name="cart_pole"><link name="rail"/>
  <link name="cart"><inertial><mass value="0.9"/>
    <inertia ixx="2e-3" iyy="3e-3" izz="3e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="pole"><inertial><origin xyz="0 0 -0.3"/><mass value="0.2"/>
    <inertia ixx="7e-3" iyy="7e-3" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="slide" type="prismatic"><parent link="rail"/><child link="cart"/>
    <axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="20" velocity="4"/>
    <dynamics damping="2.5" friction="0.6"/></joint>
  <joint name="hinge" type="continuous"><parent link="cart"/><child link="pole"/>
    <axis xyz="0 1 0"/><dynamics damping="0.003"/></joint></robot>"""


def test_friction_of_a_joint_without_a_drive_is_in_the_file():
    model = Model.from_text(template(parse(CART_POLE), ['slide'], [], 'cart_pole.urdf'))
    assert model.mechanism.inputs == ('slide_effort',)
    values = {name: value for name, value in model.values.items() if '.' in name}
    assert values['viscous_friction@slide.coefficient'] == 2.5
    assert values['coulomb_friction@slide.torque'] == 0.6
    assert values['viscous_friction@hinge.coefficient'] == 0.003
    assert model.declarations['viscous_friction@slide.coefficient'].unit == 'N s/m'
    assert model.declarations['viscous_friction@hinge.coefficient'].unit == 'N m s/rad'
