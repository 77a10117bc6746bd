"""Fits on a cluster: a real scheduler and real workers, each a process, on the loopback."""

import functools
import itertools
import math
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from cluster_processes import LONG, Processes, names_of_workers, read, until

import cg_sysid
from cg_dynamics import cluster
from cg_dynamics.cluster import FETCHES, _fetched
from cg_dynamics.model import Model
from cg_sysid import cluster as ours
from cg_sysid.cli import diagnose as diagnose_cli
from cg_sysid.cluster import Cluster, ClusterError
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.parallel import run_all

distributed = pytest.importorskip('distributed', reason='the cluster part is not installed')

# One scheduler and its workers serve all of these tests.
pytestmark = pytest.mark.xdist_group('cluster')

EFFECTS = ('torque_bias', 'quadratic_friction', 'torque_constant')


# Workers cannot import tests: what they run of this file has no name, so that it travels whole.
def working(client):
    """Whether any thread of a worker is at something, wanted or not."""
    found = client.run(lambda dask_worker: len(dask_worker.active_threads))
    return any(found.values())


def tasks(client):
    """Keys of all that the scheduler knows of."""
    return client.run_on_scheduler(lambda dask_scheduler: list(dask_scheduler.tasks))


@pytest.fixture(scope='module')
def processes(tmp_path_factory):
    """Two workers."""
    with Processes(tmp_path_factory.mktemp('cluster')) as found:
        found.add_worker()
        found.add_worker()
        yield found


@pytest.fixture(scope='module')
def local(loaded, model_file):
    """What local processes answer."""
    options = Options(effects=EFFECTS, rounds=1, workers=1)
    return diagnose(Model.load(model_file), loaded.records, options)


def assert_same(found, local):
    assert found.verdict == local.verdict == 'explained'
    assert found.summary == local.summary
    for a, b in zip(found.rounds[0].candidates, local.rounds[0].candidates, strict=True):
        assert a.label == b.label
        # The same software on the same machine computes the same bits.
        assert a.evidence == b.evidence
        assert a.held_gain == b.held_gain
        assert a.train.values.tolist() == b.train.values.tolist()
        assert a.train.sigmas.tolist() == b.train.sigmas.tolist()


def test_the_answer_is_that_of_local_processes(processes, local, loaded, model_file):
    options = Options(effects=EFFECTS, rounds=1)
    with Cluster(processes.address) as workers, processes.client() as client:
        found = diagnose(Model.load(model_file), loaded.records, options, executor=workers)
        # Two sets of data sets, sent once each, however many fits there were; and for the last
        # fit both together, and where it sets out.
        sent = [key for key in tasks(client) if key.startswith('compass_gait')]
    assert len(sent) == 4
    assert_same(found, local)


class Stalling(Cluster):
    """A cluster where the second piece of work gets stuck on the first worker that has it."""

    def __init__(self, address, marker):
        super().__init__(address)
        self.numbers, self.marker = itertools.count(1), str(marker)

    def submit(self, function, /, *arguments):
        if next(self.numbers) == 2:
            return super().submit(stuck_once(self.marker), function, *arguments)
        return super().submit(function, *arguments)


def stuck_once(marker):
    def stuck(function, *arguments):
        try:
            file = open(marker, 'x')
        except FileExistsError:
            return function(*arguments)
        with file:
            file.write(str(os.getpid()))
        while True:
            time.sleep(1)

    return stuck


def kill_who_is_stuck(marker):
    pid = int(until(lambda: read(marker)))
    os.kill(pid, signal.SIGKILL)
    return pid


def test_a_worker_killed_in_mid_run_changes_nothing(
    processes, local, loaded, model_file, tmp_path
):
    model, options = Model.load(model_file), Options(effects=EFFECTS, rounds=1)
    marker, steps = tmp_path / 'pid', []
    processes.add_worker()
    with Stalling(processes.address, marker) as workers, ThreadPoolExecutor(1) as other:
        killed = other.submit(kill_who_is_stuck, marker)
        found = diagnose(model, loaded.records, options, lambda *step: steps.append(step), workers)
        assert killed.result() in [process.pid for process in processes.running[1:]]
    assert_same(found, local)
    for what in dict.fromkeys(step[0] for step in steps):
        counts = [(done, total) for name, done, total, _ in steps if name == what]
        assert counts == [(k, len(counts) - 1) for k in range(len(counts))], what


def endless(marker):
    def run():
        marker.write_text('begun')
        while True:
            pass

    return run


def test_an_interrupt_leaves_no_work_on_the_cluster(processes, tmp_path):
    marker = tmp_path / 'marker'

    def interrupted():
        with Cluster(processes.address) as workers:
            for _ in range(8):
                workers.submit(endless(marker))
            until(lambda: read(marker))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    with processes.client() as client:
        until(lambda: not tasks(client))
        # Nor in the threads: dask alone would let them run.
        until(lambda: not working(client))


def test_the_command_line_fits_on_the_cluster_and_can_be_interrupted(
    processes, bags, model_file, tmp_path
):
    words = ['--model', str(model_file), '--out', str(tmp_path), '--scheduler', processes.address]
    with processes.client() as client:
        program = subprocess.Popen(
            [sys.executable, '-m', 'cg_sysid.cli.diagnose', *words, *map(str, bags)],
            env=processes.environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            # Jobs in the background of a shell ignore SIGINT, and all that they start.
            preexec_fn=functools.partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
        )  # fmt: skip
        until(lambda: working(client))
        program.send_signal(signal.SIGINT)
        out, err = program.communicate(timeout=LONG)
        # Before any fit there is nothing to answer with, and after one the best so far.
        assert 'cg diagnose: the best answer so far follows' in err
        assert 'interrupted after' in (out or err).replace('\n', ' ')
        assert program.returncode == (0 if out else 130)
        until(lambda: not tasks(client))
        until(lambda: not working(client))


def test_an_error_of_the_work_comes_back(processes):
    with Cluster(processes.address) as workers, pytest.raises(ValueError, match='math domain'):
        run_all(math.sqrt, [(4.0,), (-1.0,)], executor=workers)


class _Slow:
    """A future that is done, on a worker that does not answer at first."""

    def __init__(self, silent, status='finished'):
        self.silent, self.status = silent, status

    def result(self, timeout):
        if self.silent:
            self.silent -= 1
            raise distributed.TimeoutError
        return 'here'


def test_a_worker_that_does_not_answer_is_asked_again_and_not_for_ever():
    assert _fetched(_Slow(FETCHES - 1)) == 'here'
    for silent in (_Slow(FETCHES), _Slow(1, 'error')):
        with pytest.raises(distributed.TimeoutError):
            _fetched(silent)


def test_work_that_cannot_be_done_ends_with_one_error(tmp_path):
    # One death is enough here; the default is four.
    with Processes(tmp_path, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES='0') as lost:
        at = f'scheduler {lost.address}: '
        with pytest.raises(ClusterError) as none:
            Cluster(lost.address)
        assert str(none.value) == (
            f'{at}no worker; start some with: dask worker {lost.address} --nthreads 1'
        )
        lost.add_worker()
        with Cluster(lost.address, patience=1.0) as workers:
            with pytest.raises(ClusterError, match=f'{at}1 workers died of the same piece of'):
                workers.submit(os._exit, 1).result(LONG)
            with pytest.raises(ClusterError, match=f'{at}no worker for 1 s'):
                workers.submit(math.sqrt, 4.0).result(LONG)
            waiting = workers.submit(math.sqrt, 4.0)
            lost.scheduler.kill()
            with pytest.raises(ClusterError, match=f'{at}the connection is lost'):
                waiting.result(LONG)


def test_a_worker_with_another_source_is_refused(processes, tmp_path):
    copied = tmp_path / 'cg_sysid'
    shutil.copytree(Path(cg_sysid.__file__).parent, copied)
    with (copied / 'cluster.py').open('a') as file:
        file.write('# Another version.\n')
    refused(processes, tmp_path, 'it has source of cg_sysid and what it imports ')


def test_a_worker_without_this_software_is_refused(processes, tmp_path):
    (tmp_path / 'cg_sysid.py').write_text("raise ImportError('not here')\n")
    refused(processes, tmp_path, 'cannot run this software ')


def refused(processes, first_on_path, why):
    name, worker = processes.add_worker(first_on_path)
    try:
        with pytest.raises(ClusterError, match=f'^worker tcp://.*: {why}'):
            Cluster(processes.address)
    finally:
        worker.kill()
        with processes.client() as client:
            until(lambda: name not in names_of_workers(client))


def test_another_python_is_refused(processes, monkeypatch):
    other = {**ours.software_here(), 'python': '3.4.1'}
    monkeypatch.setattr(ours, 'software_here', lambda: other)
    with pytest.raises(ClusterError, match=r'it has python 3.*, this process 3\.4\.1'):
        Cluster(processes.address)


def test_without_dask_the_command_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    with pytest.raises(ClusterError, match='package distributed is not installed; install'):
        Cluster('tcp://127.0.0.1:8786')


@pytest.mark.parametrize('answering', [False, True])
def test_no_scheduler_is_one_line_within_seconds(
    answering, bags, model_file, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(cluster, 'ANSWER_S', 1.0)
    with socket.create_server(('127.0.0.1', 0)) as server:
        address = f'tcp://127.0.0.1:{server.getsockname()[1]}'
        if not answering:
            # Nobody listens there now; else somebody does who never says a word.
            server.close()
        begun = time.monotonic()
        code = diagnose_cli.main([
            '--model', str(model_file), '--out', str(tmp_path), '--scheduler', address,
            *map(str, bags),
        ])  # fmt: skip
        assert code == 2
        assert time.monotonic() - begun < 10 * cluster.ANSWER_S
    assert capsys.readouterr().err == (
        f'cg diagnose: error: no scheduler answers at {address} within 1 s\n'
    )


def test_a_worker_is_not_a_scheduler(processes):
    with processes.client() as client:
        address = next(iter(client.scheduler_info()['workers']))
    with pytest.raises(ClusterError, match=f'{address} is a worker, not a scheduler'):
        Cluster(address)


def test_no_certificates_are_said_to_be_missing():
    with pytest.raises(ClusterError, match='no certificates; set distributed'):
        Cluster('tls://127.0.0.1:8786')


@pytest.mark.parametrize('address', ['127.0.0.1:8786', 'tcp://host', 'http://host:1', ''])
def test_an_address_of_another_form_is_refused(address):
    with pytest.raises(ClusterError, match='expected tcp://HOST:PORT or tls://HOST:PORT'):
        Cluster(address)


def test_workers_of_two_kinds_are_not_asked_for_at_once(bags, model_file, tmp_path, capsys):
    words = f'--model {model_file} --out {tmp_path} --workers 2 --scheduler tcp://h:1 {bags[0]}'
    assert diagnose_cli.main(words.split()) == 2
    assert capsys.readouterr().err == (
        'cg diagnose: error: --workers are local processes; leave it out where --scheduler is '
        'given\n'
    )
