"""A drive on a CAN bus: set up by SDO, led by PDO, watched by heartbeat or guarding. No ROS.

Every cycle the host sends the controlword and the torque, then SYNC; the drive lets the torque act
at that SYNC, and answers with statusword, position and torque of the same instant. Three watches
look at each other: the drive at the host (watch.py) and at the torque's PDO, the host at the
drive's answers. Whichever is silent, the torque is zero: in the drive, because it faults; here,
because the drive then is not enabled, and is enabled again only by `enable`.

    RPDO 1  0x200 + node   controlword (uint16), target torque (int16, per mille of rated)
    RPDO 2  0x300 + node   digital outputs (uint32), when they change, and every 25 cycles
    TPDO 1  0x180 + node   statusword (uint16), position (int32, counts), torque (int16)
    TPDO 2  0x280 + node   digital inputs (uint32), when they change, and every 50 ms

A drive without outputs that are wanted gets no RPDO 2. Instead of torque it may be led through a
procedure (procedure.py) that finds where its zero is.
"""

import contextlib
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import can
import canopen

from cg_hardware.drive import cia402
from cg_hardware.drive.cia402 import State
from cg_hardware.drive.feet import REPEATED
from cg_hardware.drive.objects import DriveError, Objects
from cg_hardware.drive.procedure import Procedure, Seen
from cg_hardware.drive.watch import PATIENCE_MS, WATCHES

SYNC = 0x080
COMMAND = struct.Struct('<Hh')
ANSWER = struct.Struct('<Hih')
OFF = 1 << 31  # bit of a COB-ID: the object is off
AT_SYNC, AT_CHANGE = 1, 255  # when a PDO is sent, or acts
INPUTS_MS = 50  # in which the inputs come again, changed or not
PRESENT = 402  # low half of the device type
LATEST_NS = 2_800_000  # ns that an answer takes at most; an older SYNC's is lost
SILENCE_S = 0.015  # s without an answer after which the drive counts as lost
FAULTS = (State.REACTING, State.FAULT)


@dataclass(frozen=True)
class Answer:
    """What the drive said at one SYNC.

    Attributes:
        sync_ns: When the SYNC went out, host's clock.
        state: Of the drive.
        counts: Position.
        torque: In N m at the joint, as the drive reports it.
        inputs: Digital inputs, as they last came.
        status: The whole statusword.
    """

    sync_ns: int
    state: State
    counts: int
    torque: float
    inputs: int
    status: int = 0


@dataclass(frozen=True)
class Scale:
    """Torque at the joint, and what the drive calls it.

    Attributes:
        rated: Torque in N m at the joint that is 1000 per mille.
        sign: 1.0, or -1.0 where the drive's positive torque turns the joint backward.
    """

    rated: float
    sign: float = 1.0

    @property
    def per_mille(self) -> float:
        """What the drive calls a torque of 1 N m, but for the sign."""
        return cia402.PER_MILLE / self.rated

    def target(self, torque: float) -> int:
        """Per mille of rated torque for a torque in N m, as far as 16 bits go."""
        found = round(cia402.PER_MILLE * self.sign * torque / self.rated)
        return max(-cia402.LARGEST_TARGET, min(cia402.LARGEST_TARGET, found))

    def torque(self, target: int) -> float:
        """Torque in N m for per mille of rated torque."""
        return self.sign * target * self.rated / cia402.PER_MILLE


class CanDrive:
    """One drive.

    Args:
        bus: What python-can needs to open the bus: interface, channel, bitrate.
        node: Number of the drive on it.
        sign: Of its torque, `Scale`.
        gear: Torque at the joint per torque of the motor, where the rated one is the motor's.
        watch: How the drive sees that the host is there, one of WATCHES.
        output_mask: Digital outputs that the host sets.
        wall_ns: Clock of the answers.

    Attributes:
        objects: Its object dictionary.
        scale: Of its torque.
        answers: What the drive said since they were last taken, oldest first.
        wanted: Whether it is led to operation enabled, for torque.
        procedure: What it is led through instead.
        outputs: Digital outputs that are wanted now.
        reason: Why it is not enabled, in words; empty while nothing is wrong.

    Raises:
        DriveError: naming bus, drive and what was missing.
    """

    def __init__(
        self,
        bus: dict,
        node: int,
        sign: float = 1.0,
        gear: float = 1.0,
        watch: str = 'heartbeat',
        output_mask: int = 0,
        wall_ns: Callable[[], int] = time.time_ns,
    ):
        self.node, self._wall_ns = node, wall_ns
        self.procedure: Procedure | None = None
        self.outputs, self._mask = 0, output_mask
        self._outputs_sent, self._cycles = 0, 0
        self.answers: deque[Answer] = deque(maxlen=1000)
        self.wanted, self.reason = False, ''
        self._lock = threading.Lock()
        self._heard = threading.Event()
        self._asked: deque[int] = deque(maxlen=8)  # SYNCs that are not answered yet, ns
        self._answered = 0.0
        self._last: Answer | None = None
        self._emergency = ''
        self._inputs = 0
        self._reset = False
        self._open(bus)
        self.objects = Objects(self._remote)
        self._watches = WATCHES[watch](self._network, node)
        try:
            rated = self._set_up() * gear
        except (DriveError, can.CanError, OSError) as error:
            self.close()
            raise DriveError(f'drive {node} on {told(bus)}: {error}') from error
        self.scale = Scale(rated, sign)

    def _open(self, bus: dict) -> None:
        self._network = _Network()
        # Any listener of python-can will do, whatever canopen's annotation says.
        self._network.listeners.append(_ReadErrors(self._network))  # type: ignore[arg-type]
        try:
            self._network.connect(**bus)
        except (can.CanError, OSError, ValueError) as error:
            raise DriveError(f'{told(bus)}: {error}') from error
        self._remote = canopen.RemoteNode(self.node, canopen.ObjectDictionary())
        self._network.add_node(self._remote)
        self._network.subscribe(0x180 + self.node, self._on_answer)
        self._network.subscribe(0x280 + self.node, self._on_inputs)
        self._remote.emcy.add_callback(self._on_emergency)

    def _set_up(self) -> float:
        """Tell the drive what to send, what to expect, and how to drive; its rated torque, N m."""
        write = self.objects.write
        kind = self.objects.read(0x1000)
        if kind & 0xFFFF != PRESENT:
            raise DriveError(f'is no CiA 402 drive: its device type is 0x{kind:08x}')
        self._remote.nmt.send_command(0x80)  # pre-operational: mappings may change
        self._watches.set_up(self.objects)
        write(cia402.ABORT_CONNECTION, 0, 1, 2)
        self._map(0x1400, 0x1600, 0x200 + self.node,
                  (cia402.CONTROLWORD << 16 | 16, cia402.TARGET_TORQUE << 16 | 16))  # fmt: skip
        write(0x1400, 5, PATIENCE_MS, 2)
        if self._mask:
            write(cia402.OUTPUTS, 1, 0, 4)
            write(cia402.OUTPUTS, 2, self._mask, 4)
            output = cia402.OUTPUTS << 16 | 1 << 8 | 32
            self._map(0x1401, 0x1601, 0x300 + self.node, (output,), AT_CHANGE)
        self._map(0x1800, 0x1A00, 0x180 + self.node,
                  (cia402.STATUSWORD << 16 | 16, cia402.POSITION << 16 | 32,
                   cia402.ACTUAL_TORQUE << 16 | 16))  # fmt: skip
        self._map(0x1801, 0x1A01, 0x280 + self.node, (cia402.INPUTS << 16 | 32,), AT_CHANGE)
        write(0x1801, 5, INPUTS_MS, 2)
        write(cia402.MODE, 0, cia402.CYCLIC_TORQUE, 1)
        rated = self.objects.read(cia402.RATED_TORQUE)
        if rated == 0:
            raise DriveError('its rated torque (0x6076) is zero')
        self._remote.nmt.send_command(0x01)
        return rated / 1000

    def _map(
        self, about: int, mapping: int, cob: int, objects: tuple[int, ...], when: int = AT_SYNC
    ) -> None:
        """Have a PDO hold these objects."""
        write = self.objects.write
        write(about, 1, cob | OFF, 4)
        write(about, 2, when, 1)
        write(mapping, 0, 0, 1)
        for k, entry in enumerate(objects, 1):
            write(mapping, k, entry, 4)
        write(mapping, 0, len(objects), 1)
        write(about, 1, cob, 4)

    # What comes in, in the thread of the bus

    def _on_answer(self, cob: int, data: bytearray, timestamp: float) -> None:
        if len(data) != ANSWER.size:
            return
        word, counts, torque = ANSWER.unpack(data)
        try:
            state = cia402.state_of(word)
        except ValueError:
            return
        with self._lock:
            sync_ns = self._answered_sync()
            if sync_ns is None:
                return
            held = self.scale.torque(torque)
            answer = Answer(sync_ns, state, counts, held, self._inputs, word)
            self.answers.append(answer)
            self._last, self._answered = answer, time.monotonic()
        self._heard.set()

    def _answered_sync(self) -> int | None:
        """Which SYNC an answer belongs to: the oldest one that can still be answered."""
        now = self._wall_ns()
        while self._asked:
            sync_ns = self._asked.popleft()
            if now - sync_ns < LATEST_NS:
                return sync_ns
        return None

    def _on_inputs(self, cob: int, data: bytearray, timestamp: float) -> None:
        if len(data) == 4:
            with self._lock:
                self._inputs = int.from_bytes(data, 'little')

    def _on_emergency(self, error: canopen.emcy.EmcyError) -> None:
        with self._lock:
            self._emergency = cia402.error_text(error.code) if error.code else ''

    # What goes out

    @property
    def state(self) -> State | None:
        """Of the drive; None while it is silent."""
        with self._lock:
            fresh = time.monotonic() - self._answered < SILENCE_S
            return self._last.state if fresh and self._last else None

    @property
    def enabled(self) -> bool:
        """Whether torque acts."""
        return self.wanted and self.state == State.ENABLED

    def enable(self) -> None:
        """Lead the drive to operation enabled, out of a fault as well; for a person to ask."""
        with self._lock:
            self._emergency = ''
        self.wanted, self.reason, self._reset = True, '', True
        self._enabling_since = time.monotonic()

    def lead_through(self, procedure: Procedure) -> None:
        """Go through a procedure; until it is over there is no torque by `cycle`."""
        self.wanted, self.procedure = False, procedure

    def disable(self, reason: str) -> None:
        """Take the torque off, until `enable`, and end a procedure."""
        if self.procedure is not None:
            self.procedure.cancel(reason)
        if self.wanted or not self.reason:
            self.reason = reason
        self.wanted = False

    def cycle(self, torque: float) -> None:
        """One cycle: command, SYNC, a sign of life, outputs.

        Args:
            torque: At the joint in N m; only while `enabled` it goes out.

        Raises:
            DriveError: The bus is gone.
        """
        state = self.state
        self._look(state)
        target = self.scale.target(torque) if self.wanted and state == State.ENABLED else 0
        self._heard.clear()
        try:
            self._network.send_message(0x200 + self.node, COMMAND.pack(self._word(state), target))
            with self._lock:
                self._asked.append(self._wall_ns())
            self._network.send_message(SYNC, b'')
            self._watches.cycle()
            self._send_outputs()
        except (can.CanError, OSError) as error:
            self.disable(f'the bus is gone: {error}')
            raise DriveError(f'drive {self.node}: {error}') from error

    def _send_outputs(self) -> None:
        self._cycles += 1
        changed = self.outputs != self._outputs_sent
        if self._mask and (changed or self._cycles % REPEATED == 0):
            word = (self.outputs & self._mask).to_bytes(4, 'little')
            self._network.send_message(0x300 + self.node, word)
            self._outputs_sent = self.outputs

    def await_answer(self, timeout_s: float) -> None:
        """Wait until the drive has answered the last SYNC, or so long."""
        self._heard.wait(timeout_s)

    def _word(self, state: State | None) -> int:
        if self.procedure is not None:
            return self.procedure.word(self._seen(state), self._emergency)
        if not self.wanted or state is None:
            return cia402.DISABLE_VOLTAGE
        if state == State.ENABLED:
            self._reset = False  # a fault from now on waits for a person
        if state == State.FAULT and self._reset:
            self._reset = False  # one rising edge
            return cia402.FAULT_RESET
        return cia402.word_to_enable(state)

    def _seen(self, state: State | None) -> Seen:
        with self._lock:
            last = self._last
        return Seen(state, last.status, last.counts) if last else Seen(state, 0, 0)

    def _look(self, state: State | None) -> None:
        """Give up what is no longer as it should be."""
        if not self.wanted:
            return
        if problem := self._watches.problem:
            self.disable(problem)
        elif state is None and time.monotonic() - self._enabling_since > SILENCE_S:
            self.disable('the drive is silent')
        elif state in FAULTS and not self._reset and self._past_start:
            with self._lock:
                self.disable(self._emergency or state.value)
        elif state == State.QUICK_STOP:
            self.disable(state.value)

    @property
    def _past_start(self) -> bool:
        # A reset takes the drive some cycles.
        return time.monotonic() - self._enabling_since > 0.1

    def close(self) -> None:
        """Leave the drive without torque, and the bus; once more does nothing."""
        # Where the bus is gone the drive's own watch sees to it.
        gone = contextlib.suppress(can.CanError, OSError, RuntimeError)
        self.objects.close()
        last = [(0x200 + self.node, COMMAND.pack(0, 0)), (SYNC, b'')]
        last += [(0x300 + self.node, bytes(4))] * bool(self._mask)
        for cob, data in last:
            with gone:  # each: a bus that cannot be read may still carry them
                self._network.send_message(cob, data)
        with gone:
            self._network.disconnect()


class _Network(canopen.Network):
    """A network that outlives garbage on the line of a serial adapter: no error of the bus."""

    def check(self) -> None:
        """Raise what ended reception; what python-can could not decode did not."""
        if self.notifier is not None and not _is_garbage(self.notifier.exception):
            super().check()


class _ReadErrors(can.Listener):
    """Errors of reading the bus: the next cycle meets them as well, and says so.

    python-can would keep what it cannot decode, and stumble over it at every frame from then on.
    """

    def __init__(self, network: canopen.Network):
        self._network = network

    def on_message_received(self, msg: can.Message) -> None:
        """Messages are for others."""

    def on_error(self, exc: Exception) -> None:
        """The thread that reads goes on, with a clean buffer where it has one."""
        flush = getattr(self._network.bus, 'flush', None)
        if _is_garbage(exc) and flush is not None:
            with contextlib.suppress(can.CanError, OSError):
                flush()


def _is_garbage(error: Exception | None) -> bool:
    """Whether it is about what is on the line: bytes that are no text, digits, or too few."""
    cause = error and (error.__cause__ or error)  # python-can wraps some of them
    return isinstance(cause, ValueError | IndexError)


def told(bus: dict) -> str:
    """A bus in words."""
    return f'{bus.get("interface")}:{bus.get("channel")}'
