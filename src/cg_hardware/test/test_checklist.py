"""The checklist on a robot in memory: it passes a sound one, and names what is wrong in others."""

import math

import numpy as np
import pytest
from robot_in_memory import LIMIT, RobotInMemory

from cg_dynamics.model import Model
from cg_hardware.checklist import measuring, record
from cg_hardware.checklist.plan import Plan
from cg_hardware.checklist.robot import Quit
from cg_hardware.checklist.sensing import judge_rates
from cg_hardware.checklist.steps import NAMES, STEPS
from cg_hardware.checklist.torquing import judge_torque
from cg_hardware.checklist.walk import walk

PLAN = Plan(Model.load('compass_gait_mit'))


def walked(robot, *names, plan=PLAN, **how):
    steps = [step for step in STEPS if not names or step.name in names]
    return {result.name: result for result in walk(robot, plan, steps, **how)}


def test_a_sound_robot_passes_every_step_and_is_left_at_rest():
    robot = RobotInMemory()
    results = walked(robot)
    assert tuple(results) == NAMES
    assert {r.verdict for r in results.values()} == {'passed'}, results
    assert robot.limit == LIMIT
    assert not robot.enabled
    assert not robot.gate.passes
    assert robot.rests == len(STEPS)
    assert results['torque'].measured['inverse_inertia'] == pytest.approx(
        results['torque'].measured['expected_inverse_inertia'], rel=0.05
    )
    assert results['stale'].measured['zero_after_ms'] == pytest.approx(15, abs=3)


@pytest.mark.parametrize(('attribute', 'value', 'step', 'words'), [
    ('imu_sign', -1.0, 'imu_axis', '--imu-sign -1'),
    ('count_sign', -1.0, 'encoder', '--counts-per-turn'),
    ('drive_sign', -1.0, 'torque', '--drive-sign'),
    ("inertia", 0.25, "torque", "--gear"),
    ('deaf', True, 'stop_topic', 'the torque stayed'),
    ('clips', False, 'limit', 'the limit is 2 N m'),
    ('drift', 900.0, 'clocks', '900 ppm'),
])  # fmt: skip
def test_what_is_wrong_is_found_and_said(attribute, value, step, words):
    robot = RobotInMemory()
    setattr(robot, attribute, value)
    results = walked(robot, go_on=True)
    assert results[step].verdict == 'failed'
    assert words in results[step].reason
    if attribute != 'deaf':
        failed = {name for name, result in results.items() if result.verdict == 'failed'}
        assert failed == {step}


def test_a_zero_by_the_index_is_kept():
    robot = RobotInMemory()
    robot.zero = 'known: zero at 12 counts (homing by method 34, 0.1 rad from the index)'
    result = walked(robot, 'zero')['zero']
    assert result.verdict == 'passed'
    assert 'index' in result.reason
    assert robot.zeros['hip'] == 0.02
    robot.zeros['hip'] = 0.2
    assert walked(robot, 'zero')['zero'].verdict == 'failed'


def test_the_ratio_of_inertia_is_measured_over_expected():
    robot = RobotInMemory()
    robot.inertia = 2.0
    result = walked(robot, 'torque')['torque']
    assert result.verdict == 'passed'
    assert '2.' in result.reason
    measured = result.measured
    ratio = measured['expected_inverse_inertia'] / measured['inverse_inertia']
    assert ratio == pytest.approx(2.0, rel=0.15)


def test_an_inertia_that_is_far_off_names_what_may_be_wrong():
    numbers = {'inverse_inertia': 0.1, 'inverse_inertia_spread': 0.001, 'travel_rad': 0.1,
               'expected_inverse_inertia': 0.4, 'torque_applied': 4.0, 'far': 0.0}  # fmt: skip
    judged = judge_torque(numbers, PLAN)
    assert not judged.passed
    assert '4 times the expected' in judged.reason
    assert judge_torque(numbers | {'inverse_inertia': 0.3}, PLAN).passed
    assert 'backward' in judge_torque(numbers | {'inverse_inertia': -0.3}, PLAN).reason


def test_a_torque_that_friction_holds_says_so():
    result = walked(RobotInMemory(), 'torque', plan=Plan(PLAN.model, torque=0.5))['torque']
    assert result.verdict == 'failed'
    assert 'friction' in result.reason


def test_a_failed_step_ends_it_unless_it_goes_on():
    robot = RobotInMemory()
    robot.drift = 900.0
    results = walked(robot)
    assert results['clocks'].verdict == 'failed'
    after = [results[name] for name in NAMES[NAMES.index('clocks') + 1 :]]
    assert {r.verdict for r in after} == {'skipped'}
    assert 'clock drift failed' in after[0].reason


def test_steps_that_mean_nothing_are_skipped():
    robot = RobotInMemory()
    robot.count_sign = -1.0
    results = walked(robot, go_on=True)
    assert results['torque'].verdict == 'skipped'
    assert 'encoder' in results['torque'].reason


def test_a_robot_without_feet_skips_them():
    robot = RobotInMemory()
    robot.feet = False
    results = walked(robot, 'devices', 'feet')
    assert results['devices'].verdict == 'passed'
    assert results['feet'].verdict == 'skipped'


def test_nobody_answers():
    robot = RobotInMemory()
    robot.willing = False
    results = walked(robot, 'rates', 'zero', 'torque', go_on=True)
    assert [r.verdict for r in results.values()] == ['passed', 'skipped', 'skipped']


def test_whoever_quits_leaves_the_rest_undone_and_the_robot_at_rest(monkeypatch):
    robot = RobotInMemory()

    def quit_it(text, hands=()):
        raise Quit

    monkeypatch.setattr(robot, 'ask', quit_it)
    results = walked(robot, 'rates', 'zero', 'stale')
    assert [r.verdict for r in results.values()] == ['passed', 'skipped', 'skipped']
    assert robot.rests == 2


@pytest.mark.parametrize(('name', 'value', 'words'), [
    ('hip_angle_rate_hz', 450.0, '500 Hz are stated'),
    ('imu_angle_missing', 0.1, '10 %'),
    ('imu_angle_jitter_ms', 1.0, 'uneven'),
])  # fmt: skip
def test_rates_are_judged_by_numbers(name, value, words):
    numbers = {}
    for channel in ('imu_angle', 'hip_angle'):
        numbers |= {f'{channel}_rate_hz': 500.0, f'{channel}_stated_hz': 500.0,
                    f'{channel}_missing': 0.0, f'{channel}_jitter_ms': 0.01}  # fmt: skip
    assert judge_rates(numbers, PLAN).passed
    judged = judge_rates(numbers | {name: value}, PLAN)
    assert not judged.passed
    assert words in judged.reason


def told(stamps):
    stamps = np.asarray(stamps)
    return measuring.rate_of(measuring.Series(stamps, stamps + 1_000_000, np.zeros(len(stamps))))


def test_what_is_lost_is_missing_and_not_uneven():
    even = np.arange(2000) * 2_000_000
    kept = np.delete(even, np.r_[300:310, 700, 900, 1501:1506])  # 17 samples
    found = told(kept)
    assert found['missing'] == pytest.approx(17 / 1999)
    assert found['jitter_ms'] == pytest.approx(0.0, abs=1e-9)
    assert found['rate_hz'] == pytest.approx(500.0)
    assert found['age_ms'] == 1.0


def test_what_is_late_and_caught_up_is_uneven_and_not_missing():
    stamps = np.arange(2000) * 2_000_000
    for held_up in range(100, 1900, 60):  # 6 ms, and four samples in the 2 ms after it
        stamps[held_up : held_up + 4] = stamps[held_up + 3] + np.arange(4) * 500_000
    found = told(stamps)
    assert found['missing'] == pytest.approx(0.0, abs=1e-9)
    assert found['jitter_ms'] > 0.2
    assert found['rate_hz'] == pytest.approx(500.0)


def test_samples_that_come_two_at_a_time_are_uneven():
    found = told(np.repeat(np.arange(1000) * 4_000_000, 2))
    assert found['rate_hz'] == pytest.approx(500.0)
    assert found['missing'] == pytest.approx(0.0, abs=1e-3)
    assert found['jitter_ms'] == pytest.approx(1.0, rel=0.01)


def made(steps, date='2026-03-04T10:12:00Z', **changes):
    entries = {
        'date': date, 'emulated': False, 'devices': {'imu': 'GX3 7', 'drive': 'node 1'},
        'settings': {}, 'model_file': 'robot.yaml', 'model_sha256': '0' * 64,
        'setup': {'fixture': 'inner_fixed'}, 'complete': True, 'steps': tuple(steps),
    }  # fmt: skip
    return record.Record(**entries | changes)


def test_a_record_comes_back_and_is_referred_to_without_a_path(tmp_path):
    robot = RobotInMemory()
    robot.feet, robot.deaf = False, True
    results = list(walked(robot, 'devices', 'feet', 'torque', 'stop_topic').values())
    results[0].measured['zero_after_ms'] = math.inf
    kept = made(results)
    path = record.path_in(tmp_path, kept.date)
    kept.save(path)
    read = record.load(path)
    assert read.line == kept.line == '2 passed, 1 failed, 1 skipped'
    assert read.steps[0].measured['zero_after_ms'] is None
    found = record.latest_reference(tmp_path, kept.devices, emulated=False)
    assert found['file'] == path.name
    assert str(tmp_path) not in str(found)
    assert (found['passed'], found['of']) == (2, 4)
    assert found['failed'] == ['emergency stop by topic']
    assert found['not_checked'] == ['foot switches']


def test_the_latest_checklist_of_these_devices_counts(tmp_path):
    for date, serial, emulated in (
        ('2026-03-04T10:00:00Z', '7', False), ('2026-03-05T10:00:00Z', '8', False),
        ('2026-03-06T10:00:00Z', '7', True), ('2026-03-03T10:00:00Z', '7', False),
    ):  # fmt: skip
        devices = {'imu': serial}
        kept = made((), date, devices=devices, emulated=emulated)
        kept.save(record.path_in(tmp_path, date))
    (tmp_path / 'checklist_broken.yaml').write_text('format: [', encoding='utf-8')
    found = record.latest_reference(tmp_path, {'imu': '7'}, emulated=False)
    assert found['date'] == '2026-03-04T10:00:00Z'
    assert record.latest_reference(tmp_path, {'imu': '9'}, emulated=False) == {}
