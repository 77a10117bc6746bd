"""Whether a robot may be torqued: every way into a fault, and the one way out."""

import pytest

from cg_hardware.lifecycle import Lifecycle, Signs, Stage

FINE = Signs(lean=0.02, requests=True)


def active(**settings):
    robot = Lifecycle(arming=True, fall_angle=0.6, **settings)
    robot.see(Signs(silent=('imu',)))
    assert robot.line == 'unconfigured: imu not heard'
    robot.see(Signs(lean=0.02))
    assert (robot.line, robot.passes) == ('idle', False)
    assert robot.arm() == ''
    assert robot.line == 'armed: waits for torque requests'
    robot.see(Signs(lean=0.02))
    assert robot.passes
    robot.see(FINE)
    assert robot.line == 'active'
    return robot


@pytest.mark.parametrize(
    ('signs', 'line'),
    [
        (Signs(stopped=True, requests=True), 'fault: emergency stop'),
        (Signs(silent=('imu', 'drive'), requests=True), 'fault: imu, drive not heard'),
        (Signs(lean=-0.61, requests=True),
         'fault: the robot has fallen: the stance leg leans by -0.61 rad'),
        (Signs(doubt='torque of hip is nan', requests=False), 'fault: torque of hip is nan'),
        (Signs(lean=0.0, requests=False), 'fault: torque requests stopped'),
    ],
)  # fmt: skip
def test_a_fault_stays_until_a_person_resets_and_arms(signs, line):
    robot = active()
    robot.see(signs)
    assert (robot.line, robot.passes) == (line, False)
    robot.see(FINE)  # whatever it was is over
    assert (robot.line, robot.passes) == (line, False)
    assert 'only an idle robot' in robot.arm()
    assert robot.reset() == ''
    robot.see(FINE)
    assert (robot.stage, robot.passes) == (Stage.IDLE, False)
    assert robot.arm() == ''
    assert robot.passes


def test_a_robot_that_waits_for_its_controller_is_not_at_fault():
    robot = Lifecycle(arming=True)
    robot.see(Signs())
    robot.arm()
    for _ in range(5):
        robot.see(Signs())
    assert robot.stage == Stage.ARMED
    assert robot.line == 'armed: waits for torque requests'


def test_a_robot_that_lies_is_not_armed():
    robot = Lifecycle(arming=True, fall_angle=0.6)
    robot.see(Signs(lean=1.2))
    robot.see(Signs(lean=1.2))
    assert robot.arm() == 'not armed: the robot has fallen: the stance leg leans by 1.20 rad'
    robot.see(Signs(lean=0.1))
    assert robot.arm() == ''


def test_the_stop_holds_against_arming():
    robot = active()
    robot.stop()
    assert robot.line == 'fault: emergency stop'
    robot.reset()
    robot.arm()
    robot.see(Signs(stopped=True))
    assert robot.line == 'fault: emergency stop'


def test_disarmed_it_is_idle():
    robot = active()
    robot.disarm()
    assert robot.line == 'idle: disarmed'
    assert 'there is no fault' in robot.reset()


def test_without_arming_faults_end_with_their_cause():
    robot = Lifecycle(arming=False, fall_angle=0.6)
    assert robot.passes
    robot.see(FINE)
    assert robot.line == 'active'
    robot.see(Signs(lean=1.0))
    assert not robot.passes
    robot.see(FINE)
    assert robot.passes
    robot.see(Signs(stopped=True))
    robot.see(FINE)
    assert robot.line == 'fault: emergency stop'
    robot.reset()
    assert robot.passes
    robot.see(Signs())  # requests pause: in simulation nobody minds
    assert robot.line == 'armed'
