"""A dask cluster for tests: a real scheduler and real workers, each a process, on the loopback."""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

distributed = pytest.importorskip('distributed', reason='the cluster part is not installed')

LONG = 60.0  # s; whatever takes longer hangs


class Processes:
    """A scheduler and its workers, on ports that are free, without nannies that restart them."""

    def __init__(self, folder: Path, **settings: str):
        self.folder, self.running = folder, []
        self.environment = {**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path), **settings}

    def __enter__(self):
        notes = self.folder / 'scheduler.json'
        self.scheduler = self._start('scheduler', '--scheduler-file', str(notes))
        self.address = json.loads(until(lambda: read(notes)))['address']
        return self

    def __exit__(self, *exc):
        for process in reversed(self.running):
            process.kill()
            process.wait()

    def add_worker(self, first_on_path: Path | None = None) -> tuple[str, subprocess.Popen]:
        """Name and process of a worker that the scheduler knows, with one thread."""
        environment = dict(self.environment)
        if first_on_path:
            environment['PYTHONPATH'] = f'{first_on_path}{os.pathsep}{environment["PYTHONPATH"]}'
        name = f'worker{len(self.running)}'
        worker = self._start(
            'worker', self.address, '--name', name, '--nthreads', '1', '--no-nanny',
            '--local-directory', str(self.folder), environment=environment,
        )  # fmt: skip
        with self.client() as client:
            until(lambda: name in names_of_workers(client))
        return name, worker

    def client(self):
        return distributed.Client(self.address, set_as_default=False)

    def _start(self, kind, *words, environment=None):
        log = (self.folder / f'{kind}{len(self.running)}.log').open('w')
        self.running.append(
            subprocess.Popen(
                [sys.executable, '-m', f'distributed.cli.dask_{kind}', *words, '--host',
                 '127.0.0.1', '--port' if kind == 'scheduler' else '--worker-port', '0',
                 '--dashboard-address', '127.0.0.1:0'],
                cwd=self.folder, env=environment or self.environment, stdout=log, stderr=log,
            )
        )  # fmt: skip
        return self.running[-1]


def until(condition, limit=LONG):
    """Wait for something to be true; returns it."""
    deadline = time.monotonic() + limit
    while not (found := condition()):
        assert time.monotonic() < deadline, 'waited in vain'
        time.sleep(0.01)
    return found


def read(file):
    return file.exists() and file.read_text()


def names_of_workers(client):
    return {worker['name'] for worker in client.scheduler_info()['workers'].values()}
