"""The emulated robot: what it tells of an instant is not told before it."""

import json
import os

import pytest

pytest.importorskip('serial')

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_hardware.emulators.robot import STEP, EmulatedRobot
from cg_hardware.imu import gx3
from cg_hardware.simulation import read_setup


@pytest.fixture
def robot(tmp_path):
    model = Model.load(model_path('compass_gait_mit'))
    return EmulatedRobot(tmp_path, model, read_setup('stance: inner'), [0.05, 0.05, 0.0, 3.0])


def test_a_sample_is_on_the_line_at_its_instant_and_not_before(robot, tmp_path):
    line = os.open(tmp_path / 'imu', os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    os.write(line, gx3.sampling_command(500.0) + gx3.continuous_command())
    robot.serve(0.0)
    os.read(line, 1000)  # answers to the commands
    robot.move()
    robot.serve(0.9 * STEP)  # a frame on the bus may wake the devices at any time
    with pytest.raises(BlockingIOError):
        os.read(line, 1000)
    robot.serve(STEP)
    assert len(os.read(line, 1000)) == gx3.LENGTHS[gx3.EULER_AND_RATES]


def test_the_encoder_is_read_between_two_steps_of_the_body(robot):
    robot.ask('let_go', 0.0)
    for _ in range(2):
        robot.move()
    counts = []
    for share in (0.0, 0.5, 1.0):
        robot.serve((1 + share) * STEP)
        counts.append(robot.drive.counts)
    # The swing leg turns by 6 mrad a step, 19 counts; a count of rounding at either end.
    assert abs(counts[2] - counts[0]) > 15
    assert counts[1] - counts[0] == pytest.approx((counts[2] - counts[0]) / 2, abs=1.0)


@pytest.mark.parametrize('fault', ['drive_fault 0x2310', 'drive_off'])
def test_torque_that_a_fault_takes_off_is_off_after_it_also_where_the_body_is_late(robot, fault):
    robot.drive.acting = 180
    robot.drive.log.append((3.5 * STEP, 180))  # by a SYNC, while the body is still at zero
    robot.ask(fault, 3.6 * STEP)
    report = json.loads(robot.ask('report', 3.7 * STEP))
    assert report['changes'] == [[3.5 * STEP, 180], [3.6 * STEP, 0]]
    assert report['acting'] == 0
    assert report['time'] == 3.7 * STEP
