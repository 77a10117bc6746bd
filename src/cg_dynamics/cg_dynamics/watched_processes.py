"""Processes that are watched while they work: one that hangs or dies costs its piece of work only.

    with WatchedProcesses(2, limit=60.0) as processes:
        future = processes.submit(function, argument)

A `ProcessPoolExecutor` waits for ever for a process that hangs, and is broken for good by one that
dies. Here each process has a thread that waits for its answers: after `limit` the process is
killed, the future says `WorkLost`, and a new process goes on with what is queued. That a solver
holds the interpreter's lock does not matter, because it is another interpreter's.

The clock of a piece begins when its function is imported there. Processes are spawned: a forked
one would inherit the locks of threads in unknown states. They ignore the signals that a terminal
or a supervisor sends to all of a group: the process that started them answers for them, and when
it is gone, however it went, they end by themselves.
"""

import contextlib
import math
import multiprocessing
import os
import pickle
import queue
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Executor, Future
from multiprocessing.connection import Connection
from typing import Any

from cg_dynamics.stop_request import SIGNALS

LIMIT = 60.0  # s for a piece of work; generous, as other work may keep the cores
BEGIN = 300.0  # s in which a process has to be there, imports included
STARTS = 3  # processes that may end before they begin, one after the other

BEGUN, DONE, FAILED = 'begun', 'done', 'failed'


class WorkLost(RuntimeError):
    """A piece of work whose process hung or died, so that nobody knows its result."""


class WatchedProcesses(Executor):
    """So many processes on this machine, until the context is left: then all of them end.

    Args:
        count: Processes; each is started with the first piece of work that it gets.
        limit: Time in s of wall after which a piece of work is lost, and its process killed.
    """

    def __init__(self, count: int, limit: float = LIMIT):
        if count < 1 or not 0 < limit < math.inf:
            raise ValueError(
                f'count is {count}, limit {limit} s; both must be positive and finite'
            )
        self._limit, self._over = limit, threading.Event()
        self._work: queue.SimpleQueue = queue.SimpleQueue()
        self._processes: list[_Process | None] = [None] * count
        self._lock = threading.Lock()
        self._threads = [
            threading.Thread(target=self._serve, args=(k,), daemon=True) for k in range(count)
        ]
        for thread in self._threads:
            thread.start()

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future:  # type: ignore[override]
        """Have a process compute function(*arguments); all of it can be pickled."""
        if self._over.is_set():
            raise RuntimeError('the processes have been ended; there is nobody to work')
        future: Future = Future()
        self._work.put((future, pickle.dumps((function, arguments))))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """End the processes, in the middle of whatever; what is queued is cancelled."""
        self._over.set()
        with self._lock:
            for process in self._processes:
                if process is not None:
                    process.kill()
        for _ in self._threads:
            self._work.put(None)
        for thread in self._threads if wait else ():
            thread.join()

    def _serve(self, k: int) -> None:
        """Hand work to process k, one piece after the other."""
        while (piece := self._work.get()) is not None:
            future, call = piece
            if self._over.is_set():
                future.cancel()
            elif future.set_running_or_notify_cancel():
                try:
                    future.set_result(self._result(k, call))
                except BaseException as error:
                    future.set_exception(error)

    def _result(self, k: int, call: bytes) -> Any:
        for _ in range(STARTS):
            process = self._ready(k)
            try:
                process.begin(call)
                break
            except _NotBegun:
                process.kill()
        else:
            raise RuntimeError(
                f'{STARTS} processes ended, or hung, before they began to work; a script that '
                "starts some needs `if __name__ == '__main__':`"
            )
        try:
            return process.result(self._limit)
        except WorkLost:
            process.kill()
            raise

    def _ready(self, k: int) -> '_Process':
        """Process k, a new one if it has ended meanwhile."""
        process = self._processes[k]
        if process is None or not process.alive:
            process = _Process()
            with self._lock:
                self._processes[k] = process
                if self._over.is_set():
                    process.kill()
                    raise WorkLost('the processes have been ended')
        return process


class _NotBegun(Exception):
    """A process that does not take up its work."""


class _Process:
    """One process, and the pipe to it."""

    def __init__(self) -> None:
        self._pipe, there = multiprocessing.Pipe()
        context = multiprocessing.get_context('spawn')
        self._process = context.Process(target=_work, args=(there,), daemon=True)
        self._process.start()
        there.close()  # so that the end of the process is the end of the pipe

    @property
    def alive(self) -> bool:
        """Whether it runs."""
        return self._process.is_alive()

    def begin(self, call: bytes) -> None:
        """Have it take up a piece of work."""
        try:
            self._pipe.send_bytes(call)
            if not self._pipe.poll(BEGIN) or self._pipe.recv() != (BEGUN, None):
                raise _NotBegun
        except (EOFError, OSError):
            raise _NotBegun from None

    def result(self, limit: float) -> Any:
        """What the work came to."""
        try:
            if not self._pipe.poll(limit):
                raise WorkLost(f'no result within {limit:g} s; its process has been killed')
            how, value = self._pipe.recv()
        except (EOFError, OSError):
            raise WorkLost('its process died') from None
        if how == FAILED:
            raise value
        return value

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.join()


def _work(pipe: Connection) -> None:
    """What a process does: one piece of work after the other."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    end_with_spawner()
    # Who asked may be gone, or no longer wait.
    with contextlib.suppress(EOFError, OSError):
        while True:
            function, arguments = _unpacked(pipe.recv_bytes())
            pipe.send((BEGUN, None))
            pipe.send_bytes(_answer(function, arguments))


def _unpacked(call: bytes) -> tuple[Callable[..., Any], tuple]:
    try:
        return pickle.loads(call)
    except Exception as error:  # of its imports, too
        return _fail, (error,)


def _fail(error: Exception) -> None:
    raise error


def _answer(function: Callable[..., Any], arguments: tuple) -> bytes:
    try:
        return pickle.dumps((DONE, function(*arguments)))
    except Exception as error:
        try:
            return pickle.dumps((FAILED, error))
        except Exception:
            return pickle.dumps((FAILED, RuntimeError(f'{type(error).__name__}: {error}')))


def end_with_spawner() -> None:
    """Let this spawned process end when the one that spawned it does, however that went.

    A process that is killed tells nobody, and its workers would wait for work for ever.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None

    def wait() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=wait, daemon=True).start()
