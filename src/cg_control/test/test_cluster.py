"""Planning on a cluster: the same tree, to the bit, and states that end their workers."""

import socket
import sys
import time

import pytest
from small_growth import ROUND, assert_same, make_small

from cg_control import grow_tree
from cg_control.trees.cluster import Cluster
from cg_dynamics import cluster
from cg_dynamics.cluster import ClusterError
from cg_dynamics.rollout.compiler import compiler
from cg_dynamics.watched_processes import WorkLost

pytest.importorskip('distributed', reason='the cluster part is not installed')

from cluster_processes import LONG, Processes

NEVER = 10_000.0  # s


@pytest.mark.skipif(
    compiler() is None, reason='no C compiler: thousands of rollouts would take too long'
)
def test_a_tree_that_a_cluster_plans_is_the_same(robot, tmp_path, monkeypatch):
    make_small(monkeypatch)
    here = grow_tree.grow(robot, 'either', 2 * ROUND, 1)
    with Processes(tmp_path) as processes:
        processes.add_worker()
        processes.add_worker()
        with Cluster(processes.address) as workers:
            there = grow_tree.grow(robot, 'either', 2 * ROUND, 1, workers)
    assert len(here.nodes) > 100
    assert_same(there, here)


def test_work_that_ends_its_workers_is_lost(tmp_path):
    # One worker is enough here; the default is four.
    with Processes(tmp_path, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES='0') as processes:
        processes.add_worker()
        with Cluster(processes.address, limit=0.5) as workers:
            assert workers.submit(abs, -2).result(LONG) == 2
            hanging = workers.submit(time.sleep, NEVER)
            with pytest.raises(WorkLost, match='1 workers died of the same piece of work'):
                hanging.result(LONG)


def test_without_dask_the_command_says_what_to_install(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, 'distributed', None)
    words = ['--scheduler', 'tcp://127.0.0.1:8786', '--out', str(tmp_path / 'tree.npz')]
    assert grow_tree.main(words) == 2
    assert 'package distributed is not installed; install' in capsys.readouterr().err


def test_no_scheduler_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cluster, 'ANSWER_S', 1.0)
    with socket.create_server(('127.0.0.1', 0)) as server:
        address = f'tcp://127.0.0.1:{server.getsockname()[1]}'
    words = ['--scheduler', address, '--out', str(tmp_path / 'tree.npz')]
    assert grow_tree.main(words) == 2
    assert capsys.readouterr().err.startswith(f'grow_tree: no scheduler answers at {address}')


def test_another_software_is_refused(tmp_path, monkeypatch):
    from cg_control.trees import cluster as ours

    other = {**ours.software_here(), 'python': '3.4.1'}
    monkeypatch.setattr(ours, 'software_here', lambda: other)
    with Processes(tmp_path) as processes:
        processes.add_worker()
        with pytest.raises(ClusterError, match=r'it has python 3.*, this process 3\.4\.1'):
            Cluster(processes.address)
