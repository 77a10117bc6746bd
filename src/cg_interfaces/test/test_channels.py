"""Channels: the pitch of a quaternion, and what messages declare absent."""

from types import SimpleNamespace as Message

import numpy as np
import pytest
from cart_pole import CartPole
from two_joint_arm import TwoJointArm

from cg_dynamics.mechanisms.compass_gait import CompassGait
from cg_interfaces import channels

IMU = channels.mechanism('compass_gait').topics['/imu']
JOINTS = channels.mechanism('double_pendulum').topics['/joint_states']


@pytest.mark.parametrize('heading', [0.0, 1.0, -3.0])
@pytest.mark.parametrize('pitch', np.linspace(-3.1, 3.1, 15))
def test_pitch_does_not_depend_on_the_heading(pitch, heading):
    # Hamilton product of a yaw about z and a pitch about the y of the turned frame.
    _, y, _, w = channels.quaternion_from_pitch(pitch)
    z, c = np.sin(heading / 2), np.cos(heading / 2)
    turned = (-z * y, c * y, z * w, c * w)
    assert channels.pitch_from_quaternion(*turned) == pytest.approx(pitch, abs=1e-14)


def imu(w=1.0, orientation_known=0.0, rate_known=0.0):
    return Message(
        orientation=Message(x=0.0, y=0.0, z=0.0, w=w),
        orientation_covariance=[orientation_known] * 9,
        angular_velocity=Message(x=0.0, y=0.5, z=0.0),
        angular_velocity_covariance=[rate_known] * 9,
    )


def test_covariance_minus_one_means_absent():
    assert channels.extract(imu(), IMU) == {'imu_angle': 0.0, 'imu_rate': 0.5}
    assert channels.extract(imu(rate_known=-1.0), IMU) == {'imu_angle': 0.0}
    assert channels.extract(imu(orientation_known=-1.0), IMU) == {'imu_rate': 0.5}


def test_an_orientation_never_filled_is_refused():
    with pytest.raises(ValueError, match='unit quaternion'):
        channels.extract(imu(w=0.0), IMU)


def test_joints_are_found_by_name_not_by_place():
    message = Message(name=['elbow', 'other', 'shoulder'], position=[2.0, 9.0, 1.0])
    assert channels.extract(message, JOINTS) == {'shoulder_angle': 1.0, 'elbow_angle': 2.0}
    assert channels.extract(Message(name=['elbow'], position=[]), JOINTS) == {}


def test_fewer_values_than_names_are_refused():
    with pytest.raises(ValueError, match='1 values for 2 joint names'):
        channels.extract(Message(name=['shoulder', 'elbow'], position=[1.0]), JOINTS)


def test_a_body_outside_the_table_has_the_sensors_of_its_joints():
    arm = channels.interface(TwoJointArm())
    assert arm.joints == ('shoulder',)
    assert [(c.name, c.place) for c in arm.outputs[0].channels] == [
        ('shoulder_position', 'position[shoulder]'),
        ('elbow_position', 'position[elbow]'),
        ('shoulder_velocity', 'velocity[shoulder]'),
        ('elbow_velocity', 'velocity[elbow]'),
    ]
    assert arm.position_of('shoulder_effort') == 'shoulder_position'
    # The sensor of a joint that is driven has its name, not that of the coordinate.
    cart = channels.interface(CartPole())
    assert [c.place for c in cart.outputs[0].channels] == ['position[rail]', 'position[pole]']
    assert channels.interface(CompassGait()) is channels.mechanism('compass_gait')


def test_a_sensor_that_is_none_of_a_joint_needs_a_row():
    class Walker(CompassGait):
        name = 'walker'

    with pytest.raises(ValueError, match="walker: output 'imu_angle' is no encoder or tacho"):
        channels.interface(Walker())


def test_effort_stands_beside_the_positions():
    topic = channels.interface(TwoJointArm()).topics_with_effort['/joint_states']
    message = Message(
        name=['gripper', 'elbow', 'shoulder'],
        position=[9.0, 2.0, 1.0],
        velocity=[],
        effort=[9.0, np.nan, 0.5],
    )
    assert channels.extract(message, topic) == {
        'shoulder_position': 1.0,
        'elbow_position': 2.0,
        'shoulder_effort': 0.5,
    }
    assert '/joint_states' not in channels.mechanism('compass_gait').topics_with_effort


def test_unknown_names_list_the_known():
    with pytest.raises(ValueError, match='compass_gait, pendulum, double_pendulum'):
        channels.mechanism('cart_pole')
    with pytest.raises(ValueError, match='hip_angle'):
        channels.mechanism('compass_gait').channel('knee_angle')
