"""A drive led over a serial CAN adapter, against a device in another process."""

import threading
import time

import pytest

pytest.importorskip('canopen')

from emulated_robot import Emulated, wait_longer

from cg_hardware.drive.can_drive import CanDrive
from cg_hardware.drive.cia402 import State
from cg_hardware.drive.objects import DriveError
from cg_hardware.drive.watch import WATCHES, Guarding

pytestmark = pytest.mark.alone

PERIOD = 0.002  # s
AT_MOST = 0.02  # s from a fault to zero torque
# What a machine that is too busy for real time looks like.
HELD_UP = (
    'the drive is silent', 'heartbeat of the host is missing (0x8130)',
    'commands on the bus are missing (0x8250)',
)  # fmt: skip


@pytest.fixture
def robot(tmp_path):
    with Emulated(tmp_path) as robot:
        yield robot


@pytest.fixture
def drive(robot, monkeypatch):
    """One that a busy host may hold up: for what is not about time."""
    wait_longer(monkeypatch)
    drive = CanDrive(robot.bus, node=1, sign=-1.0, gear=0.5)
    yield drive
    drive.close()


@pytest.fixture
def prompt(robot):
    """One that is lost as soon as in use."""
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
    deadline = time.monotonic() + 20.0
    while not drive.enabled:
        assert time.monotonic() < deadline, drive.reason
        drive.enable()
        # A machine that is too busy for real time looks like a fault.
        spin(drive, 2.0, torque, lambda: drive.enabled or not drive.wanted)
        spin(drive, 0.05, torque)


def test_nothing_acts_before_a_person_enables(robot, drive):
    spin(drive, 0.1, torque=5.0)
    assert drive.state == State.DISABLED
    assert robot.report()['changes'] == []
    enabled(drive, torque=5.0)
    spin(drive, 0.1, torque=5.0)
    # 5 N m at the joint are -250 of 1000 where 40 N m of the motor are 20 N m at the joint.
    assert -250 in robot.acted()
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
    assert -200 in robot.acted()


def test_a_host_that_falls_silent_costs_the_torque(robot, prompt):
    enabled(prompt, 4.0)
    spin(prompt, 0.1, 4.0)
    robot.report()
    time.sleep(0.2)  # the host is busy
    report = robot.report()
    assert (report['state'], report['acting']) == ('fault', 0)
    spin(prompt, 0.2, 4.0)
    assert not prompt.wanted
    assert prompt.reason in HELD_UP
    assert robot.report()['changes'] == []


@pytest.mark.parametrize('watch', WATCHES)
def test_a_drive_that_no_longer_sees_its_host_takes_the_torque_off(robot, watch):
    drive = CanDrive(robot.bus, node=1, watch=watch)
    try:
        drive.objects.write(0x1400, 5, 0, 2)  # it does not miss commands: this is about the host
        enabled(drive, 4.0)
        spin(drive, 0.1, 4.0)
        drive._watches.cycle = lambda: None
        assert spin(drive, 2.0, 4.0, lambda: not drive.wanted)
        assert drive.reason in (*HELD_UP, 'the drive does not answer node guarding')
        assert spin(drive, 2.0, 4.0, lambda: drive.state == State.FAULT)
        report = robot.report()
        assert (report['state'], report['acting']) == ('fault', 0)
    finally:
        drive.close()


def test_a_drive_that_does_not_answer_guarding_is_given_up(robot):
    drive = CanDrive(robot.bus, node=1, watch='guarding')
    try:
        enabled(drive, 4.0)
        drive.objects.write(0x1017, 0, 100, 2)  # it has a heart again, and is not guarded then
        assert spin(drive, 2.0, 4.0, lambda: not drive.wanted)
        assert drive.reason in ('the drive does not answer node guarding', *HELD_UP)
    finally:
        drive.close()


def test_guarding_wants_the_bit_to_turn_over():
    class Network:
        send_lock = threading.Lock()

        def __init__(self):
            self.sent, self.bus = [], self

        def send(self, message):
            self.sent.append((message.arbitration_id, message.is_remote_frame, message.dlc))

    now = [0.0]
    guarding = Guarding(Network(), 5, lambda: now[0])
    assert guarding.problem == ''
    for k in range(100):
        now[0] = 1.0 + 0.002 * k
        guarding.cycle()
        if k % 2 and k < 50:
            guarding._on_answer(0x705, bytearray([(k // 2 % 2) << 7 | 5]), 0.0)
        if k > 49:
            guarding._on_answer(0x705, bytearray([(24 % 2) << 7 | 5]), 0.0)  # the last one again
        if k != 57:  # 16 ms after the last that was new
            assert (guarding.problem == '') == (k < 57)
    assert guarding.network.sent == [(0x705, True, 1)] * 50


def test_outputs_are_set_as_far_as_they_are_the_hosts(robot):
    drive = CanDrive(robot.bus, node=1, output_mask=0b101)
    try:
        drive.outputs = 0b111
        spin(drive, 0.1)
        assert robot.report()['outputs'] == 0b101
        drive.outputs = 0
        spin(drive, 0.1)
        assert robot.report()['outputs'] == 0
        drive.outputs = 0b100
        spin(drive, 0.1)
    finally:
        drive.close()
    time.sleep(0.1)
    assert robot.report()['outputs'] == 0


def test_a_drive_that_falls_silent_is_given_up(robot, prompt):
    enabled(prompt, 4.0)
    spin(prompt, 0.1, 4.0)
    robot.report()
    robot.ask('can_silent')
    assert spin(prompt, 1.0, 4.0, lambda: not prompt.wanted)
    assert prompt.reason == 'the drive is silent'
    spin(prompt, 0.1, 4.0)
    robot.ask('can_back')
    spin(prompt, 0.2, 4.0)
    assert robot.report()['acting'] == 0
    assert not prompt.wanted


def test_garbage_between_frames_costs_at_most_a_frame(robot, drive):
    enabled(drive, 4.0)
    drive.answers.clear()
    for _ in range(20):
        robot.ask('can_garbage 40')  # nearly always with bytes that are no text
        spin(drive, 0.02, 4.0)
    assert drive.reason == ''
    assert len(drive.answers) > 100  # of 200
    robot.ask('can_garbage 1000')
    drive.answers.clear()
    assert spin(drive, 2.0, 4.0, lambda: len(drive.answers) > 20)


def test_noise_on_the_line_is_a_silent_drive_and_can_end(robot, prompt):
    for _ in range(5):  # a busy machine is late by itself
        enabled(prompt, 4.0)
        spin(prompt, 0.1, 4.0)
        before = robot.report()
        robot.ask('can_noise 1000000000')
        assert spin(prompt, 1.0, 4.0, lambda: not prompt.wanted)
        spin(prompt, 0.05, 4.0)
        report = robot.report()
        robot.ask('can_noise 0')
        assert spin(prompt, 2.0, until=lambda: prompt.state is not None)
        took = report['changes'][-1][0] - before['time']
        if took < AT_MOST + PERIOD:  # from a report, which is a cycle old at most
            break
    assert report['acting'] == 0
    assert took < AT_MOST + PERIOD


def test_a_drive_that_was_switched_off_is_set_up_anew(robot, prompt):
    enabled(prompt)
    robot.ask('drive_off')
    assert spin(prompt, 1.0, until=lambda: not prompt.wanted)
    robot.ask('drive_on')
    spin(prompt, 0.2)
    assert prompt.state is None  # its mapping is gone
    prompt.close()
    again = CanDrive(robot.bus, node=1)
    try:
        enabled(again, 4.0)
        spin(again, 0.05, 4.0)
        assert 100 in robot.acted()
    finally:
        again.close()


def test_a_bus_that_is_pulled_is_an_error_and_can_be_closed(robot, prompt):
    enabled(prompt, 4.0)
    spin(prompt, 0.1, 4.0)
    robot.ask('can_unplug')
    with pytest.raises(DriveError, match='drive 1'):
        spin(prompt, 2.0, 4.0)
    assert 'the bus is gone' in prompt.reason or prompt.reason == 'the drive is silent'
    prompt.close()
    time.sleep(0.2)
    assert robot.report()['acting'] == 0


def test_what_is_not_there_is_named(tmp_path, robot):
    with pytest.raises(DriveError, match=r'slcan:.*nothing'):
        CanDrive({'interface': 'slcan', 'channel': str(tmp_path / 'nothing')}, 1)
    with pytest.raises(DriveError, match=r'drive 5 on slcan:.*[Nn]o SDO response'):
        CanDrive(robot.bus, 5)
    with pytest.raises(DriveError, match='carrier_pigeon'):
        CanDrive({'interface': 'carrier_pigeon', 'channel': 'x'}, 1)
