"""Independent pieces of work on the cores of this machine, results in order.

Many pieces go to processes. One alone stays in this process and has all cores for itself: what it
does record by record goes to threads, as compiled simulations run beside Python. So has the last
of many, when the processes beside it have no work any more.

Where the thread that waits keeps a deadline (deadline.py), it waits no longer than that.
"""

import multiprocessing
import multiprocessing.context
import multiprocessing.util
import os
import signal
import sys
import threading
import types
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextvars import ContextVar
from typing import Any

from cg_dynamics.watched_processes import end_with_spawner
from cg_sysid.deadline import OutOfTime, check_time, current

# Does independent pieces of work: (function, arguments of each, what) -> results.
CarryOut = Callable[[Callable, list[tuple], str], list]

POLL_S = 0.2  # between looks at a deadline

_pool: ProcessPoolExecutor | None = None
_knows_script = False  # whether the processes of the pool have run the script
_threads: ContextVar[ThreadPoolExecutor | None] = ContextVar('threads', default=None)


def one_by_one(function: Callable, arguments: list[tuple], what: str) -> list:
    """The simplest way to carry work out: here, in order."""
    return [function(*a) for a in arguments]


def run_all(
    function: Callable[..., Any],
    arguments: Sequence[tuple],
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int, Any], None] = lambda done, total, result: None,
) -> list[Any]:
    """function(*a) for each a in arguments, in parallel.

    Args:
        function: Importable, with arguments and result that can be pickled.
        arguments: One tuple per call.
        workers: Local processes; by default one per core, 0 or 1 to stay on one core.
        executor: Use this instead.
        progress: Called with (done, total, result of the piece that was finished last), first with
            (0, total, None).

    Raises:
        OutOfTime: if a deadline passed; what is under way elsewhere is dropped.
    """
    check_time()
    total = len(arguments)
    if total:
        progress(0, total, None)
    cores = (os.cpu_count() or 1) if workers is None else workers
    if executor is None and cores < 2:
        results = []
        for done, a in enumerate(arguments, start=1):
            check_time()
            results.append(function(*a))
            progress(done, total, results[-1])
        return results
    if executor is None and total == 1:
        results = [_with_threads(cores, function, *arguments[0])]
        progress(1, 1, results[0])
        return results
    if executor is not None:
        futures = [executor.submit(function, *a) for a in arguments]
    else:
        pool = _local(workers, function.__module__ == '__main__')
        futures = [pool.submit(_in_company, function, *a) for a in arguments]
    try:
        for done, future in enumerate(_in_time(futures), start=1):
            progress(done, total, future.result())
    except OutOfTime:
        for future in futures:
            future.cancel()
        if executor is None:
            stop()  # what is under way does not look at our clock
        raise
    return [future.result() for future in futures]


def _in_time(futures: Sequence[Future]) -> Iterator[Future]:
    """Futures as they are done, until the deadline of this thread."""
    left = set(futures)
    while left:
        check_time()
        deadline = current()
        # A deadline may also be brought forward, by somebody who does not wake us.
        patience = None if deadline is None else min(deadline.left, POLL_S)
        done, left = wait(left, patience, FIRST_COMPLETED)
        yield from done


def side_by_side(function: Callable[[Any], Any], items: Sequence[Any]) -> Iterable[Any]:
    """function(item) for each, in order, on the cores that this piece of work has for itself.

    Args:
        function: Spends its time outside Python and changes nothing that another call reads.
        items: What for.
    """
    threads = _threads.get() or (_company.threads() if _company else None)
    return map(function, items) if threads is None else threads.map(function, items)


def _with_threads(cores: int, function: Callable[..., Any], *arguments: Any) -> Any:
    with ThreadPoolExecutor(cores) as threads:
        token = _threads.set(threads)
        try:
            return function(*arguments)
        finally:
            _threads.reset(token)


class _Company:
    """What a process of a pool knows of the others.

    Args:
        busy: Processes with a piece of work.
        processes: All of them, one a core.
    """

    def __init__(self, busy: Any, processes: int):
        self.busy, self.processes = busy, processes
        self._threads: ThreadPoolExecutor | None = None

    def threads(self) -> ThreadPoolExecutor | None:
        """Threads for all cores where no other process has work; else none."""
        if self.processes < 2 or self.busy.value > 1:
            return None
        self._threads = self._threads or ThreadPoolExecutor(self.processes)
        return self._threads


_company: _Company | None = None  # of a process of the pool


def _in_company(function: Callable[..., Any], *arguments: Any) -> Any:
    """function(*arguments) in a process of the pool, counted among those with work."""
    assert _company is not None
    with _company.busy.get_lock():
        _company.busy.value += 1
    try:
        return function(*arguments)
    finally:
        with _company.busy.get_lock():
            _company.busy.value -= 1


class _Process(multiprocessing.context.SpawnProcess):
    """A process that is started without the script that runs in this one.

    A spawned process otherwise runs the script once more, for the sake of what it defines: where
    that is not behind `if __name__ == '__main__'` all its work would begin again in every process,
    and Python breaks the pool. Our work is defined in modules, and needs no script.
    """

    def start(self) -> None:
        """Start with the `__main__` of an interactive Python, which has no file to run."""
        with _starting:
            script = sys.modules['__main__']
            sys.modules['__main__'] = types.ModuleType('__main__')
            try:
                super().start()
            finally:
                sys.modules['__main__'] = script


class _Modules(multiprocessing.context.SpawnContext):
    Process = _Process  # type: ignore[assignment]


_starting = threading.Lock()


def _local(workers: int | None, script: bool = False) -> ProcessPoolExecutor:
    # One pool for the life of the process: starting it costs an import of CasADi per worker.
    # spawn, not fork: a forked child would inherit threads' locks (DDS, BLAS) in unknown states.
    # One BLAS thread each: the matrices are small, and the workers fill the cores.
    global _pool, _knows_script
    if script and not _knows_script:
        stop()
    if _pool is None:
        _knows_script = script
        for library in ('OPENBLAS', 'OMP', 'MKL'):
            os.environ.setdefault(f'{library}_NUM_THREADS', '1')
        context = multiprocessing.get_context('spawn') if script else _Modules()
        processes = workers or os.cpu_count() or 1
        _pool = ProcessPoolExecutor(
            processes,
            mp_context=context,
            initializer=_as_worker,
            initargs=(context.Value('i', 0), processes),
        )
        # A process that multiprocessing started waits for its own processes before Python ends
        # their pool: it would wait for ever.
        multiprocessing.util.Finalize(None, stop, exitpriority=0)
    return _pool


def _as_worker(busy: Any, processes: int) -> None:
    global _company
    _company = _Company(busy, processes)
    # Ctrl-C reaches every process of the terminal; the one that was started answers for all.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_spawner()


def processes() -> list[int]:
    """Ids of this process and of those that work for it here."""
    workers = [] if _pool is None else list(_pool._processes or ())
    return [os.getpid(), *workers]


def stop() -> None:
    """Drop the work that is queued and end the local processes, in the middle of whatever."""
    global _pool
    if _pool is None:
        return
    pool, _pool = _pool, None
    processes = list((pool._processes or {}).values())
    # Work that nobody will take from a full pipe would hold this process when it wants to end.
    if (queue := getattr(pool, '_call_queue', None)) is not None:
        queue.cancel_join_thread()
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()
