"""Independent pieces of work on the cores of this machine, results in order.

Many pieces go to processes. One alone stays in this process and has all cores for itself: what it
does record by record goes to threads, as compiled simulations run beside Python.
"""

import multiprocessing
import os
import signal
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor, as_completed
from contextvars import ContextVar
from typing import Any

_pool: ProcessPoolExecutor | None = None
_threads: ContextVar[ThreadPoolExecutor | None] = ContextVar('threads', default=None)


def run_all(
    function: Callable[..., Any],
    arguments: Sequence[tuple],
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> list[Any]:
    """function(*a) for each a in arguments, in parallel.

    Args:
        function: Importable, with arguments and result that can be pickled.
        arguments: One tuple per call.
        workers: Local processes; by default one per core, 0 or 1 to stay on one core.
        executor: Use this instead.
        progress: Called with (done, total).
    """
    total = len(arguments)
    cores = (os.cpu_count() or 1) if workers is None else workers
    if executor is None and cores < 2:
        results = []
        for done, a in enumerate(arguments, start=1):
            results.append(function(*a))
            progress(done, total)
        return results
    if executor is None and total == 1:
        results = [_with_threads(cores, function, *arguments[0])]
        progress(1, 1)
        return results
    futures = [(executor or _local(workers)).submit(function, *a) for a in arguments]
    for done, future in enumerate(as_completed(futures), start=1):
        future.result()
        progress(done, total)
    return [future.result() for future in futures]


def side_by_side(function: Callable[[Any], Any], items: Sequence[Any]) -> Iterable[Any]:
    """function(item) for each, in order, on the cores that this piece of work has for itself.

    Args:
        function: Spends its time outside Python and changes nothing that another call reads.
        items: What for.
    """
    threads = _threads.get()
    return map(function, items) if threads is None else threads.map(function, items)


def _with_threads(cores: int, function: Callable[..., Any], *arguments: Any) -> Any:
    with ThreadPoolExecutor(cores) as threads:
        token = _threads.set(threads)
        try:
            return function(*arguments)
        finally:
            _threads.reset(token)


def _local(workers: int | None) -> ProcessPoolExecutor:
    # One pool for the life of the process: starting it costs an import of CasADi per worker.
    # spawn, not fork: a forked child would inherit threads' locks (DDS, BLAS) in unknown states.
    # One BLAS thread each: the matrices are small, and the workers fill the cores.
    global _pool
    if _pool is None:
        for library in ('OPENBLAS', 'OMP', 'MKL'):
            os.environ.setdefault(f'{library}_NUM_THREADS', '1')
        _pool = ProcessPoolExecutor(
            workers or os.cpu_count(),
            mp_context=multiprocessing.get_context('spawn'),
            initializer=_ignore_interrupts,
        )
    return _pool


def _ignore_interrupts() -> None:
    # Ctrl-C reaches every process of the terminal; the one that was started answers for all.
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def stop() -> None:
    """Drop the work that is queued and end the local processes, in the middle of whatever."""
    global _pool
    if _pool is None:
        return
    pool, _pool = _pool, None
    processes = list((pool._processes or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    for process in processes:
        process.terminate()
