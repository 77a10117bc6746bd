"""Tests in several processes: those that keep deadlines run alone, and the longest ones begin.

Deadlines mean something on a host that has its processors for the test. One that other programs
keep busy is waited for, and a test that fails while the host wakes nobody in time tells nothing.
Both are skipped, and the reason says what was measured. The end of a run tells how many were, and
with CG_NO_EXCUSE set, on a host that is known to keep time, none is. A run that excuses many of
them shows too little, and fails.
"""

import fcntl
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

# Two files of this workspace that surely exist; locks do not touch them.
_ROOM, _DOOR = Path(__file__), Path(__file__).with_name('pyproject.toml')

_LOOK = 0.1  # s over which it is looked whether other programs run
_OTHERS = 0.3  # of a processor that other programs may have
_PATIENCE = 60.0  # s that their end is waited for, by all tests of a process together
_LATE = 0.01  # s that a process with the priority of the drive's node may be woken too late
# Prints by how many seconds it is woken too late, whenever that was never worse. Who may not take
# the priority would measure the test's own load, and excuse every failure: it measures nothing.
_WATCH = """
import os, time
try:
    os.nice(-10)
except PermissionError:
    raise SystemExit
parent, worst = os.getppid(), 0.0
while os.getppid() == parent:
    due = time.monotonic() + 0.002
    time.sleep(0.002)
    late = time.monotonic() - due
    if late > worst:
        worst = late
        print(worst, flush=True)
"""
# Why one is skipped; the last is said by tests of emulated devices (test_robot_on_wires.py).
_EXCUSES = _OTHERS_RUN, _WOKEN_LATE, _ = (
    'other programs have', 'the host wakes a thread', 'the host held the emulation up',
)  # fmt: skip
_MOST_EXCUSED = 0.5  # of the tests with deadlines of a run
_watch = pytest.StashKey[subprocess.Popen]()
_waited = pytest.StashKey[float]()


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    """Those that run alone first, then the slow ones.

    Each process takes the next test of this order (colcon_defaults.yaml). So nobody waits in front
    of a test that runs alone until a slow one has ended, and none is left with a slow one at last.
    """
    items.sort(key=lambda item: [item.get_closest_marker(m) is None for m in ('alone', 'slow')])


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item):
    """A test marked `alone` waits until no other runs, and holds the others up meanwhile.

    Who waits keeps the door, so that a stream of others cannot hold it up for ever.
    """
    alone = item.get_closest_marker('alone')
    with _ROOM.open() as room:
        with _DOOR.open() as door:
            fcntl.flock(door, fcntl.LOCK_EX)
            fcntl.flock(room, fcntl.LOCK_EX if alone else fcntl.LOCK_SH)
        if not alone:
            return (yield)
        command = [sys.executable, '-S', '-c', _WATCH]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as watch:
            item.stash[_watch] = watch
            try:
                return (yield)
            finally:
                watch.kill()


# Innermost: the records of pytest's log have to be there before a skip, or its teardown fails.
@pytest.hookimpl(wrapper=True, trylast=True)
def pytest_runtest_setup(item):
    """A test marked `alone` waits for other programs to end, too."""
    if _watch not in item.stash or 'CG_NO_EXCUSE' in os.environ:
        return (yield)
    while (others := _processors_in_use()) > _OTHERS:
        waited = item.config.stash.get(_waited, 0.0) + _LOOK
        item.config.stash[_waited] = waited
        if waited > _PATIENCE:
            pytest.skip(f'{_OTHERS_RUN} {others:.1f} of {os.cpu_count()} processors')
    return (yield from _excused(item))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_call(item):
    """What fails on a host that does not keep time has not failed."""
    return (yield from _excused(item)) if _watch in item.stash else (yield)


def _excused(item):
    try:
        return (yield)
    except Exception as error:  # whatever a test may fail by
        watch = item.stash[_watch]
        watch.kill()
        late = max(map(float, watch.stdout.read().split()), default=0.0)
        if late <= _LATE or 'CG_NO_EXCUSE' in os.environ:
            raise
        pytest.skip(f'{_WOKEN_LATE} {1000 * late:.0f} ms late, and {error}')


def pytest_terminal_summary(terminalreporter):
    """How much of what keeps deadlines this run does not show."""
    excused, kept = _deadlines(terminalreporter)
    if excused:
        terminalreporter.write_line(
            f'{excused} tests with deadlines were skipped, as this host does not keep time: the '
            'run shows nothing of them (CG_NO_EXCUSE=1 runs them all the same)'
        )
    if excused > _MOST_EXCUSED * (excused + kept):
        terminalreporter.write_line(
            f'No more than {kept} were run: too few, the run has failed. Run it on an idle host.'
        )


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session):
    """A host that excuses many tests has not passed them."""
    reporter = session.config.pluginmanager.get_plugin('terminalreporter')
    if reporter is not None and session.exitstatus == pytest.ExitCode.OK:
        excused, kept = _deadlines(reporter)
        if excused > _MOST_EXCUSED * (excused + kept):
            session.exitstatus = pytest.ExitCode.TESTS_FAILED


def _deadlines(reporter):
    """Of the tests that keep deadlines: how many the host excused, and how many passed."""
    skipped = reporter.stats.get('skipped', [])
    excused = sum(any(why in str(r.longrepr) for why in _EXCUSES) for r in skipped)
    return excused, sum('alone' in r.keywords for r in reporter.stats.get('passed', []))


def _processors_in_use() -> float:
    """By whomever, other machines on the same hardware among them; 0 where nobody tells."""
    before = _jiffies()
    time.sleep(_LOOK)
    spent = [b - a for a, b in zip(before, _jiffies(), strict=True)]
    if not sum(spent):
        return 0.0
    _, _, _, idle, waiting, *_ = spent
    return (os.cpu_count() or 1) * (1 - (idle + waiting) / sum(spent))


def _jiffies() -> list[int]:
    try:
        line = Path('/proc/stat').read_text().splitlines()[0]
    except OSError:
        return [0] * 8
    return [int(word) for word in line.split()[1:9]]
