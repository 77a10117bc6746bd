"""Reading any URDF: what matters of it survives, and what cannot be used is named."""

import math

import pytest

from cg_description.robot_description import (
    Inertial,
    RobotDescriptionError,
    parse,
    rotation,
    with_inertials,
)

ARM = """<?xml version="1.0"?>
<robot name="arm">
  <!-- two joints, a welded tip, a gear -->
  <link name="base"><visual><geometry><box size="1 1 1"/></geometry></visual></link>
  <link name="upper"><inertial><origin xyz="0 0 0.1" rpy="0 0 1.5707963267948966"/>
    <mass value="2"/>
    <inertia ixx="0.02" iyy="0.03" izz="0.01" ixy="0.001" ixz="0" iyz="0"/></inertial></link>
  <link name="lower"><inertial><mass value="1.5"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.005" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="tip"/><link name="finger"/>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>
    <origin xyz="0 0 0.3"/><axis xyz="0 2 0"/><dynamics damping="0.4" friction="0.2"/></joint>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <limit lower="-2" upper="2.5" effort="30" velocity="4"/><axis xyz="0 1 0"/></joint>
  <joint name="weld" type="fixed"><parent link="lower"/><child link="tip"/>
    <origin xyz="0 0 0.25"/></joint>
  <joint name="grip" type="prismatic"><parent link="tip"/><child link="finger"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.1" effort="5" velocity="1"/>
    <mimic joint="elbow" multiplier="0.01" offset="0.02"/></joint>
</robot>"""


def test_a_tree_is_read_parents_first():
    robot = parse(ARM)
    assert robot.root == 'base'
    assert [j.name for j in robot.joints] == ['shoulder', 'elbow', 'weld', 'grip']
    assert [j.name for j in robot.independent] == ['shoulder', 'elbow']
    shoulder, elbow, _, grip = robot.joints
    assert (shoulder.lower, shoulder.upper, shoulder.effort) == (-2, 2.5, 30)
    assert elbow.axis == (0, 1, 0)
    assert (elbow.damping, elbow.friction, elbow.effort) == (0.4, 0.2, math.inf)
    assert grip.slides
    assert grip.mimic == ('elbow', 0.01, 0.02)


def test_an_inertia_is_turned_into_the_frame_of_its_link():
    # A quarter turn about z swaps x and y, and the sign of xy.
    assert parse(ARM).inertials['upper'] == Inertial(
        2.0, (0.0, 0.0, 0.1), pytest.approx((0.03, 0.02, 0.01, -0.001, 0.0, 0.0))
    )


def test_what_is_written_reads_back_equal():
    robot = parse(ARM)
    assert parse(robot.text()) == robot


def test_an_axis_that_is_not_of_unit_length_reads_back_equal():
    for seed in range(20):
        axis = ' '.join(repr(math.sin(9.0 * seed + k)) for k in range(3))
        robot = parse(ARM.replace('<axis xyz="0 1 0"/>', f'<axis xyz="{axis}"/>'))
        assert parse(robot.text()) == robot


def test_new_inertias_leave_all_else_as_it_is():
    new = Inertial(3.0, (0.01, 0.02, 0.03), (0.1, 0.2, 0.25, 0.01, 0.02, 0.03))
    text = with_inertials(ARM, {'upper': new, 'tip': new})
    robot = parse(text)
    assert robot.inertials['upper'] == new
    assert robot.inertials['tip'] == new
    assert robot.inertials['lower'] == parse(ARM).inertials['lower']
    assert '<box size="1 1 1"' in text
    assert 'two joints, a welded tip' in text
    with pytest.raises(RobotDescriptionError, match=r"no link 'hand'.*base, upper"):
        with_inertials(ARM, {'hand': new})


def test_right_angles_are_right():
    assert rotation((0, math.pi / 2, 0)) == [[0, 0, 1], [0, 1, 0], [-1, 0, 0]]


@pytest.mark.parametrize(
    ('old', 'new', 'words'),
    [
        ('<robot name="arm">', '<robot name="arm"', 'no XML'),
        ('<?xml version="1.0"?>', '<!DOCTYPE robot [<!ENTITY a "b">]>', 'document type'),
        ('type="continuous"', 'type="floating"', "joint 'elbow': type 'floating'.*that float"),
        ('type="continuous"', 'type="hinge"', "type 'hinge' is not one of revolute"),
        ('xyz="0 2 0"', 'xyz="0 2"', "'elbow': <axis xyz='0 2'>; three numbers"),
        ('xyz="0 2 0"', 'xyz="0 0 0"', "'elbow': its axis has no length"),
        ('xyz="0 2 0"', 'xyz="0 inf 0"', 'three finite numbers'),
        ('mass value="2"', 'mass value="-2"', "link 'upper': mass -2 kg"),
        ('mass value="2"', 'mass value="heavy"', "'upper': <mass value='heavy'>; no number"),
        ('child link="tip"', 'child link="top"', "'weld' holds a link 'top'"),
        ('child link="tip"', 'child link="upper"', "'upper' hangs on two joints.*loops"),
        ('parent link="base"', 'parent link="finger"', 'do not hang on the base: elbow, shoulder'),
        ('mimic joint="elbow"', 'mimic joint="weld"', "'grip' follows 'weld'"),
        ('link name="tip"', 'link name="lower"', "two links are called 'lower'"),
        ('<robot name="arm">', '<sdf name="arm">', 'no XML|is no <robot>'),
        ('<link name="finger"/>', '<x:leg xmlns:x="http://ros.org/xacro"/>', 'run `xacro` on'),
        ('<parent link="upper"/>', '', "joint 'elbow': no <parent"),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_named(old, new, words):
    assert old in ARM
    with pytest.raises(RobotDescriptionError, match=words):
        parse(ARM.replace(old, new))


def test_a_joint_loop_without_a_base_is_named():
    text = """<robot name="r"><link name="a"/><link name="b"/>
      <joint name="j" type="revolute"><parent link="a"/><child link="b"/></joint>
      <joint name="k" type="revolute"><parent link="b"/><child link="a"/></joint></robot>"""
    with pytest.raises(RobotDescriptionError, match='form a loop'):
        parse(text)
