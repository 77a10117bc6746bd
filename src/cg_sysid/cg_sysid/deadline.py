"""When a piece of work has to end: after a time, or when somebody asks for it.

    deadline = Deadline(120.0)
    with deadline.interruptible('cg diagnose'):  # Ctrl-C asks for the end, a second one insists
        with deadline.kept():
            ...  # every long loop calls check_time()

`check_time` raises `OutOfTime` where the deadline has passed; whoever started the work catches
that and answers with what is known.
"""

import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar


class OutOfTime(Exception):
    """The deadline has passed; no error of the work, and caught by nobody who mends errors."""


class Deadline:
    """The end of a piece of work.

    Args:
        seconds: Time in s from now; by default it ends when somebody asks.
        clock: A clock in s that never jumps.
    """

    def __init__(self, seconds: float = float('inf'), clock: Callable[[], float] = time.monotonic):
        self.seconds = seconds
        self._clock, self._began, self._asked = clock, clock(), threading.Event()

    @property
    def passed(self) -> float:
        """Time in s since the work began."""
        return self._clock() - self._began

    @property
    def left(self) -> float:
        """Time in s that is left; none where somebody asked for the end."""
        return 0.0 if self._asked.is_set() else max(self.seconds - self.passed, 0.0)

    @property
    def over(self) -> bool:
        """Whether it is time to end."""
        return self.left <= 0.0

    @property
    def why(self) -> str:
        """What ended the work, in words."""
        if self._asked.is_set():
            return f'interrupted after {self.passed:.0f} s'
        return f'stopped at the end of its budget of {self.seconds:g} s'

    def ask(self) -> None:
        """Ask for the end, from any thread."""
        self._asked.set()

    @contextmanager
    def interruptible(self, program: str) -> Iterator[None]:
        """Let Ctrl-C ask for the end, and a second one break the program off.

        Only the main thread hears signals; in another nothing changes.

        Args:
            program: Name at the head of the line that says so.
        """

        def on_interrupt(*_: object) -> None:
            if self._asked.is_set():
                raise KeyboardInterrupt
            self.ask()
            print(f'\n{program}: the best answer so far follows (Ctrl-C again drops it)',
                  file=sys.stderr, flush=True)  # fmt: skip

        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = signal.signal(signal.SIGINT, on_interrupt)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    @contextmanager
    def kept(self) -> Iterator[None]:
        """Let `check_time` of this thread ask this deadline."""
        token = _current.set(self)
        try:
            yield
        finally:
            _current.reset(token)


_current: ContextVar[Deadline | None] = ContextVar('deadline', default=None)


def current() -> Deadline | None:
    """The deadline that this thread keeps, if any."""
    return _current.get()


def check_time() -> None:
    """Raise OutOfTime where the deadline that this thread keeps has passed."""
    deadline = _current.get()
    if deadline is not None and deadline.over:
        raise OutOfTime(deadline.why)
