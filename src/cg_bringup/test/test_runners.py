"""The runners as their users meet them: what they say at the end, and what a kill leaves."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

rclpy = pytest.importorskip('rclpy')

from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from cg_bringup import balance_run, rebalance_run, recover_run  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402
from cg_interfaces.ros import MACHINE_QOS  # noqa: E402

PATIENCE = 60.0  # s for start-up on a busy machine
PROMISED = 2.0  # s in which nothing is left of a runner that was killed
RUNNERS = {
    'balance': ['cg_bringup.balance_run', '--lean', '0'],
    'rebalance': ['cg_bringup.rebalance_run', '--start-after', '0', '--duration', '0'],
    'recover': ['cg_bringup.recover_run', '--start', 'upright', '--duration', '0'],
    'experiment': ['cg_bringup.experiment', 'legs_tied', '--duration', '60'],
    'demo': ['cg_bringup.demo', '--seed', '1', '--duration', '60'],
}


def stat(pid):
    """State letter and parent of a process, or None."""
    try:
        fields = Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()
    except OSError:
        return None
    return fields[0], int(fields[1])


def descendants(pid):
    parents = {}
    for directory in Path('/proc').glob('[0-9]*'):
        found = stat(directory.name)
        if found is not None:
            parents.setdefault(found[1], []).append(int(directory.name))
    family, left = [], [pid]
    while left:
        children = parents.get(left.pop(), [])
        family += children
        left += children
    return family


def alive(pid):
    found = stat(pid)
    return found is not None and found[0] != 'Z'


def waited(pid):
    """Time in s for which the threads of a process were ready and had no core."""
    total = 0
    for task in threads(pid):
        with contextlib.suppress(OSError):  # it has just ended
            total += int((task / 'schedstat').read_text().split()[1])
    return 1e-9 * total


def threads(pid):
    """Directories of the threads of a process: none of a process that has ended.

    `Path.glob` passes on the error of a directory that goes between its look and its reading.
    """
    try:
        return list(Path(f'/proc/{pid}/task').iterdir())
    except OSError:
        return []


def gone_within(seconds, family, spin):
    """Whether all processes end in this time, less that for which a busy machine held them up.

    Those that take nothing of the processor, because they wait for something else, have no more.
    """
    watched = [os.getpid(), *family]
    began, before = time.monotonic(), {pid: waited(pid) for pid in watched}
    held_up = dict.fromkeys(watched, 0.0)
    while any(map(alive, family)):
        for pid in watched:
            held_up[pid] = max(held_up[pid], waited(pid) - before[pid])
        if time.monotonic() - began > min(seconds + sum(held_up.values()), PATIENCE):
            return False
        spin()
    return True


class Ear:
    """Hears what the drive has applied."""

    def __init__(self):
        self.node, self.torques = Node('ear'), []
        self.node.create_subscription(
            JointState, '/applied_torque', lambda m: self.torques.append(m.effort[0]), MACHINE_QOS
        )
        self.executor = EventsExecutor()
        self.executor.add_node(self.node)

    def spin(self):
        self.executor.spin_once(timeout_sec=0.005)

    def until(self, condition):
        """Whether the condition came true in time."""
        deadline = time.monotonic() + PATIENCE
        while not condition() and time.monotonic() < deadline:
            self.spin()
        return condition()


@pytest.fixture
def ear():
    with own_domain():
        rclpy.init()
        ear = Ear()
        yield ear
        ear.executor.remove_node(ear.node)
        ear.node.destroy_node()
        rclpy.try_shutdown()


@pytest.mark.parametrize(
    ('runner', 'mode', 'number'),
    [
        pytest.param('balance', 'real_time', signal.SIGTERM, marks=pytest.mark.alone),
        ('balance', 'lockstep', signal.SIGHUP),
        pytest.param('balance', 'real_time', signal.SIGKILL, marks=pytest.mark.alone),
        pytest.param('rebalance', 'lockstep', signal.SIGKILL, marks=pytest.mark.evidence),
        ('recover', 'lockstep', signal.SIGTERM),
        pytest.param('experiment', 'lockstep', signal.SIGTERM, marks=pytest.mark.evidence),
        pytest.param('experiment', 'real_time', signal.SIGHUP, marks=pytest.mark.alone),
        pytest.param('experiment', 'lockstep', signal.SIGINT, marks=pytest.mark.evidence),
        pytest.param('experiment', 'real_time', signal.SIGKILL, marks=pytest.mark.alone),
    ],
)
def test_nothing_is_left_of_a_runner_that_is_killed(ear, tmp_path, runner, mode, number):
    command = [sys.executable, '-m', *RUNNERS[runner], '--mode', mode]
    command += ['--out', str(tmp_path)] if runner == 'experiment' else []
    with (tmp_path / 'log').open('w+') as log:
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT
        )
        family = []
        try:
            assert ear.until(lambda: len(ear.torques) > 100), (tmp_path / 'log').read_text()
            family = descendants(process.pid)
            assert len(family) >= 3
            process.send_signal(number)
            # When it is told to end, each node has its time to end in.
            patience = PROMISED if number == signal.SIGKILL else PATIENCE
            assert gone_within(patience, family, ear.spin)
            status = process.wait(PATIENCE)
        finally:
            for pid in filter(alive, [process.pid, *family]):
                os.kill(pid, signal.SIGKILL)
            process.wait()
    said = (tmp_path / 'log').read_text()
    assert status == (-number if number == signal.SIGKILL else 128 + number), said
    assert 'Traceback' not in said
    assert ear.until(lambda: ear.torques[-1] == 0.0)
    if runner == 'experiment':
        assert (tmp_path / 'legs_tied_seed1' / 'metadata.yaml').is_file()
    elif number != signal.SIGKILL:
        assert f'stopped by {number.name}; until then ' in said.splitlines()[-1]


@pytest.mark.parametrize('number', [signal.SIGTERM, signal.SIGKILL])
def test_nothing_is_left_of_a_demonstration_that_is_killed(tmp_path, number):
    out = tmp_path / 'demo'
    process = subprocess.Popen(
        [sys.executable, '-m', *RUNNERS['demo'], '--out', str(out)],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    family = []
    try:
        deadline = time.monotonic() + PATIENCE
        while len(family) < 3 or not list(out.glob('bags/*/*.mcap')):
            assert time.monotonic() < deadline
            time.sleep(0.02)
            family = descendants(process.pid)
        process.send_signal(number)
        patience = PROMISED if number == signal.SIGKILL else PATIENCE
        assert gone_within(patience, family, lambda: time.sleep(0.01))
    finally:
        for pid in filter(alive, [process.pid, *family]):
            os.kill(pid, signal.SIGKILL)
        said, _ = process.communicate()
    assert b'Traceback' not in said


def last_line(capsys, main, *args):
    with own_domain():
        status = main([*args, '--mode', 'lockstep'])
    captured = capsys.readouterr()
    lines = (captured.out or captured.err).splitlines()
    # Where processes were killed before, nodes find their shared memory, and say so at any time.
    return status, next(line for line in reversed(lines) if '[RTPS_' not in line)


def test_balance_ends_with_what_the_robot_did(capsys):
    status, line = last_line(
        capsys, balance_run.main, '--duration', '1', '--lean', '0.02', '--pushes', '0.5', '0.3'
    )
    assert line.startswith('balance: upright throughout: 1.00 s on the inner leg, largest lean ')
    assert line.endswith('1 of 1 pushes survived')
    assert status == 0


def test_a_fall_ends_the_run_and_is_said(capsys):
    status, line = last_line(capsys, balance_run.main, '--duration', '5', '--lean', '0.3')
    assert line.startswith('balance: fell at 0.')
    assert status == 1


def test_recovery_ends_with_what_the_robot_did(capsys):
    upright = ('--start', 'upright', '--stance', 'outer', '--pushes', '0.3', '1')
    status, line = last_line(capsys, recover_run.main, '--duration', '1.5', *upright)
    assert line.startswith('recover_balance: upright at the end: 1.50 s on the outer leg, ')
    assert line.endswith('1 of 1 pushes survived')
    assert status == 0


def test_a_node_that_does_not_start_ends_the_run(capfd):
    status, line = last_line(capfd, rebalance_run.main, '--model', '/nowhere.yaml')
    assert line.startswith('rebalance: ')
    assert 'ended early, with status 2' in line
    assert status == 1
