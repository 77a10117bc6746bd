"""Processes that are watched: one that hangs or dies costs its piece of work and no more."""

import math
import operator
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

from cg_dynamics.watched_processes import WatchedProcesses, WorkLost

LONG = 60.0  # s; whatever takes longer hangs
FOR_EVER = 10_000.0  # s


def gone(pid: int) -> bool:
    """Whether there is no such process, or only what is left of it."""
    try:
        with open(f'/proc/{pid}/stat') as file:
            return file.read().rpartition(')')[2].split()[0] in 'ZX'
    except (FileNotFoundError, ProcessLookupError):
        return True


def until(condition):
    deadline = time.monotonic() + LONG
    while not condition():
        assert time.monotonic() < deadline, 'waited in vain'
        time.sleep(0.01)


def test_results_come_back_each_to_its_own():
    with WatchedProcesses(2) as processes:
        futures = [processes.submit(math.sqrt, float(k)) for k in range(20)]
        assert [future.result(LONG) for future in futures] == [math.sqrt(k) for k in range(20)]
        assert list(processes.map(operator.add, [1, 2], [3, 4])) == [4, 6]


def test_an_error_of_the_work_comes_back_and_costs_no_process():
    with WatchedProcesses(1) as processes:
        pid = processes.submit(os.getpid).result(LONG)
        with pytest.raises(ValueError, match='math domain'):
            processes.submit(math.sqrt, -1.0).result(LONG)
        with pytest.raises((TypeError, RuntimeError), match='pickle'):
            processes.submit(threading.Lock).result(LONG)
        assert processes.submit(os.getpid).result(LONG) == pid != os.getpid()


def test_a_process_that_hangs_is_killed_and_another_one_goes_on():
    with WatchedProcesses(1, limit=0.5) as processes:
        pid = processes.submit(os.getpid).result(LONG)
        hanging, next_one = processes.submit(time.sleep, FOR_EVER), processes.submit(os.getpid)
        with pytest.raises(WorkLost, match=r'no result within 0\.5 s'):
            hanging.result(LONG)
        assert next_one.result(LONG) != pid
        assert gone(pid)


def test_a_process_that_dies_costs_the_work_that_it_was_at():
    with WatchedProcesses(1) as processes:
        lost, next_one = processes.submit(os._exit, 1), processes.submit(math.sqrt, 4.0)
        with pytest.raises(WorkLost, match='its process died'):
            lost.result(LONG)
        assert next_one.result(LONG) == 2.0
        # One that is killed between two pieces costs none.
        pid = processes.submit(os.getpid).result(LONG)
        os.kill(pid, signal.SIGKILL)
        until(lambda: gone(pid))
        assert processes.submit(os.getpid).result(LONG) != pid


def test_signals_that_all_of_a_group_get_are_for_the_one_who_started_it():
    with WatchedProcesses(1) as processes:
        pid = processes.submit(os.getpid).result(LONG)
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            os.kill(pid, number)
        assert processes.submit(os.getpid).result(LONG) == pid


def test_leaving_ends_what_runs_and_what_waits():
    with WatchedProcesses(1) as processes:
        pid = processes.submit(os.getpid).result(LONG)
        running, waiting = processes.submit(time.sleep, FOR_EVER), processes.submit(math.sqrt, 4.0)
        until(running.running)
    assert gone(pid)
    assert isinstance(running.exception(LONG), WorkLost)
    assert waiting.cancelled()
    with pytest.raises(RuntimeError, match='nobody to work'):
        processes.submit(math.sqrt, 4.0)


def test_no_process_outlives_the_one_that_started_it():
    program = (
        'import os, time\n'
        'from cg_dynamics.watched_processes import WatchedProcesses\n'
        'if __name__ == "__main__":\n'
        '    processes = WatchedProcesses(1)\n'
        '    print(processes.submit(os.getpid).result(), flush=True)\n'
        f'    processes.submit(time.sleep, {FOR_EVER}).result()\n'
    )
    with subprocess.Popen(
        [sys.executable, '-c', program], stdout=subprocess.PIPE, text=True
    ) as parent:
        pid = int(parent.stdout.readline())
        parent.kill()
    until(lambda: gone(pid))


@pytest.mark.parametrize(('count', 'limit'), [(0, 1.0), (1, 0.0), (1, math.nan), (1, math.inf)])
def test_numbers_that_make_no_sense_are_refused(count, limit):
    with pytest.raises(ValueError, match='both must be positive'):
        WatchedProcesses(count, limit)
