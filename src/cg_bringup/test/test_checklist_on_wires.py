"""The checklist live, on emulated devices whose hands do what a person is asked to do."""

import signal
import subprocess
import sys

import pytest

pytest.importorskip('rclpy')
pytest.importorskip('canopen')
pytest.importorskip('serial')

from wired_robot import connected, held_nodes

from cg_hardware.checklist import record
from cg_hardware.checklist.steps import NAMES, STEPS

pytestmark = [pytest.mark.alone, pytest.mark.slow]

SETUP = 'stance: inner\nfixture: inner_fixed\n'
PATIENCE = 200.0  # s
AGAIN = 5  # times that steps are walked through again where a host lost samples


@pytest.fixture
def robot(tmp_path):
    with connected(held_nodes(tmp_path), tmp_path, '--state', '0', '0', '--setup', SETUP) as (
        robot,
        person,
        _,
    ):
        person.until(lambda: person.stage == 'idle')
        robot.report()
        yield robot, person


def started(folder, *words):
    return subprocess.Popen(
        [sys.executable, '-m', 'cg_bringup.checklist_run', '--yes', '--out', str(folder), *words],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip


def kept(folder):
    (path,) = folder.glob('checklist_*.yaml')
    return record.load(path)


def walked(folder, *words):
    """The exit code, what was said, and the record of one walk that no failure ends."""
    process = started(folder, '--go-on', *words)
    said, _ = process.communicate(timeout=PATIENCE)
    return process.returncode, said, kept(folder)


def with_verdict(found, verdict):
    return {step.name: step for step in found.steps if step.verdict == verdict}


def passed_in_turns(folder, found):
    """Results by step, and what does not pass however often it is tried.

    A host that loses samples fails a step now and then, and what needs that step is skipped.
    """
    passed = with_verdict(found, 'passed')
    for turn in range(AGAIN):
        left = [name for name in NAMES if name not in passed]
        if not left:
            break
        _, _, again = walked(folder / str(turn), '--steps', *left)
        passed |= with_verdict(again, 'passed')
    return passed, [name for name in NAMES if name not in passed]


@pytest.mark.evidence
def test_a_sound_robot_passes(robot, tmp_path):
    devices, person = robot
    code, said, found = walked(tmp_path / 'out')
    report = devices.report()
    assert found.emulated
    assert found.complete
    assert tuple(step.name for step in found.steps) == NAMES
    assert found.devices == {'imu': 'emulated GX3-25 6223-00000', 'drive': 'node 1'}
    assert report['acting'] == 0
    assert report['state'] != 'operation enabled'
    person.until(lambda: person.stage.startswith(('idle', 'unconfigured')))
    failed, skipped = with_verdict(found, 'failed'), with_verdict(found, 'skipped')
    assert code == (1 if failed else 0)
    # Nothing is skipped but what needs a step that did not pass.
    unpassed = {*failed, *skipped}
    assert all(unpassed & set(step.needs) for step in STEPS if step.name in skipped), said
    passed, left = passed_in_turns(tmp_path / 'again', found)
    assert not left, said
    torque = passed['torque'].measured
    ratio = torque['expected_inverse_inertia'] / torque['inverse_inertia']
    assert ratio == pytest.approx(1.0, abs=0.3)  # the flexible drive has its rotor on top


def test_who_interrupts_it_leaves_no_torque_and_a_partial_record(robot, tmp_path):
    devices, person = robot
    process = started(tmp_path / 'out', '--steps', 'zero', 'encoder', 'torque', 'limit', '--go-on')
    seen = []

    def torqued():
        seen.extend(change for change in devices.report()['changes'] if change[1])
        return seen or process.poll() is not None

    person.until(torqued)
    assert seen, process.communicate()[0]
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    person.until(lambda: devices.report()['acting'] == 0)
    person.until(lambda: person.stage.startswith('idle'))
    person.until(lambda: devices.report()['state'] != 'operation enabled')
    found = kept(tmp_path / 'out')
    assert not found.complete
    assert [step.name for step in found.steps] == ['zero', 'encoder']
