"""A process is told to end by a signal, or by the end of the one that started it."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from cg_dynamics.stop_request import (
    GRACE,
    ON_STDIN,
    Stopped,
    StopRequest,
    raise_if_stopped,
    stopped_by_signals,
)

PATIENCE = 20.0  # s for the start of a Python on a busy machine
OBEDIENT = """
import time
from cg_dynamics.stop_request import StopRequest
stop = StopRequest()
print('ready', flush=True)
while not stop.requested:
    time.sleep(0.01)
print('last word', flush=True)
"""
STUBBORN = """
import signal, subprocess, sys, time
signal.signal(signal.SIGTERM, lambda *_: None)
child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(60)'])
print(child.pid, flush=True)
while True:
    time.sleep(0.01)
"""
IMPORTING = """
import time
print('ready', flush=True)
time.sleep(60)
"""


def alive(pid):
    try:
        return Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()[0] != 'Z'
    except OSError:
        return False


@pytest.fixture
def start(tmp_path, monkeypatch):
    """Starts a module with a lifeline, or without; its first line is there when it returns."""
    monkeypatch.setenv('PYTHONPATH', f'{tmp_path}:{os.environ.get("PYTHONPATH", "")}')
    processes = []

    def begin(text, lifeline=True):
        (tmp_path / 'node.py').write_text(text)
        process = subprocess.Popen(
            [sys.executable, '-m', 'cg_dynamics.stop_request', 'node'],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env=os.environ | (ON_STDIN if lifeline else {}), start_new_session=True,
        )  # fmt: skip
        processes.append(process)
        return process, process.stdout.readline().strip()

    yield begin
    for process in processes:
        process.kill()
        process.wait()
        for pipe in (process.stdin, process.stdout, process.stderr):
            pipe.close()


def test_a_cut_lifeline_is_a_request_to_stop(start):
    process, said = start(OBEDIENT)
    assert said == 'ready'
    process.stdin.close()
    assert process.wait(PATIENCE) == 0
    assert process.stdout.read() == 'last word\n'


def test_who_does_not_obey_is_killed_with_what_it_has_started(start):
    process, child = start(STUBBORN)
    begin = time.monotonic()
    process.stdin.close()
    assert process.wait(PATIENCE) == -signal.SIGKILL
    # GRACE leaves half a second of the two that are promised.
    assert GRACE <= time.monotonic() - begin < 2.0
    deadline = time.monotonic() + 1.0
    while alive(child) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not alive(child)


def test_who_has_nothing_to_leave_in_order_is_killed_at_once(start):
    process, _ = start(IMPORTING)
    begin = time.monotonic()
    process.stdin.close()
    assert process.wait(PATIENCE) == -signal.SIGKILL
    assert time.monotonic() - begin < 0.5 * GRACE


def test_who_was_started_by_hand_does_not_look_at_its_standard_input(start):
    process, _ = start(OBEDIENT, lifeline=False)
    process.stdin.close()
    with pytest.raises(subprocess.TimeoutExpired):
        process.wait(0.3)
    process.send_signal(signal.SIGHUP)
    assert process.wait(PATIENCE) == 0


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_a_node_that_still_imports_ends_without_a_traceback(start, number):
    process, _ = start(IMPORTING)
    process.send_signal(number)
    _, error = process.communicate(timeout=PATIENCE)
    assert process.returncode == -number
    assert error == ''


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_request_is_counted_and_the_signals_are_given_back(number):
    before = signal.getsignal(number)
    stop = StopRequest()
    stop.check()
    try:
        signal.raise_signal(number)
        signal.raise_signal(number)
    finally:
        stop.restore()
    assert stop.count == 2
    with pytest.raises(Stopped) as stopped:
        stop.check()
    assert stopped.value.status == 128 + number
    assert signal.getsignal(number) == before


def test_nohup_is_respected():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        stop = StopRequest()
        signal.raise_signal(signal.SIGHUP)
        stop.restore()
    finally:
        signal.signal(signal.SIGHUP, before)
    assert not stop.requested


def test_a_signal_stays_one_where_it_breaks_what_it_comes_into():
    """As the code of a lock does, or C that calls back."""

    def wait():
        with stopped_by_signals():
            try:
                signal.raise_signal(signal.SIGTERM)
            except Stopped:
                raise RuntimeError('release unlocked lock') from None

    with pytest.raises(Stopped, match='SIGTERM'):
        wait()
    with pytest.raises(RuntimeError, match='of its own'), stopped_by_signals():
        raise RuntimeError('of its own')


def test_a_signal_can_be_an_exception():
    def wait():
        with stopped_by_signals():
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(Stopped, match='SIGTERM'):
        wait()
    assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


class Curious(type):
    """NumPy asks such a type for special methods, and swallows whatever comes meanwhile."""

    def __getattr__(cls, name):
        signal.raise_signal(signal.SIGTERM)
        raise AttributeError(name)


def test_a_signal_that_is_swallowed_is_told_at_the_end_and_whenever_asked():
    went_on = []

    def work(asks):
        with stopped_by_signals():
            np.equal(np.arange(3), Curious('One', (), {})())
            went_on.append(asks)
            if asks:
                raise_if_stopped()
                went_on.append('never')

    for asks in (False, True):
        with pytest.raises(Stopped, match='SIGTERM'):
            work(asks)
    assert went_on == [False, True]
    raise_if_stopped()  # nothing is left of it
