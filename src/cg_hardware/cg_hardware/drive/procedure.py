"""What a drive is led through cycle by cycle other than torque, to find where its zero is. No ROS.

A procedure is asked in every cycle for the controlword, and told what the drive says. It never
waits: what takes transfers of objects has them done later, and goes on in the cycle in which they
are done. However it ends, it leaves the drive as it was before, without voltage at the motor.
"""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator
from concurrent.futures import Future
from typing import NamedTuple, TypeVar

from cg_hardware.drive import cia402
from cg_hardware.drive.cia402 import State
from cg_hardware.drive.objects import DriveError, Objects

T = TypeVar('T')


class Seen(NamedTuple):
    """What the drive said at the last SYNC.

    Attributes:
        state: None while it is silent.
        status: Its statusword.
        counts: Position.
    """

    state: State | None
    status: int
    counts: int


Steps = Generator[int, Seen, T]  # controlwords out, what was seen in


class Procedure(ABC):
    """One of them.

    Args:
        objects: Of the drive.
        time_limit: In s, for all of it but the tidying up.
        clock: In s.

    Attributes:
        index: Counts of the index, once they are found.
        failure: Why they were not; empty if nothing went wrong.
        in_doubt: Whether the drive's counts may have begun anew all the same.
        over: Nothing is left to do.
        tidy: The drive is as it was before; only then it may be torqued.
    """

    name: str
    moves_zero: bool  # whether the drive's counts begin anew on the way

    def __init__(
        self, objects: Objects, time_limit: float, clock: Callable[[], float] = time.monotonic
    ):
        self.objects, self.time_limit, self.clock = objects, time_limit, clock
        self.index: int | None = None
        self.failure, self.in_doubt, self.over, self.tidy = '', False, False, False
        self._ends_at = clock() + time_limit
        self._steps: Steps[None] = self._find()
        self._leaving = False
        self._started = False

    @abstractmethod
    def _find(self) -> Steps[None]:
        """Find the index; a DriveError says why not."""

    @abstractmethod
    def _restore(self, objects: Objects) -> None:
        """Give the drive back what was changed; the motor has no voltage by then."""

    def cancel(self, reason: str) -> None:
        """End it before its time."""
        if not self._leaving:
            self._leave(reason)

    def word(self, seen: Seen, emergency: str) -> int:
        """The controlword of this cycle.

        Args:
            seen: What the drive said at the last SYNC.
            emergency: What it said of an error; empty for none.
        """
        if self.over:
            return cia402.DISABLE_VOLTAGE
        if not self._leaving and (wrong := self._wrong(seen, emergency)):
            self._leave(wrong)
        try:
            return self._advance(seen)
        except StopIteration:
            if self._leaving:
                self.over = True
                return cia402.DISABLE_VOLTAGE
            self._leave('')
        except DriveError as error:
            if self._leaving:
                self.failure, self.over = self.failure or str(error), True
                return cia402.DISABLE_VOLTAGE
            self._leave(str(error))
        return self._advance(seen)

    def _advance(self, seen: Seen) -> int:
        if not self._started:
            self._started = True
            return next(self._steps)
        return self._steps.send(seen)

    def _leave(self, failure: str) -> None:
        self.failure, self._leaving, self._started = failure, True, False
        self._steps = self._go()

    def _go(self) -> Steps[None]:
        """Voltage off, then as before."""
        seen = yield cia402.DISABLE_VOLTAGE
        while seen.state == State.ENABLED:
            seen = yield cia402.DISABLE_VOLTAGE
        yield from self.done(self._restore)
        self.tidy = True

    def _wrong(self, seen: Seen, emergency: str) -> str:
        """Why it must end now; empty if it may go on."""
        if self.clock() > self._ends_at:
            return f'not done within {self.time_limit:g} s'
        return ''

    def done(self, work: Callable[[Objects], T]) -> Steps[T]:
        """Transfers of objects, and what came of them; no voltage meanwhile."""
        future: Future[T] = self.objects.later(work)
        while not future.done():
            yield cia402.DISABLE_VOLTAGE
        return future.result()
