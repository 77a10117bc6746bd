"""How host and drive see that the other one is there, by CiA 301. No ROS.

Heartbeat: the host says in every cycle that it is there, and the drive faults when that stops.
Guarding, for drives without it: the host asks by remote requests, the drive answers, and faults
when it is no longer asked. Either way the drive has waited no longer than PATIENCE_MS. The host
sees a silent drive sooner, by the answers to its SYNCs.
"""

import contextlib
import time
from abc import ABC, abstractmethod
from collections.abc import Callable

import can
import canopen

from cg_hardware.drive.objects import AbsentError, Objects

HOST = 0x7F  # node number of the host's heartbeat
ERROR_CONTROL = 0x700
OPERATIONAL = 0x05
PATIENCE_MS = 16  # for which the drive waits for the host: 20 less two cycles
ASKED_MS, LIVES = 4, 4  # guard time, and how often it may pass unasked
TOGGLE = 1 << 7


class Watch(ABC):
    """One of the two.

    Args:
        network: Of the drive.
        node: Number of the drive.
    """

    def __init__(self, network: canopen.Network, node: int):
        self.network, self.node = network, node

    @abstractmethod
    def set_up(self, objects: Objects) -> None:
        """Have the drive watch the host this way."""

    @abstractmethod
    def cycle(self) -> None:
        """Send what is due."""

    @property
    def problem(self) -> str:
        """Why the drive counts as silent; empty while it does not."""
        return ''


class Heartbeat(Watch):
    """Object 0x1016."""

    def set_up(self, objects: Objects) -> None:
        """See `Watch`."""
        objects.write(0x1016, 1, HOST << 16 | PATIENCE_MS, 4)

    def cycle(self) -> None:
        """See `Watch`."""
        self.network.send_message(ERROR_CONTROL + HOST, bytes([OPERATIONAL]))


class Guarding(Watch):
    """Objects 0x100C and 0x100D.

    Args:
        network: Of the drive.
        node: Number of the drive.
        clock: In s.
    """

    def __init__(
        self, network: canopen.Network, node: int, clock: Callable[[], float] = time.monotonic
    ):
        super().__init__(network, node)
        self._clock = clock
        self._toggle: int | None = None
        self._asked = 0.0
        self._answered: float | None = None  # since when a drive that was asked is silent

    def set_up(self, objects: Objects) -> None:
        """See `Watch`. A drive that beats is not guarded, so its heart stops first."""
        for index, sub, size in ((0x1016, 1, 4), (0x1017, 0, 2)):
            with contextlib.suppress(AbsentError):
                objects.write(index, sub, 0, size)
        objects.write(0x100C, 0, ASKED_MS, 2)
        objects.write(0x100D, 0, LIVES, 1)
        self.network.subscribe(ERROR_CONTROL + self.node, self._on_answer)

    def cycle(self) -> None:
        """See `Watch`."""
        now = self._clock()
        if now - self._asked >= ASKED_MS / 1000 - 1e-3:  # cycles are not quite even
            self._asked = now
            self._answered = self._answered or now
            bus = self.network.bus
            assert bus is not None  # connected
            with self.network.send_lock:
                # Of the length of the answer, as a request must be; canopen's own has none.
                bus.send(can.Message(
                    arbitration_id=ERROR_CONTROL + self.node, is_extended_id=False,
                    is_remote_frame=True, dlc=1,
                ))  # fmt: skip

    def _on_answer(self, cob: int, data: bytearray, timestamp: float) -> None:
        # One that does not turn its bit over is an old one (CiA 301): as if it had not come.
        if len(data) == 1 and data[0] & TOGGLE != self._toggle:
            self._toggle, self._answered = data[0] & TOGGLE, self._clock()

    @property
    def problem(self) -> str:
        """See `Watch`."""
        if self._answered is None or self._clock() - self._answered <= PATIENCE_MS / 1000:
            return ''
        return 'the drive does not answer node guarding'


WATCHES = {'heartbeat': Heartbeat, 'guarding': Guarding}
