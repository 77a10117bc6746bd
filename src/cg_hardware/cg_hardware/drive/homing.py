"""Homing by the drive itself (CiA 402, mode of operation 6). The motor has voltage. No ROS.

    mode 6, method, speeds, acceleration
    operation enabled, then bit 4 of the controlword rises
    bits 12 and 10 of the statusword: home is found, the shaft is at rest
    voltage off, mode 10

The home offset of the drive is set to zero, so that its counts are zero at the index: makers do
not agree about the sign of that object, and the host knows the offset anyway.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

from cg_hardware.drive import cia402
from cg_hardware.drive.cia402 import State
from cg_hardware.drive.objects import DriveError, Objects
from cg_hardware.drive.procedure import Procedure, Seen, Steps

# s after the start in which the bits may still be those of a homing before.
OLD = 0.05
MODE_CHANGES_IN = 0.5  # s
RESET_IN = 0.1  # s that a drive takes to leave a fault
FAULTS = (State.FAULT, State.REACTING)
START = cia402.ENABLE | cia402.START_HOMING


@dataclass(frozen=True)
class HomingPlan:
    """How to home.

    Attributes:
        method: Of CiA 402.
        speed: In the drive's unit.
        acceleration: In the drive's unit.
        torque: Largest, per mille of rated; 0 leaves it to the drive.
        travel: Counts that the shaft may go at most; 0 for no limit.
        time_limit: In s.
    """

    method: int
    speed: int
    acceleration: int
    torque: int
    travel: int
    time_limit: float


class Homing(Procedure):
    """One homing.

    Args:
        plan: How.
        objects: Of the drive.
        clock: In s.
    """

    name, moves_zero = 'homing', True

    def __init__(
        self, plan: HomingPlan, objects: Objects, clock: Callable[[], float] = time.monotonic
    ):
        super().__init__(objects, plan.time_limit, clock)
        self.plan = plan
        self._from: int | None = None
        self._fit = False  # no fault, or it was reset: from now on one ends it
        self._max_torque: int | None = None  # of the drive, while another one is in force

    def _find(self) -> Steps[None]:
        seen = yield cia402.DISABLE_VOLTAGE
        if seen.state == State.FAULT:
            seen = yield cia402.FAULT_RESET  # somebody asked for this, and knows
        reset = self.clock()
        while seen.state in FAULTS and self.clock() - reset < RESET_IN:
            seen = yield cia402.DISABLE_VOLTAGE
        self._fit = True
        yield from self.done(self._prepare)
        seen = yield cia402.DISABLE_VOLTAGE
        self._from = seen.counts
        while seen.state != State.ENABLED:
            seen = yield self._next(seen)
        started, self.in_doubt = self.clock(), True
        while self.clock() - started < OLD or not seen.status & cia402.HOMING_REACHED:
            seen = yield self._homes(seen)
        if seen.status & cia402.HOMING_ERROR:
            raise DriveError('the drive reports a homing error')
        while not self._attained(seen):
            seen = yield self._homes(seen)
        self.index = 0

    def _wrong(self, seen: Seen, emergency: str) -> str:
        if seen.state is None:
            return 'the drive is silent'
        if self._fit and seen.state in FAULTS:
            return emergency or seen.state.value
        if seen.state == State.QUICK_STOP:
            return seen.state.value
        return super()._wrong(seen, emergency)

    @staticmethod
    def _attained(seen: Seen) -> bool:
        both = cia402.HOMING_ATTAINED | cia402.HOMING_REACHED
        return seen.status & (both | cia402.HOMING_ERROR) == both

    @staticmethod
    def _next(seen: Seen) -> int:
        """The word that leads on to operation enabled, at rest there."""
        return cia402.word_to_enable(seen.state) if seen.state else cia402.DISABLE_VOLTAGE

    def _homes(self, seen: Seen) -> int:
        """The word while it homes, if all is well."""
        if seen.state != State.ENABLED:
            raise DriveError('the drive has left operation enabled')
        assert self._from is not None
        gone = abs(seen.counts - self._from)
        attained = seen.status & cia402.HOMING_ATTAINED  # then the counts begin anew
        if self.plan.travel and gone > self.plan.travel and not attained:
            raise DriveError(f'no index within {self.plan.travel} counts')
        return START

    def _prepare(self, objects: Objects) -> None:
        plan = self.plan
        objects.write(cia402.HOMING_METHOD, 0, plan.method, 1)
        if plan.method in cia402.TO_INDEX:
            for speed in (1, 2):
                objects.write(cia402.HOMING_SPEEDS, speed, plan.speed, 4)
            objects.write(cia402.HOMING_ACCELERATION, 0, plan.acceleration, 4)
        objects.write(cia402.HOME_OFFSET, 0, 0, 4)
        if plan.torque:
            before = objects.read(cia402.MAX_TORQUE)
            objects.write(cia402.MAX_TORQUE, 0, min(plan.torque, before), 2)
            self._max_torque = before
        change_mode(objects, cia402.HOMING)

    def _restore(self, objects: Objects) -> None:
        change_mode(objects, cia402.CYCLIC_TORQUE)
        if self._max_torque is not None:
            objects.write(cia402.MAX_TORQUE, 0, self._max_torque, 2)
            self._max_torque = None

    @property
    def max_torque(self) -> int | None:
        """What 0x6072 of the drive must be given back; None where it was not changed."""
        return self._max_torque


def change_mode(objects: Objects, mode: int) -> None:
    """Set the mode of operation, and see that the drive is in it.

    Raises:
        DriveError: It does not go over.
    """
    objects.write(cia402.MODE, 0, mode, 1)
    deadline = time.monotonic() + MODE_CHANGES_IN
    while (now := objects.read(cia402.MODE_NOW, signed=True)) != mode:
        if time.monotonic() > deadline:
            raise DriveError(f'the drive stays in mode {now}, wanted is {mode}')
        time.sleep(0.01)
