"""Processes that belong together: started, watched, and ended in order.

Each process has a session of its own, so that Ctrl-C reaches the supervisor alone, and a lifeline
(cg_dynamics.stop_request), so that it does not outlive the supervisor. They are ended one after
the other, in the order in which they are named: name the machine first, whose motor then is
without torque, and a recorder last, which hears the last words of the others.
"""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import IO

from cg_bringup.runs import ENDING, NodeOf, enclave_arguments, parameter_file_text
from cg_dynamics.stop_request import ON_STDIN, StopRequest

POLL = 0.02  # s


class ProcessDied(RuntimeError):
    """A process ended that should not have.

    Attributes:
        name: Its name.
        status: Its exit status, negative for a signal.
    """

    def __init__(self, name: str, status: int):
        by = f'by {signal.Signals(-status).name}' if status < 0 else f'with status {status}'
        super().__init__(f'{name} ended early, {by}')
        self.name, self.status = name, status


class Supervisor:
    """Context in which processes run; none is left behind it.

    SIGINT, SIGTERM and SIGHUP end the processes in order and raise Stopped; another one meanwhile
    kills those that are left.

    Args:
        modules: Name -> Python module and its arguments, in the order of ending.
        output: File that gets what the processes say; None for the terminal.
        ending: Name -> s that the process has to end in, where it is not ENDING.

    Attributes:
        processes: Name -> process.
        stop: The signals that came.
    """

    def __init__(
        self,
        modules: Mapping[str, list[str]],
        output: IO | None = None,
        ending: Mapping[str, float] | None = None,
    ):
        self._modules, self._output, self._ending = modules, output, ending or {}
        self.processes: dict[str, subprocess.Popen] = {}

    def __enter__(self) -> 'Supervisor':
        self.stop = StopRequest()
        try:
            for name in self._modules:
                self.start(name)
        except BaseException as error:
            self.__exit__(type(error))
            raise
        return self

    def start(self, name: str) -> None:
        """Start a process, or start it again once it has ended."""
        if name in self.processes:
            self._see_off(self.processes[name])
        self.processes[name] = subprocess.Popen(
            [sys.executable, '-m', 'cg_dynamics.stop_request', *self._modules[name]],
            stdin=subprocess.PIPE,
            stdout=self._output,
            stderr=None if self._output is None else subprocess.STDOUT,
            env=os.environ | ON_STDIN,
            start_new_session=True,
        )

    def __exit__(self, kind: type[BaseException] | None = None, *_: object) -> None:
        self.end()
        self.stop.restore()
        if kind is None:
            self.stop.check()

    @staticmethod
    def _see_off(process: subprocess.Popen) -> None:
        """Nothing is left of a process that has ended."""
        # What it has started is in its session, and goes with it.
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        if process.stdin is not None:
            process.stdin.close()

    def wait(
        self,
        name: str,
        patience: float = float('inf'),
        on_wait: Callable[[], None] = lambda: None,
        progress: Callable[[], object] = lambda: None,
    ) -> int:
        """Exit status of a process, when it has ended.

        Args:
            name: Which one.
            patience: Longest wait in s without progress.
            on_wait: Called some times a second meanwhile.
            progress: Gives something else whenever there is progress.

        Raises:
            ProcessDied: Another one ended before it.
            Stopped: A signal came.
            TimeoutError: Patience is over.
        """
        deadline = time.monotonic() + patience
        reached = progress()
        awaited = self.processes[name]
        while awaited.poll() is None:
            self.stop.check()
            on_wait()
            now_at = progress()
            if now_at != reached:
                reached, deadline = now_at, time.monotonic() + patience
            for other, process in self.processes.items():
                # The awaited one may have ended between the two looks, and the others after it.
                if process.poll() is not None and awaited.poll() is None:
                    raise ProcessDied(other, process.returncode)
            if time.monotonic() > deadline:
                raise TimeoutError(f'no progress for {patience:g} s; {name} has not ended')
            time.sleep(POLL)
        return awaited.returncode

    def end(self) -> dict[str, int]:
        """End the processes in order; name -> exit status, negative for a signal."""
        heard = max(1, self.stop.count)
        return {name: self._end(name, process, heard) for name, process in self.processes.items()}

    def _end(self, name: str, process: subprocess.Popen, heard: int) -> int:
        if process.poll() is None:
            process.terminate()
        deadline = time.monotonic() + self._ending.get(name, ENDING)
        while process.poll() is None:
            if time.monotonic() > deadline or self.stop.count > heard:
                process.kill()
                process.wait()
            time.sleep(0.2 * POLL)
        self._see_off(process)
        return process.returncode


@contextlib.contextmanager
def supervised(nodes: Mapping[str, NodeOf], output: IO | None = None) -> Iterator[Supervisor]:
    """Run nodes as processes, in the context of their supervisor."""
    with tempfile.TemporaryDirectory(prefix='cg_run_') as directory:
        parameters = Path(directory) / 'parameters.yaml'
        parameters.write_text(parameter_file_text(nodes), encoding='utf-8')
        modules = {name: _module(name, node, parameters) for name, node in nodes.items()}
        ending = {name: node.ending for name, node in nodes.items()}
        with Supervisor(modules, output, ending) as supervisor:
            yield supervisor


def _module(name: str, node: NodeOf, parameters: Path) -> list[str]:
    remapped = [word for a, b in node.remappings for word in ('-r', f'{a}:={b}')]
    arguments = ['--params-file', str(parameters), *remapped, *enclave_arguments(name)]
    return [f'{node.package}.{node.executable}', '--ros-args', *arguments]
