"""Limits of what is read from a drive, and the feet that its outputs draw in. No bus."""

import math
from concurrent.futures import Future

import pytest

from cg_hardware.drive.feet import FootRetraction
from cg_hardware.drive.objects import AbsentError, DriveError
from cg_hardware.drive.readings import Level, Limits, Quantity, Reading
from cg_hardware.drive.settings import DriveSettings, read_settings
from cg_hardware.drive.zero import EncoderZero, read_zero

HEAT = Quantity('temperature of the drive', 'degC', 0x2E10, 1, 0.1, signed=True)


@pytest.mark.parametrize(
    ('value', 'level', 'words'),
    [
        (20.0, Level.OK, 'temperature of the drive is 20 degC'),
        (70.0, Level.WARN, 'is 70 degC; the limit is 70 degC'),
        (85.5, Level.ERROR, 'is 85.5 degC; the limit is 85 degC'),
        (5.0, Level.WARN, 'is 5 degC; the least is 5 degC'),
        (-1.0, Level.ERROR, 'is -1 degC; the least is 1 degC'),
    ],
)
def test_levels(value, level, words):
    found, told = Limits(85.0, 70.0, 5.0, 1.0).judge(value, HEAT)
    assert found == level
    assert words in told
    assert Limits().judge(value, HEAT)[0] == Level.OK


class Answering:
    """Objects of a drive that answers when it likes."""

    def __init__(self):
        self.asked = []

    def later(self, work):
        self.asked.append(Future())
        return self.asked[-1]


def test_a_reading_is_asked_for_when_it_is_due_and_never_waited_for():
    drive, now = Answering(), [0.0]
    reading = Reading(HEAT, drive, 1.0, lambda: now[0])
    assert not reading.poll()
    now[0] = 5.0
    assert not reading.poll()  # still no answer, and not asked twice
    assert len(drive.asked) == 1
    assert reading.judge(Limits(85.0))[0] == Level.OK  # nothing is wrong yet
    drive.asked[0].set_result(-314)
    assert reading.poll()
    assert reading.value == pytest.approx(-31.4)
    reading.poll()
    drive.asked[1].set_exception(DriveError('no answer'))
    assert not reading.poll()
    assert math.isnan(reading.value)
    assert reading.judge(Limits(85.0)) == (
        Level.WARN, 'temperature of the drive is not known: no answer'
    )  # fmt: skip
    assert reading.judge(Limits())[0] == Level.OK


def test_what_the_drive_has_not_is_asked_for_once():
    drive, now = Answering(), [0.0]
    reading = Reading(HEAT, drive, 1.0, lambda: now[0])
    reading.poll()
    drive.asked[0].set_exception(AbsentError('object 0x2e10:1'))
    for now[0] in range(1, 10):
        assert not reading.poll()
    assert len(drive.asked) == 1


def test_a_foot_is_in_while_somebody_asks_and_the_drive_is_enabled():
    feet = FootRetraction({'inner': 16, 'outer': 3}, stale_after=0.5)
    assert feet.mask == 1 << 16 | 1 << 3
    assert feet.outputs(0.0, enabled=True) == 0
    feet.ask('outer', True, 1.0)
    assert feet.outputs(1.4, enabled=True) == 1 << 3
    assert feet.outputs(1.4, enabled=False) == 0
    assert feet.outputs(1.6, enabled=True) == 0  # nobody has asked for too long
    feet.ask('outer', True, 2.0)
    feet.ask('inner', True, 2.0)
    assert feet.outputs(2.1, enabled=True) == 0  # a robot without feet falls
    feet.ask('outer', False, 2.2)
    assert feet.outputs(2.3, enabled=True) == 1 << 16


@pytest.mark.parametrize(
    ('settings', 'said'),
    [
        ({'homing_method': 36}, 'homing_method is 36; allowed are 33, 34, 35, 37'),
        ({'inner_retraction': 2, 'outer_retraction': 2}, 'are both bit 2; each needs its own'),
        ({'watch': 'dog'}, "watch is 'dog'; allowed are heartbeat, guarding"),
        ({'sign': 0.5}, 'sign is 0.5; it must be 1 or -1'),
        ({'temperature_index': 70_000}, 'temperature_index is 70000'),
    ],
)
def test_settings_that_are_refused(settings, said):
    with pytest.raises(ValueError, match=said):
        DriveSettings(**settings)


def test_settings_from_a_file(tmp_path):
    file = tmp_path / 'drive.yaml'
    file.write_text('gear: 50\nwatch: guarding\nhoming_method: 33\n')
    assert read_settings(str(file)) == {'gear': 50.0, 'watch': 'guarding', 'homing_method': 33}


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('geer: 50', "drive.yaml: the drive node has no parameter 'geer'"),
        ('node_id: 1.5', 'drive.yaml: node_id is 1.5; a int is needed'),
        ('absolute_encoder: 1', 'absolute_encoder is 1; a bool is needed'),
        ('homing_speed: -1.0', 'drive.yaml: homing_speed is -1.0; allowed is 0.001 to 2.0'),
        ('- 1', 'must be a mapping'),
    ],
)
def test_a_file_of_settings_that_is_refused(tmp_path, text, said):
    file = tmp_path / 'drive.yaml'
    file.write_text(text)
    with pytest.raises(ValueError, match=said):
        read_settings(str(file))


def test_a_homing_in_the_units_of_the_drive():
    # 4000 counts a turn, counted backward; the drive speaks of turns of its encoder a minute.
    s = DriveSettings(
        counts_per_turn=-4000.0, speed_unit=4000 / 60, homing_speed=0.5, homing_acceleration=2.0,
        homing_torque=5.0, homing_travel=math.pi,
    )  # fmt: skip
    plan = s.homing_plan(per_mille=25.0)
    assert (plan.speed, plan.acceleration) == (5, 19)  # 0.5 rad/s are 4.77 turns a minute
    assert (plan.torque, plan.travel) == (125, 2000)


def test_a_zero_is_kept_with_how_it_was_found(tmp_path):
    file = tmp_path / 'hip.yaml'
    assert read_zero(str(file)) is None
    zero = EncoderZero.now(-171, 'homing', 34, 0.02)
    zero.save(str(file))
    assert read_zero(str(file)) == zero
    assert 'zero at -171 counts (homing by method 34, 0.02 rad from the index, 20' in str(zero)


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('format: cg_zero/1\nzero_rad: 0.1\n', 'format must be cg_encoder_zero/1'),
        ('format: cg_encoder_zero/1\nzero_counts: 1.5\n', 'zero_counts must be a whole number'),
        ('format: cg_encoder_zero/1\nzero_counts: 99999999999\n', 'zero_counts must be'),
        ('[]\n', 'format must be'),
        ('a: [\n', 'hip.yaml'),
    ],
)
def test_a_file_that_keeps_no_zero_is_refused(tmp_path, text, said):
    file = tmp_path / 'hip.yaml'
    file.write_text(text)
    with pytest.raises(ValueError, match=said):
        read_zero(str(file))
