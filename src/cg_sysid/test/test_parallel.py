"""One piece of work alone has all cores; what it comes to is the same to the bit."""

import math
import multiprocessing
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_sysid import parallel
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.parallel import run_all, side_by_side

SPRINGS = tuple(Spring('inner', 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3))


def _meet(count):
    """True for each of `count` calls that are under way at the same time."""
    together = threading.Barrier(count)

    def wait(_):
        try:
            return together.wait(timeout=5.0) >= 0
        except threading.BrokenBarrierError:
            return False

    return list(side_by_side(wait, range(count)))


def test_one_piece_alone_has_all_cores():
    before = threading.active_count()
    assert run_all(_meet, [(2,)], workers=2) == [[True, True]]
    assert threading.active_count() == before


# The last piece waits until two of its calls are under way at the same time.
LAST = """
from cg_sysid.parallel import run_all, side_by_side
import threading
import time
def meet(seconds):
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        together = threading.Barrier(2)
        def wait(_):
            try:
                return together.wait(timeout=0.05) >= 0
            except threading.BrokenBarrierError:
                return False
        if all(list(side_by_side(wait, range(2)))):
            return True
    return False
if __name__ == '__main__':
    print(run_all(meet, [(0.0,), (50.0,)], workers=2))
"""


def test_the_last_piece_has_the_cores_of_those_that_are_done(tmp_path):
    assert _said_by(LAST, tmp_path) == '[False, True]\n'


def test_a_piece_beside_others_has_one_core():
    company = parallel._Company(multiprocessing.Value('i', 2), 2)
    assert company.threads() is None
    company.busy.value = 1
    assert company.threads() is company.threads() is not None
    assert parallel._Company(company.busy, 1).threads() is None


def test_results_come_in_order_and_errors_through():
    assert run_all(_squares, [([3, 1, 2],)], workers=2) == [[9, 1, 4]]
    assert list(side_by_side(abs, [-3, -1])) == [3, 1]
    with pytest.raises(ValueError, match=r'math domain|nonnegative'):
        run_all(_roots, [([4.0, -1.0],)], workers=2)


SCRIPT = """
from cg_sysid.parallel import run_all
import math
print('once', flush=True)
print(run_all(math.sqrt, [(4.0,), (9.0,)], workers=2))
"""
GUARDED = """
from cg_sysid.parallel import run_all
import math
def cube(x):
    return x**3
if __name__ == '__main__':
    print(run_all(math.sqrt, [(4.0,), (9.0,)], workers=2))
    print(run_all(cube, [(2.0,), (3.0,)], workers=2))
"""
# Work that lasts: both workers are there when it ends.
IN_A_PROCESS = """
from cg_sysid.parallel import run_all
import multiprocessing
import time
def work():
    print(run_all(time.sleep, [(1.0,), (1.0,)], workers=2), flush=True)
if __name__ == '__main__':
    process = multiprocessing.get_context('spawn').Process(target=work)
    process.start()
    process.join(50.0)
    print(process.exitcode)
    process.kill()
"""


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        (SCRIPT, 'once\n[2.0, 3.0]\n'),
        (GUARDED, '[2.0, 3.0]\n[8.0, 27.0]\n'),
        (IN_A_PROCESS, '[None, None]\n0\n'),
    ],
)
def test_a_script_needs_no_guard_and_may_have_functions_and_processes_of_its_own(
    text, said, tmp_path
):
    assert _said_by(text, tmp_path) == said


def _said_by(text, folder):
    """What a script prints; it has to end well."""
    (folder / 'script.py').write_text(text)
    done = subprocess.run(
        [sys.executable, 'script.py'], cwd=folder, capture_output=True, text=True,
        timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_progress_hears_of_every_result_as_it_comes():
    heard = []
    run_all(math.sqrt, [(4.0,), (9.0,)], workers=0, progress=lambda *said: heard.append(said))
    assert heard == [(0, 2, None), (1, 2, 2.0), (2, 2, 3.0)]


def _squares(items):
    return list(side_by_side(lambda x: x * x, items))


def _roots(items):
    return list(side_by_side(math.sqrt, items))


def test_a_fit_in_threads_is_the_same_to_the_bit(model_file):
    nominal = Model.load(model_file)
    machine = nominal.with_values({'c1': 1.06 * nominal.values['c1']})
    records = [
        rehearse(
            f'record_{k}', machine, Setup(springs=SPRINGS), [0.1 - 0.2 * k, -0.1, 0.3, -0.5],
            [lambda t, k=k: 9.0 * math.sin(2 * math.pi * (0.5 + 0.2 * k + 0.1 * t) * t)],
            4.0, 0.004, k,
        )
        for k in range(3)
    ]  # fmt: skip
    data_sets = prepare(nominal, records)
    (beside,) = run_all(fit, [(nominal, data_sets)], workers=2)
    alone = fit(nominal, data_sets)
    assert beside.evaluations == alone.evaluations
    np.testing.assert_array_equal(beside.values, alone.values)
    np.testing.assert_array_equal(beside.covariance, alone.covariance)


STOPPED_IN_THE_MIDDLE = """
import time

from cg_sysid.deadline import Deadline, OutOfTime
from cg_sysid.parallel import run_all


def sleep(seconds, ballast):
    time.sleep(seconds)


if __name__ == '__main__':
    # More than a pipe holds, and more pieces than processes: some of it stays in the pipe.
    pieces = [(30.0, bytes(4_000_000)) for _ in range(8)]
    try:
        with Deadline(2.0).kept():
            run_all(sleep, pieces, workers=2)
    except OutOfTime:
        print('out of time')
"""


def test_work_that_was_dropped_does_not_hold_the_end(tmp_path):
    script = tmp_path / 'stopped.py'
    script.write_text(STOPPED_IN_THE_MIDDLE)
    # Starting two processes takes a second or two each on a busy machine; the pieces 30.
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=25, check=False
    )
    assert done.stdout == 'out of time\n', done.stderr


KILLED = """
import os
import time

from cg_sysid.parallel import run_all


def who(_):
    time.sleep(0.5)
    return os.getpid()


if __name__ == '__main__':
    print(*run_all(who, [(k,) for k in range(4)], workers=2), flush=True)
    os.kill(os.getpid(), 9)
"""


def test_workers_end_with_a_parent_that_is_killed(tmp_path):
    script = tmp_path / 'killed.py'
    script.write_text(KILLED)
    done = subprocess.run(
        [sys.executable, script], capture_output=True, text=True, timeout=60, check=False
    )
    workers = {int(word) for word in done.stdout.split()}
    assert workers, done.stderr
    deadline = time.monotonic() + 20.0  # they notice at once, when they get to run
    while any(Path(f'/proc/{worker}').exists() for worker in workers):
        assert time.monotonic() < deadline, workers
        time.sleep(0.05)
