"""Work on other machines: an executor whose workers are those of a dask.distributed cluster.

    with Cluster('tcp://192.168.0.7:8786', software) as cluster:
        future = cluster.submit(function, argument)

What is sent is what local processes get, so the answer is the same, as long as the same software
runs on both sides; that is checked. Large arguments are sent once for each content and not with
each piece of work. They travel as a task and not scattered: what is scattered is gone with the
worker that holds it, a task is done again.

dask serialises with pickle: whoever reaches a port of the cluster can run anything on it. Only
trusted hosts may (diagnosis.md).
"""

import asyncio
import ctypes
import faulthandler
import functools
import hashlib
import logging
import os
import re
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from types import ModuleType
from typing import Any, cast

from cg_dynamics.rollout.compiler import compiler
from cg_dynamics.watched_processes import WorkLost

ADDRESS = re.compile(r'(tcp|tls)://(\[[0-9a-fA-F:.%\w]+\]|[^\[\]/:\s]+):\d{1,5}')
ANSWER_S = 5.0  # a scheduler that is there answers within this
PATIENCE_S = 60.0  # without any worker in mid-run: a nanny restarts one within seconds
LARGE = 20_000  # bytes beyond which an argument is sent once, not with each piece of work
FETCH_S = 30.0  # in which a worker hands over a result, or is asked once more
FETCHES = 3
GIVE_UP_S = 0.5  # a worker looks this often whether its work is still wanted


class ClusterError(ConnectionError):
    """A cluster that cannot do the work; the message says why."""


class ClusterWorkLost(ClusterError, WorkLost):
    """A piece of work that ended every worker that took it up."""


class Cluster(Executor):
    """The workers behind a scheduler, until the context is left: then no work is left either.

    Args:
        address: Of the scheduler: tcp://HOST:PORT, or tls://HOST:PORT with keys and certificates
            from dask's own configuration.
        software: What decides an answer, by name; importable, called here and by every worker.
        patience: Time in s without any worker after which work is given up.
        limit: Time in s after which a piece of work ends its worker: for solvers that may hang, on
            workers of one thread with a nanny that restarts them. None: it may take for ever.

    Raises:
        ClusterError: if dask is not installed, no scheduler answers, it has no worker, or a worker
            runs other software than this process.
    """

    def __init__(
        self,
        address: str,
        software: Callable[[], dict[str, str]],
        patience: float = PATIENCE_S,
        limit: float | None = None,
    ):
        if not ADDRESS.fullmatch(address):
            raise ClusterError(
                f'scheduler {address!r}: expected tcp://HOST:PORT or tls://HOST:PORT'
            )
        try:
            import distributed
        except ImportError:
            raise ClusterError(
                f'scheduler {address}: the Python package distributed is not installed; install '
                'requirements/cluster.txt'
            ) from None
        # What goes wrong is said once, by our own errors.
        logging.getLogger('distributed').setLevel(logging.CRITICAL)
        self.address, self._patience, self._limit = address, patience, limit
        _require_scheduler(address)
        self._client = distributed.Client(
            address, timeout=ANSWER_S, name='compass_gait', set_as_default=False
        )
        self._ask, self._software = software, software()
        self._wanted: dict[Any, Future] = {}  # future over there -> future here
        self._placed: dict[str, Any] = {}
        self._left = threading.Event()
        try:
            self._check_workers()
        except BaseException:
            self.shutdown()
            raise
        threading.Thread(target=self._watch, daemon=True).start()

    def submit(self, function: Callable[..., Any], /, *arguments: Any) -> Future:  # type: ignore[override]
        """Have a worker compute function(*arguments)."""
        here: Future = Future()
        there = self._client.submit(
            _work, self._ask, self._software, self._limit, function,
            *map(self._once, arguments), pure=False,
        )  # fmt: skip
        # As long as it is held: what nobody holds, nobody wants.
        self._wanted[there] = here
        there.add_done_callback(self._deliver)
        return here

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Take back all work, finished or not, and leave the cluster."""
        self._left.set()
        if self._wanted:
            self._client.cancel(list(self._wanted), force=True)
        self._client.close()

    def _once(self, argument: Any) -> Any:
        """The argument, or where on the cluster it is if it is large."""
        from distributed.protocol.pickle import dumps

        content = dumps(argument)
        if len(content) < LARGE:
            return argument
        key = f'compass_gait-{hashlib.sha256(content).hexdigest()}'
        if key not in self._placed:
            self._placed[key] = self._client.submit(_same, argument, key=key)
        return self._placed[key]

    def _deliver(self, there: Any) -> None:
        from distributed import KilledWorker

        here = self._wanted.pop(there, None)
        if here is None:
            return
        try:
            here.set_result(_fetched(there))
        except KilledWorker as error:
            here.set_exception(ClusterWorkLost(
                f'scheduler {self.address}: {error.allowed_failures + 1} workers died of the same '
                f'piece of work, the last one at {error.last_worker.address}'
            ))  # fmt: skip
        except BaseException as error:
            if there.status == 'error':
                here.set_exception(error)
            else:
                self._fail(here, 'the connection is lost')

    def _fail(self, here: Future, why: str) -> None:
        here.set_exception(ClusterError(f'scheduler {self.address}: {why}'))

    def _workers(self) -> dict[str, Any]:
        return dict(self._client.scheduler_info()['workers'])

    def _watch(self) -> None:
        """Give up when there is work but has been no worker for too long."""
        without = 0.0
        while not self._left.wait(1.0):
            without = 0.0 if self._workers() else without + 1.0
            if without >= self._patience:
                for there in list(self._wanted):
                    if here := self._wanted.pop(there, None):
                        self._fail(here, f'no worker for {self._patience:g} s')

    def _check_workers(self) -> None:
        if not self._workers():
            raise ClusterError(
                f'scheduler {self.address}: no worker; start some with: dask worker '
                f'{self.address} --nthreads 1'
            )
        # Versions come without unpickling anything, which other versions might not be able to.
        versions = cast(dict[str, Any], self._client.get_versions())
        for worker, found in versions['workers'].items():
            python = found['host']['python'].partition('.final')[0]
            self._same_software(worker, {'python': python})
        for worker, found in self._client.run(self._ask, on_error='return').items():
            if isinstance(found, BaseException):
                raise ClusterError(
                    f'worker {worker}: cannot run this software ({found}); start it in the '
                    'environment of this process'
                )
            self._same_software(worker, found)

    def _same_software(self, worker: str, found: dict[str, str]) -> None:
        difference = _difference(found, self._software)
        if difference:
            raise ClusterError(f'worker {worker}: {difference}')


def _require_scheduler(address: str) -> None:
    """Ask who is there: dask's own client waits for ever where somebody listens and says nothing.

    Raises:
        ClusterError: if it is no scheduler, or nobody.
    """
    import distributed

    async def identity():
        keys = distributed.Security().get_connection_args('client')
        async with distributed.rpc(address, connection_args=keys) as there:
            return await there.identity()

    try:
        # In a thread of its own: a notebook runs an event loop in the one that calls.
        with ThreadPoolExecutor(1) as asking:
            found = asking.submit(asyncio.run, asyncio.wait_for(identity(), ANSWER_S)).result()
    except TypeError:  # how dask says so
        raise ClusterError(
            f'{address}: no certificates; set distributed.comm.tls in the configuration of dask'
        ) from None
    except Exception:  # whatever a stranger may make of the question
        raise ClusterError(f'no scheduler answers at {address} within {ANSWER_S:g} s') from None
    if found['type'] != 'Scheduler':
        raise ClusterError(f'{address} is a {found["type"].lower()}, not a scheduler')


@functools.cache
def source_hash(*packages: ModuleType) -> str:
    """Of the Python and C sources of packages: twelve digits."""
    digest = hashlib.sha256()
    for package in packages:
        folder = Path(str(package.__file__)).parent
        for file in sorted([*folder.rglob('*.py'), *folder.rglob('*.c')]):
            digest.update(f'{package.__name__}/{file.relative_to(folder)}\n'.encode())
            digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def tools_here() -> dict[str, str]:
    """Of the versions that decide an answer those that every cluster has."""
    import distributed

    return {
        'distributed': distributed.__version__,
        'C compiler': 'yes' if compiler() else 'no',
    }


def _difference(worker: dict[str, str], here: dict[str, str]) -> str:
    for name, value in worker.items():
        if value != here[name]:
            return f'it has {name} {value}, this process {here[name]}; both must be the same'
    return ''


def _fetched(there: Any) -> Any:
    """The result of a future that is done; a worker may be slow to answer once."""
    from distributed import TimeoutError as Late

    for _ in range(FETCHES - 1):
        try:
            return there.result(timeout=FETCH_S)
        except Late:
            if there.status == 'error':
                raise  # the work's own
    return there.result(timeout=FETCH_S)


def _same(value: Any) -> Any:
    return value


def _work(
    software: Callable[[], dict[str, str]],
    expected: dict[str, str],
    limit: float | None,
    function: Callable[..., Any],
    *arguments: Any,
) -> Any:
    """On a worker: function(*arguments), left off as soon as nobody wants the result.

    dask lets a function run on when its result is no longer wanted. A fit takes up to minutes, so
    a second thread looks, and raises an exception in the one that works.
    """
    from distributed import Reschedule, get_worker

    worker, thread, over = get_worker(), threading.get_ident(), threading.Event()
    key = worker.get_current_task()
    # Of workers that came later than the check of all.
    difference = _difference(software(), expected)
    if difference:
        raise ClusterError(f'worker {worker.address}: {difference}')

    def watch():
        while not over.wait(GIVE_UP_S):
            task = worker.state.tasks.get(key)
            if task is None or task.state == 'cancelled':
                ctypes.pythonapi.PyThreadState_SetAsyncExc(
                    ctypes.c_ulong(thread), ctypes.py_object(_Unwanted)
                )
                return

    watcher = threading.Thread(target=watch, daemon=True)
    try:
        watcher.start()
        try:
            return function(*arguments) if limit is None else _within(limit, function, arguments)
        finally:
            # Afterwards nothing can be raised any more, and what was raised has arrived.
            over.set()
            watcher.join()
    except _Unwanted:
        raise Reschedule from None


def _within(limit: float, function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
    """function(*arguments), which ends this process where it takes too long.

    The timer of faulthandler needs no Python: a solver that hangs may hold its lock.
    """
    with open(os.devnull, 'w') as nowhere:
        faulthandler.dump_traceback_later(limit, exit=True, file=nowhere)
        try:
            return function(*arguments)
        finally:
            faulthandler.cancel_dump_traceback_later()


class _Unwanted(BaseException):
    """Not an Exception: no fit takes it for a failure of its own."""
