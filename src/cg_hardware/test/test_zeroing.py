"""The hip's zero by the index of the encoder, against a drive in another process."""

import time

import pytest

pytest.importorskip('canopen')

from emulated_robot import Emulated, wait_longer
from test_can_drive import enabled, spin

from cg_hardware.drive.can_drive import CanDrive
from cg_hardware.drive.cia402 import State
from cg_hardware.drive.homing import Homing
from cg_hardware.drive.index_by_hand import IndexByHand
from cg_hardware.drive.settings import DriveSettings

pytestmark = pytest.mark.alone

# Inner legs on a stand; the outer ones hang, and the hip is 0.06 rad short of the index.
HANGING = '--model compass_gait_mit --state 0 0 --setup'.split()
SETUP = 'stance: inner\nfixture: inner_fixed\n'
INDEX = 191  # counts of the encoder from where the legs hang parallel, 0.06 rad


@pytest.fixture
def robot(tmp_path):
    with Emulated(tmp_path, *HANGING, SETUP) as robot:
        yield robot


@pytest.fixture
def drive(robot, monkeypatch):
    wait_longer(monkeypatch)
    drive = CanDrive(robot.bus, node=1)
    spin(drive, 0.1)
    yield drive
    drive.close()


def homing(drive, **settings):
    plan = DriveSettings(**settings).homing_plan(drive.scale.per_mille)
    drive.lead_through(Homing(plan, drive.objects))
    return drive.procedure


def hip(drive):
    """By the counts that the drive woke up with, rad."""
    spin(drive, 0.02)
    return (drive.answers[-1].counts - 12_345) * 3.14159265e-4


def turn(robot, drive, to):
    robot.ask(f'turn {to - hip(drive)}')
    deadline = time.monotonic() + 20.0
    while abs(hip(drive) - to) > 1e-3:
        assert time.monotonic() < deadline


def over(drive, patience=30.0):
    assert spin(drive, patience, until=lambda: drive.procedure.over)
    procedure, drive.procedure = drive.procedure, None
    return procedure


def homed(robot, drive, begins=0.0, meanwhile=None, **settings):
    """A homing that is over, from an angle of the hip in rad; `meanwhile` once it moves."""
    robot.ask('hold')
    turn(robot, drive, begins)
    homing(drive, **settings)
    if meanwhile is not None:
        moves = lambda: abs(drive.answers[-1].torque) > 0.2 or drive.procedure.over  # noqa: E731
        assert spin(drive, 10.0, until=moves)
        meanwhile(robot, drive)
    return over(drive)


def left_as_it_was(robot, drive):
    """Without torque, and fit for torque again."""
    spin(drive, 0.1)
    report = robot.report()
    assert (report['state'], report['acting']) == ('switch on disabled', 0)
    assert drive.objects.read(0x6061) == 10
    assert drive.objects.read(0x6072) == 1000


@pytest.mark.parametrize(('method', 'begins'), [(34, 0.0), (33, 0.2)])
def test_the_drive_goes_to_the_index_and_its_counts_are_zero_there(robot, drive, method, begins):
    done = homed(robot, drive, begins, homing_method=method)
    assert (done.failure, done.index, done.tidy) == ('', 0, True)
    left_as_it_was(robot, drive)
    robot.ask('hold')
    spin(drive, 0.2)
    at = robot.report()['hip'] / 3.14159265e-4
    assert drive.answers[-1].counts == pytest.approx(at - INDEX, abs=4)  # of noise


@pytest.mark.parametrize('method', [35, 37])
def test_home_may_be_where_the_hip_is(robot, drive, method):
    done = homed(robot, drive, homing_method=method)
    assert (done.failure, done.index) == ('', 0)
    left_as_it_was(robot, drive)


def go_silent(robot, drive):
    robot.ask('can_silent')


WRONG = {
    'cancelled': (lambda robot, drive: drive.disable('emergency stop'), 'emergency stop'),
    'drive_fault': (lambda robot, _: robot.ask('drive_fault 0x8611'), 'following error (0x8611)'),
    'silent': (go_silent, 'the drive is silent'),
    'blocked': (lambda robot, _: robot.ask('hold'), 'the drive reports a homing error'),
}


@pytest.mark.parametrize('what', WRONG)
def test_whatever_ends_a_homing_it_ends_without_torque_and_says_why(robot, drive, what):
    happens, why = WRONG[what]
    # To the index the other way round: nearly a whole turn.
    settings = {'homing_method': 33, 'homing_travel': 6.0, 'homing_speed': 0.3}
    done = homed(robot, drive, meanwhile=happens, **settings)
    robot.ask('can_back')
    assert done.failure == why
    assert done.index is None
    assert done.in_doubt
    spin(drive, 0.1)
    assert robot.report()['acting'] == 0


@pytest.mark.parametrize(
    ('settings', 'why'),
    [
        ({'homing_travel': 0.05}, 'no index within 159 counts'),
        ({'homing_travel': 0.0, 'homing_timeout': 1.0, 'homing_speed': 0.01}, 'not done within'),
    ],
)
def test_an_index_that_does_not_come_is_not_sought_for_ever(robot, drive, settings, why):
    done = homed(robot, drive, homing_method=33, **settings)
    assert why in done.failure
    left_as_it_was(robot, drive)


def test_homing_is_gentle(robot, drive):
    """Torque is limited while the drive homes, and not afterwards."""
    done = homed(robot, drive, homing_method=33, homing_torque=1.0, homing_travel=0.0)
    # 1 N m does not lift the leg as far as it should go.
    assert done.failure == 'the drive reports a homing error'
    changes = [torque for _, torque in robot.report()['changes']]
    assert max(map(abs, changes)) == 25
    left_as_it_was(robot, drive)


def test_what_the_drive_has_not_is_named_and_nothing_moves(robot, drive):
    robot.ask('drive_lacks 0x6098')
    assert 'object 0x6098:0' in homed(robot, drive).failure
    assert robot.report()['changes'] == []
    left_as_it_was(robot, drive)


def test_a_fault_from_before_is_reset_by_whoever_asks_for_homing(robot, drive):
    robot.ask('drive_fault 0x2310')
    assert spin(drive, 5.0, until=lambda: drive.state == State.FAULT)
    assert homed(robot, drive, homing_method=37).failure == ''


@pytest.mark.parametrize('way', [0.2, -0.2])
def test_a_person_turns_the_hip_through_the_index(robot, drive, way):
    turn(robot, drive, 0.06 - way / 2)  # to one side of it
    drive.lead_through(IndexByHand(drive.objects, 20.0))
    spin(drive, 0.5)
    assert not drive.procedure.over
    robot.ask(f'turn {way}')
    done = over(drive)
    assert (done.failure, done.in_doubt) == ('', False)
    assert done.index == 12_345 + INDEX  # latched on the way, whatever the shaft did then
    assert robot.report()['changes'] == []
    left_as_it_was(robot, drive)


def test_an_index_that_nobody_turns_through_is_given_up(robot, drive):
    drive.lead_through(IndexByHand(drive.objects, 1.0))
    done = over(drive)
    assert (done.index, done.failure) == (None, 'not done within 1 s')
    drive.lead_through(IndexByHand(drive.objects, 60.0))
    spin(drive, 0.2)
    drive.disable('~/disable was called')
    assert over(drive).failure == '~/disable was called'
    assert drive.objects.read(0x60B8) == 0


def test_after_homing_there_is_torque_as_before(robot, drive):
    assert homed(robot, drive, homing_method=37).failure == ''
    robot.report()
    enabled(drive, 4.0)
    spin(drive, 0.05, 4.0)
    assert 100 in robot.acted()
