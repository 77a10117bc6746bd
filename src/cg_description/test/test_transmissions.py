"""Drives by the transmissions of a URDF, as ROS 1 and as ROS 2 write them."""

import pytest

from cg_description.robot_description import RobotDescriptionError
from cg_description.transmissions import couplings, driven_joints

LINK = (
    '<link name="{}"><inertial><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
)
JOINT = '<joint name="{}" type="continuous"><parent link="{}"/><child link="{}"/></joint>'
TREE = ''.join([
    '<link name="base"/>', *map(LINK.format, 'abc'), JOINT.format('lift', 'base', 'a'),
    JOINT.format('roll', 'a', 'b'), JOINT.format('pitch', 'b', 'c'),
])  # fmt: skip
ROS_2 = """<ros2_control name="wrist" type="system">
  <joint name="roll"><command_interface name="effort"/></joint>
  <joint name="pitch"><command_interface name="effort"/></joint>
  <joint name="lift"><state_interface name="position"/></joint>
  <transmission name="wrist"><plugin>transmission_interface/{kind}</plugin>
    <actuator name="motor_2" role="actuator2"/><actuator name="motor_1" role="actuator1"/>
    <joint name="pitch" role="joint2">
      <mechanical_reduction>{reduction}</mechanical_reduction></joint>
    <joint name="roll" role="joint1"><mechanical_reduction>10</mechanical_reduction></joint>
  </transmission></ros2_control>"""
ROS_1 = """<transmission name="wrist">
  <type>transmission_interface/DifferentialTransmission</type>
  <actuator name="roll"><role>actuator1</role>
    <mechanicalReduction>-1.0</mechanicalReduction></actuator>
  <actuator name="pitch_motor"><role>actuator2</role></actuator>
  <joint name="roll"><role>joint1</role><mechanicalReduction>1.0</mechanicalReduction></joint>
  <joint name="pitch"><role>joint2</role><mechanicalReduction>-1</mechanicalReduction></joint>
  </transmission>"""


def urdf(transmissions: str) -> str:
    return f'<robot name="wrist">{TREE}{transmissions}</robot>'


def ros_2(kind: str, reduction: str = '50') -> str:
    return urdf(ROS_2.format(kind=kind, reduction=reduction))


def test_joints_with_a_command_have_a_drive_and_so_have_those_of_a_transmission():
    assert driven_joints(ros_2('DifferentialTransmission')) == ['roll', 'pitch']
    assert driven_joints(urdf(ROS_1)) == ['roll', 'pitch']
    assert driven_joints(urdf('')) == []


def test_motors_of_a_differential_turn_with_the_sum_and_the_difference():
    assert couplings(ros_2('DifferentialTransmission')) == {
        'motor_1': {'roll': 10.0, 'pitch': 50.0}, 'motor_2': {'roll': 10.0, 'pitch': -50.0},
    }  # fmt: skip
    assert couplings(urdf(ROS_1)) == {
        'roll_motor': {'roll': 1.0, 'pitch': -1.0}, 'pitch_motor': {'roll': 1.0, 'pitch': 1.0},
    }  # fmt: skip


def test_of_a_four_bar_linkage_the_second_motor_turns_with_both():
    assert couplings(ros_2('FourBarLinkageTransmission')) == {
        'motor_2': {'roll': 1.0, 'pitch': 50.0}
    }


def test_what_couples_nothing_is_left_out():
    assert couplings(ros_2('SimpleTransmission')) == {}
    assert couplings(urdf(ROS_1.replace('joint name="pitch"', 'joint name="yaw"'))) == {}
    assert couplings(urdf(ROS_1.replace('<joint name="pitch">', '<joint>'))) == {}


@pytest.mark.parametrize('reduction', ['0', 'ten', 'nan'])
def test_a_reduction_that_is_none_is_named(reduction):
    with pytest.raises(RobotDescriptionError, match=f"'wrist': joint 'pitch'.*'{reduction}'"):
        couplings(ros_2('DifferentialTransmission', reduction))
