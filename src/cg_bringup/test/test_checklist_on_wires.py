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
from cg_hardware.checklist.steps import NAMES

pytestmark = [pytest.mark.alone, pytest.mark.slow]

SETUP = 'stance: inner\nfixture: inner_fixed\n'
PATIENCE = 200.0  # s
AGAIN = 3  # times that steps are walked through again where a host lost samples


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


def failures_that_stay(folder, failed):
    """Steps that fail every time; a host that loses samples fails one now and then."""
    for turn in range(AGAIN):
        if not failed:
            break
        process = started(folder / str(turn), '--go-on', '--steps', *failed)
        process.communicate(timeout=PATIENCE)
        failed = [step.name for step in kept(folder / str(turn)).steps if step.verdict == 'failed']
    return failed


def test_a_sound_robot_passes(robot, tmp_path):
    devices, person = robot
    process = started(tmp_path / 'out', '--go-on')
    said, _ = process.communicate(timeout=PATIENCE)
    report, found = devices.report(), kept(tmp_path / 'out')
    assert found.emulated
    assert found.complete
    assert tuple(step.name for step in found.steps) == NAMES
    assert found.devices == {'imu': 'emulated GX3-25 6223-00000', 'drive': 'node 1'}
    assert report['acting'] == 0
    assert report['state'] != 'operation enabled'
    person.until(lambda: person.stage.startswith(('idle', 'unconfigured')))
    failed = [step.name for step in found.steps if step.verdict == 'failed']
    assert len(found.of('passed')) + len(failed) == len(NAMES), said
    assert process.returncode == (1 if failed else 0)
    assert not failures_that_stay(tmp_path / 'again', failed), said
    torque = next(step for step in found.steps if step.name == 'torque').measured
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
