"""Processes under a supervisor: watched, ended in order, none left. No ROS."""

import os
import signal
import threading
import time
from pathlib import Path

import pytest

from cg_bringup.supervisor import ProcessDied, Supervisor
from cg_dynamics.stop_request import Stopped

PATIENCE = 30.0  # s
OBEDIENT = """
import pathlib, sys, time
from cg_dynamics.stop_request import StopRequest
stop = StopRequest()
pathlib.Path(sys.argv[1]).touch()
while not stop.requested:
    time.sleep(0.005)
time.sleep(0.2)
print(sys.argv[1].rpartition('/')[2], flush=True)
"""
STUBBORN = """
import pathlib, signal, sys, time
for number in (signal.SIGINT, signal.SIGTERM):
    signal.signal(number, lambda *_: None)
pathlib.Path(sys.argv[1]).touch()
while True:
    time.sleep(0.01)
"""
BRIEF = 'import pathlib, sys; pathlib.Path(sys.argv[1]).touch(); sys.exit(3)'


@pytest.fixture
def module(tmp_path, monkeypatch):
    monkeypatch.setenv('PYTHONPATH', f'{tmp_path}:{os.environ.get("PYTHONPATH", "")}')
    kinds = {'obedient': OBEDIENT, 'stubborn': STUBBORN, 'brief': BRIEF}
    for kind, text in kinds.items():
        (tmp_path / f'{kind}_child.py').write_text(text)
    return lambda kind, name: [f'{kind}_child', str(tmp_path / name)]


def ready(module):
    deadline = time.monotonic() + PATIENCE
    while not Path(module[1]).exists():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def gone(supervisor):
    return not any(Path(f'/proc/{p.pid}').exists() for p in supervisor.processes.values())


def test_processes_end_one_after_the_other(module, tmp_path):
    names = ('machine', 'controller', 'recorder')
    modules = {name: module('obedient', name) for name in names}
    with (tmp_path / 'log').open('w+') as log:
        with Supervisor(modules, log) as supervisor:
            for each in modules.values():
                ready(each)
            assert supervisor.end() == dict.fromkeys(names, 0)
        log.seek(0)
        assert log.read().split() == list(names)
    assert gone(supervisor)


def test_the_awaited_one_gives_its_status(module):
    modules = {'other': module('obedient', 'other'), 'brief': module('brief', 'brief')}
    with Supervisor(modules) as supervisor:
        assert supervisor.wait('brief', PATIENCE) == 3
    assert gone(supervisor)


def test_another_one_that_ends_is_an_error_at_once(module):
    modules = {'machine': module('obedient', 'machine'), 'observer': module('brief', 'observer')}
    with pytest.raises(ProcessDied, match='observer ended early, with status 3') as died:
        with Supervisor(modules) as supervisor:
            supervisor.wait('machine', PATIENCE)
    assert died.value.status == 3
    assert gone(supervisor)


def test_patience_ends(module):
    with pytest.raises(TimeoutError, match='machine'):
        with Supervisor({'machine': module('obedient', 'machine')}) as supervisor:
            supervisor.wait('machine', 0.1)
    assert gone(supervisor)


def test_patience_begins_anew_with_progress(module):
    modules = {'machine': module('obedient', 'machine')}
    looks = iter([*range(50), *[50] * 1000])
    begin = time.monotonic()
    with pytest.raises(TimeoutError, match=r'no progress for 0\.3 s; machine has not ended'):
        with Supervisor(modules) as supervisor:
            supervisor.wait('machine', 0.3, progress=lambda: next(looks))
    # Fifty looks, 0.02 s apart, and patience after the last of them.
    assert time.monotonic() - begin > 50 * 0.02 + 0.3


def test_who_does_not_end_in_its_time_is_killed(module):
    stubborn = module('stubborn', 'machine')
    with Supervisor({'machine': stubborn}, ending={'machine': 0.2}) as supervisor:
        ready(stubborn)
        assert supervisor.end() == {'machine': -signal.SIGKILL}
    assert gone(supervisor)


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_all_in_order(module, number):
    modules = {name: module('obedient', name) for name in ('machine', 'recorder')}
    supervisor = Supervisor(modules)

    def interrupted():
        with supervisor:
            for each in modules.values():
                ready(each)
            signal.raise_signal(number)
            supervisor.wait('machine', PATIENCE)

    with pytest.raises(Stopped) as stopped:
        interrupted()
    assert stopped.value.status == 128 + number
    assert [p.returncode for p in supervisor.processes.values()] == [0, 0]


def test_the_second_signal_kills(module):
    stubborn = module('stubborn', 'machine')
    again = threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT))
    supervisor = Supervisor({'machine': stubborn}, ending={'machine': 60.0})

    def interrupted_twice():
        with supervisor:
            ready(stubborn)
            again.start()
            signal.raise_signal(signal.SIGINT)
            supervisor.wait('machine')

    begin = time.monotonic()
    with pytest.raises(Stopped):
        interrupted_twice()
    again.join()
    assert time.monotonic() - begin < PATIENCE
    assert gone(supervisor)


def test_a_signal_that_comes_while_all_end_well_is_not_swallowed(module):
    def interrupted():
        with Supervisor({'brief': module('brief', 'brief')}) as supervisor:
            supervisor.wait('brief', PATIENCE)
            signal.raise_signal(signal.SIGTERM)

    with pytest.raises(Stopped, match='SIGTERM'):
        interrupted()
