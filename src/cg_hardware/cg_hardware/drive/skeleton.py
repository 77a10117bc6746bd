"""A driver to begin with: copy this file into a package of yours, and change what is marked.

It drives a motor in memory, so that it runs as it stands:

    ros2 run cg_hardware drive_node --ros-args -p driver:=skeleton

What holds for every drive:

- Torque is in N m at the joint, positive where it turns the inner legs forward of the outer. The
  drive's own unit (amperes, per mille) and sign are this file's business: `settings.sign`,
  `settings.gear`.
- Position is a whole number of counts, and it goes out as the drive counts it. The node knows how
  many counts a turn has, and subtracts the zero.
- An answer has the host's time at which position and torque were true, in ns since 1970. The
  instant at which the drive was asked is better than that at which its answer came.
- When in doubt there is no torque. A drive that is silent, or has a fault, is given up by this
  file: `disable` with a reason. Only `enable`, which a person has called, brings it back.
- The drive itself must take its torque off when the host is silent: by a watchdog of its own, of
  20 ms or less. This file cannot do that for a host that hangs. A drive without one is not fit.
- Nothing here may wait for longer than a part of a cycle, 2 ms. What blocks belongs into a thread.
"""

import math
import time
from collections import deque
from typing import Any

from cg_hardware.drive.can_drive import SILENCE_S, Answer
from cg_hardware.drive.cia402 import State
from cg_hardware.drive.objects import DriveError

NM_PER_AMPERE = 0.05  # CHANGE: of the motor, at its shaft
MOST_AMPERES = 10.0  # CHANGE: what drive and motor bear


class SkeletonDrive:
    """One drive.

    Args:
        settings: Of the drive node: interface, channel, bitrate, node_id, sign, gear,
            counts_per_turn, and what else it has.

    Attributes:
        answers: What the drive said in each cycle, oldest first; the node takes them.
        wanted: Whether a person wants torque.
        reason: Why there is none, in words; empty while nothing is wrong.

    Raises:
        DriveError: The drive is not there; naming where it was looked for, and what was missing.
            The node looks again after a second.
    """

    def __init__(self, settings: Any):
        self.answers: deque[Answer] = deque(maxlen=1000)
        self.wanted, self.reason = False, ''
        # What a CANopen drive has besides: outputs, an object dictionary, a way to its index.
        self.outputs, self.objects, self.procedure = 0, None, None
        self._sign, self._gear = settings.sign, settings.gear
        self._state, self._answered = State.DISABLED, 0.0
        # CHANGE: open the wire, see that it is the right device, set its watchdog.
        self._wire = MotorInMemory(settings.counts_per_turn)
        if not self._wire.there:
            raise DriveError(f'no drive on {settings.interface}:{settings.channel}')

    @property
    def state(self) -> State | None:
        """Of the drive, in the nearest word of CiA 402; None while it is silent."""
        fresh = time.monotonic() - self._answered < SILENCE_S
        return self._state if fresh else None

    @property
    def enabled(self) -> bool:
        """Whether torque acts: it is wanted, and the drive has said itself that it is on."""
        return self.wanted and self.state == State.ENABLED

    def enable(self) -> None:
        """A person wants torque: out of a fault as well."""
        self.wanted, self.reason = True, ''
        self._since = time.monotonic()
        self._wire.reset_fault()  # CHANGE

    def disable(self, reason: str) -> None:
        """No torque until `enable`; the first reason is the one that people want to read."""
        if self.wanted or not self.reason:
            self.reason = reason
        self.wanted = False

    def cycle(self, torque: float) -> None:
        """One cycle: send the torque, ask for an answer, do not wait for it.

        Args:
            torque: At the joint in N m.

        Raises:
            DriveError: The wire is gone. The node then closes this drive and looks for it anew.
        """
        state = self.state
        if self.wanted and state == State.FAULT:
            self.disable('the drive has a fault')  # CHANGE: say which
        if self.wanted and state is None and time.monotonic() - self._since > SILENCE_S:
            self.disable('the drive is silent')
        amperes = 0.0
        if self.enabled and math.isfinite(torque):
            amperes = self._sign * torque / (self._gear * NM_PER_AMPERE)
            amperes = min(max(amperes, -MOST_AMPERES), MOST_AMPERES)
        try:
            asked_ns = time.time_ns()
            answer = self._wire.exchange(self.wanted, amperes)  # CHANGE: send, read what came
        except OSError as error:
            self.disable(f'the wire is gone: {error}')
            raise DriveError(str(error)) from error
        if answer is None:
            return
        on, faulty, counts, held = answer
        self._answered = time.monotonic()
        self._state = State.FAULT if faulty else State.ENABLED if on else State.DISABLED
        self.answers.append(Answer(
            sync_ns=asked_ns, state=self._state, counts=counts,
            torque=self._sign * held * self._gear * NM_PER_AMPERE,
            inputs=0,  # CHANGE: bits of the foot switches, where they are wired to the drive
        ))  # fmt: skip

    def await_answer(self, timeout_s: float) -> None:
        """Wait until the answer is there, or so long. This one has it already."""

    def close(self) -> None:
        """Leave the drive without torque, and the wire; once more does nothing."""
        self.wanted = False
        try:
            self._wire.exchange(False, 0.0)
        except OSError:
            pass  # a wire that is gone: the drive's own watchdog sees to it


class MotorInMemory:
    """A motor that is not there: an inertia on its shaft. CHANGE: your wire is in its place.

    Attributes:
        there: Whether it answers at all.
        faulty: Whether it has a fault.
        amperes: Current that flows.
    """

    INERTIA = 2e-4  # kg m^2 at the shaft
    DAMPING = 2e-3  # N m s/rad

    def __init__(self, counts_per_turn: float):
        self.there, self.faulty = True, False
        self.amperes = 0.0
        self._counts = counts_per_turn / (2 * math.pi)
        self._angle = self._rate = 0.0
        self._on, self._at = False, time.monotonic()

    def reset_fault(self) -> None:
        """Forget a fault."""
        self.faulty = False

    def exchange(self, on: bool, amperes: float) -> tuple[bool, bool, int, float] | None:
        """Switch it on or off, and set its current.

        Returns:
            Whether it is on, whether it has a fault, its position in counts, its current in A.
        """
        if not self.there:
            raise OSError('nobody answers')
        now = time.monotonic()
        passed, self._at = min(now - self._at, 0.1), now
        torque = self.amperes * NM_PER_AMPERE - self.DAMPING * self._rate
        self._rate += passed * torque / self.INERTIA
        self._angle += passed * self._rate
        self._on = on and not self.faulty
        self.amperes = amperes if self._on else 0.0
        return self._on, self.faulty, round(self._angle * self._counts), self.amperes
