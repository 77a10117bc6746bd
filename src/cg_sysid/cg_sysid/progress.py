"""Progress of work that takes long: bars on a terminal, a line now and then where it is piped.

A line says what is done, what is left and which candidate is the best so far. It comes at least
every 10 s, whatever holds the work up: also while a C compiler works on a model's code.
"""

import sys
import threading
import time
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import TracebackType
from typing import Any, TextIO

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from cg_dynamics.rollout.compiler import seconds_under_way
from cg_sysid import parallel

EVERY = 8.0  # s between lines: what keeps Python itself busy may delay one by a second or two


@dataclass(frozen=True)
class Stage:
    """How far one piece of work has come.

    Attributes:
        what: What is done, in words.
        done: Pieces that are finished.
        total: Pieces in all.
        best: The best candidate so far, in words; empty where there is none.
    """

    what: str
    done: int
    total: int
    best: str = ''

    def __str__(self) -> str:
        if self.done < self.total:
            text = f'{self.what}: {self.done} of {self.total} done, {self.total - self.done} left'
        else:
            text = f'{self.what}: done; working out what comes next'
        return f'{text}; best so far: {self.best}' if self.best else text


class Bars(AbstractContextManager):
    """Progress of several pieces of work on stderr.

    Args:
        program: Name at the head of each line.
        quiet: Say nothing.
    """

    def __init__(self, program: str, quiet: bool = False):
        console = Console(stderr=True)
        watched = console.is_terminal
        self._progress = Progress(
            TextColumn('{task.description}'),
            BarColumn(bar_width=30),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TextColumn('{task.fields[best]}'),
            console=console,
            transient=True,
            disable=quiet or not watched,
        )
        self._tasks: dict[str, Any] = {}
        self._lines = None if quiet or watched else Lines(program, EVERY)

    def __enter__(self) -> 'Bars':
        self._progress.start()
        if self._lines is not None:
            self._lines.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._progress.stop()
        if self._lines is not None:
            self._lines.stop()

    def __call__(self, what: str, done: int, total: int, best: str = '') -> None:
        """Note that `done` of `total` pieces are finished, and the best candidate so far."""
        if self._lines is not None:
            self._lines.stage = Stage(what, done, total, best)
        if what not in self._tasks:
            self._tasks[what] = self._progress.add_task(what, total=total, best='')
        task = self._tasks[what]
        shown = f'best so far: {best}' if best else ''
        self._progress.update(task, completed=done, total=total, best=shown)
        if done >= total:
            # The next round may bear the same name.
            self._progress.remove_task(self._tasks.pop(what))


class Lines:
    """Says every few seconds how far the work is, from a thread of its own.

    Args:
        program: Name at the head of each line.
        every: Time between lines in s.
        stream: Where to; stderr by default.

    Attributes:
        stage: How far it is.
    """

    def __init__(self, program: str, every: float, stream: TextIO | None = None):
        self.stage = Stage('starting', 0, 1)
        self._program, self._stream, self._every = program, stream or sys.stderr, every
        self._began = time.monotonic()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name='progress', daemon=True)

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def stop(self) -> None:
        """No further line comes."""
        self._over.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._over.wait(self._every):
            try:
                print(self._line(), file=self._stream, flush=True)
            except (OSError, ValueError):  # nobody reads any more
                return

    def _line(self) -> str:
        text = f'{self._program}: {time.monotonic() - self._began:.0f} s: {self.stage}'
        compiling = seconds_under_way(parallel.processes())
        if compiling:
            text += (
                f'; the C compiler has worked for {compiling:.0f} s on the model (once for each '
                'structure, then it is kept)'
            )
        return text
