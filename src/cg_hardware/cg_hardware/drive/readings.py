"""What is read from a drive now and then: temperature, voltage; and what it may be. No ROS.

Each is one object, read in the thread of the objects, so that the cycle of the torque does not
wait. A drive that has no such object is asked once.
"""

import math
import time
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from enum import IntEnum

from cg_hardware.drive.objects import AbsentError, DriveError, Objects


class Level(IntEnum):
    """Of a reading, numbered as in diagnostic_msgs/DiagnosticStatus."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(frozen=True)
class Quantity:
    """What is read.

    Attributes:
        name: For people.
        unit: Of its value.
        index: Of the object.
        sub: Of the object.
        scale: Value per count of the object.
        signed: Whether the object may be negative.
    """

    name: str
    unit: str
    index: int
    sub: int
    scale: float
    signed: bool


@dataclass(frozen=True)
class Limits:
    """What it may be; 0 where there is no limit.

    Attributes:
        high_error: At which the torque goes.
        high_warn: At which people are told.
        low_warn: The same from above.
        low_error: The same from above.
    """

    high_error: float = 0.0
    high_warn: float = 0.0
    low_warn: float = 0.0
    low_error: float = 0.0

    def judge(self, value: float, quantity: Quantity) -> tuple[Level, str]:
        """Level of a value, and why in words."""
        told = f'{quantity.name} is {value:.4g} {quantity.unit}'
        for level, high, low in (
            (Level.ERROR, self.high_error, self.low_error),
            (Level.WARN, self.high_warn, self.low_warn),
        ):
            if high and value >= high:
                return level, f'{told}; the limit is {high:g} {quantity.unit}'
            if low and value <= low:
                return level, f'{told}; the least is {low:g} {quantity.unit}'
        return Level.OK, told

    @property
    def any(self) -> bool:
        """Whether there is one."""
        return any((self.high_error, self.high_warn, self.low_warn, self.low_error))


class Reading:
    """One quantity of one drive.

    Args:
        quantity: What.
        objects: Of the drive.
        period: Of the readings, s.
        clock: In s.

    Attributes:
        value: The last one, NaN before the first and while it cannot be read.
        absent: The drive has no such object.
        problem: Why it cannot be read; empty if it can.
    """

    def __init__(
        self,
        quantity: Quantity,
        objects: Objects,
        period: float,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.quantity, self._objects = quantity, objects
        self._period, self._clock = period, clock
        self.value, self.absent, self.problem = math.nan, False, ''
        self._due = clock()
        self._asked: Future[int] | None = None

    def poll(self) -> bool:
        """Ask when it is due; whether there is a new value now."""
        if self._asked is None:
            if not self.absent and self._clock() >= self._due:
                self._due = self._clock() + self._period
                q = self.quantity
                self._asked = self._objects.later(lambda o: o.read(q.index, q.sub, q.signed))
            return False
        if not self._asked.done():
            return False
        asked, self._asked = self._asked, None
        try:
            self.value, self.problem = asked.result() * self.quantity.scale, ''
        except DriveError as error:
            self.value, self.problem = math.nan, str(error)
            self.absent = isinstance(error, AbsentError)
            return False
        return True

    def judge(self, limits: Limits) -> tuple[Level, str]:
        """Level, and why in words. What is limited and cannot be read is a warning."""
        if math.isfinite(self.value):
            return limits.judge(self.value, self.quantity)
        told = f'{self.quantity.name} is not known: {self.problem or "not read yet"}'
        return (Level.WARN if limits.any and self.problem else Level.OK), told
