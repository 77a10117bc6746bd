"""A drive led over a serial CAN adapter, against a device in another process."""

import time

import pytest

pytest.importorskip('canopen')

from emulated_robot import Emulated

from cg_hardware.drive.can_drive import CanDrive, DriveError
from cg_hardware.drive.cia402 import State

pytestmark = pytest.mark.alone

PERIOD = 0.002  # s
AT_MOST = 0.02  # s from a fault to zero torque


@pytest.fixture
def robot(tmp_path):
    with Emulated(tmp_path) as robot:
        yield robot


@pytest.fixture
def drive(robot):
    drive = CanDrive(robot.bus, node=1, sign=-1.0, gear=0.5)
    yield drive
    drive.close()


def spin(drive, seconds, torque=0.0, until=lambda: False):
    """Cycles in real time; ends early when `until` holds, and says whether it did."""
    following = time.monotonic()
    end = following + seconds
    while time.monotonic() < end and not until():
        drive.cycle(torque)
        drive.await_answer(PERIOD / 2)
        following += PERIOD
        time.sleep(max(0.0, following - time.monotonic()))
    return until()


def enabled(drive, torque=0.0):
    for _ in range(5):  # a machine that is too busy for real time looks like a fault
        drive.enable()
        if spin(drive, 2.0, torque, lambda: drive.enabled or not drive.wanted) and drive.enabled:
            return
    raise AssertionError(drive.reason)


def test_nothing_acts_before_a_person_enables(robot, drive):
    spin(drive, 0.1, torque=5.0)
    assert drive.state == State.DISABLED
    assert robot.report()['changes'] == []
    enabled(drive, torque=5.0)
    spin(drive, 0.1, torque=5.0)
    # 5 N m at the joint are -250 of 1000 where 40 N m of the motor are 20 N m at the joint.
    assert robot.report()['acting'] == -250
    assert drive.answers[-1].torque == pytest.approx(5.0)
    drive.disable('enough')
    spin(drive, 0.05, torque=5.0)
    assert robot.report()['acting'] == 0
    assert drive.reason == 'enough'


def test_every_cycle_is_answered_with_position_and_feet(robot, drive):
    spin(drive, 0.3)
    drive.answers.clear()
    spin(drive, 1.0)
    assert 450 <= len(drive.answers) <= 501
    answer = drive.answers[-1]
    assert answer.counts == 12_345
    assert answer.inputs == 1 << 16  # the inner feet stand
    stamps = [a.sync_ns for a in drive.answers]
    assert stamps == sorted(set(stamps))


def test_a_fault_stays_one_until_a_person_says_otherwise(robot, drive):
    enabled(drive, 4.0)
    robot.ask('hold')
    robot.ask('drive_fault 0x7121')
    assert spin(drive, 2.0, 4.0, lambda: not drive.wanted)
    assert drive.reason == 'motor blocked (0x7121)'
    robot.report()
    spin(drive, 0.3, 4.0)
    assert robot.report()['changes'] == []
    assert drive.state == State.FAULT
    enabled(drive, 4.0)
    spin(drive, 0.05, 4.0)
    assert robot.report()['acting'] == -200


def test_a_host_that_falls_silent_costs_the_torque(robot, drive):
    enabled(drive, 4.0)
    spin(drive, 0.1, 4.0)
    robot.report()
    time.sleep(0.2)  # the host is busy
    report = robot.report()
    assert (report['state'], report['acting']) == ('fault', 0)
    spin(drive, 0.2, 4.0)
    assert not drive.wanted
    assert drive.reason in (
        'heartbeat of the host is missing (0x8130)', 'commands on the bus are missing (0x8250)',
        'the drive is silent',
    )  # fmt: skip
    assert robot.report()['changes'] == []


def test_a_drive_that_falls_silent_is_given_up(robot, drive):
    enabled(drive, 4.0)
    spin(drive, 0.1, 4.0)
    robot.report()
    robot.ask('can_silent')
    assert spin(drive, 1.0, 4.0, lambda: not drive.wanted)
    assert drive.reason == 'the drive is silent'
    spin(drive, 0.1, 4.0)
    robot.ask('can_back')
    spin(drive, 0.2, 4.0)
    assert robot.report()['acting'] == 0
    assert not drive.wanted


def test_a_drive_that_was_switched_off_is_set_up_anew(robot, drive):
    enabled(drive)
    robot.ask('drive_off')
    assert spin(drive, 1.0, until=lambda: not drive.wanted)
    robot.ask('drive_on')
    spin(drive, 0.2)
    assert drive.state is None  # its mapping is gone
    drive.close()
    again = CanDrive(robot.bus, node=1)
    try:
        enabled(again, 4.0)
        spin(again, 0.05, 4.0)
        assert robot.report()['acting'] == 100
    finally:
        again.close()


def test_a_bus_that_is_pulled_is_an_error_and_can_be_closed(robot, drive):
    enabled(drive, 4.0)
    spin(drive, 0.1, 4.0)
    robot.ask('can_unplug')
    with pytest.raises(DriveError, match='drive 1'):
        spin(drive, 2.0, 4.0)
    assert 'the bus is gone' in drive.reason or drive.reason == 'the drive is silent'
    drive.close()
    time.sleep(0.2)
    assert robot.report()['acting'] == 0


def test_what_is_not_there_is_named(tmp_path, robot):
    with pytest.raises(DriveError, match=r'slcan:.*nothing'):
        CanDrive({'interface': 'slcan', 'channel': str(tmp_path / 'nothing')}, 1)
    with pytest.raises(DriveError, match=r'drive 5 on slcan:.*[Nn]o SDO response'):
        CanDrive(robot.bus, 5)
    with pytest.raises(DriveError, match='carrier_pigeon'):
        CanDrive({'interface': 'carrier_pigeon', 'channel': 'x'}, 1)
