"""A CANopen drive that is not there: CiA 301 and 402 as far as a host can tell.

Written from the standards, and not from our driver. It has a heartbeat and looks for the host's,
or answers node guarding and looks for its requests; it sends and takes PDOs as they are mapped,
watches for the torque's PDO, and faults, with zero torque, when anything is missing. It drives by
torque (mode 10), homes by itself (mode 6, homing_mode.py), latches its encoder's index (touch
probe), has digital outputs, and knows the voltage of its DC link and, where makers put it
(TEMPERATURE), its temperature.
"""

import struct
from dataclasses import dataclass, field

from cg_hardware.emulators.homing_mode import HomingMode

Frame = tuple[int, bytes]
TEMPERATURE = (0x2E10, 1)  # int16, 0.1 degC
SIZES = {  # bytes of the objects it has; (index, sub), sub 0 where none is told
    (0x1000, 0): 4, (0x1001, 0): 1, (0x100C, 0): 2, (0x100D, 0): 1, (0x1016, 1): 4,
    (0x1017, 0): 2,
    **{(pdo, k): n for pdo in (0x1400, 0x1401, 0x1800, 0x1801)
       for k, n in ((1, 4), (2, 1), (5, 2))},
    **{(pdo, k): 4 for pdo in (0x1600, 0x1601, 0x1A00, 0x1A01) for k in range(1, 9)},
    **{(pdo, 0): 1 for pdo in (0x1600, 0x1601, 0x1A00, 0x1A01)},
    TEMPERATURE: 2,
    (0x6007, 0): 2, (0x603F, 0): 2, (0x6040, 0): 2, (0x6041, 0): 2, (0x6060, 0): 1,
    (0x6061, 0): 1, (0x6064, 0): 4, (0x6071, 0): 2, (0x6072, 0): 2, (0x6076, 0): 4,
    (0x6077, 0): 2, (0x6079, 0): 4, (0x607C, 0): 4, (0x6098, 0): 1, (0x6099, 1): 4,
    (0x6099, 2): 4, (0x609A, 0): 4, (0x60B8, 0): 2, (0x60B9, 0): 2, (0x60BA, 0): 4,
    (0x60FD, 0): 4, (0x60FE, 1): 4, (0x60FE, 2): 4,
}  # fmt: skip
WRITABLE = {
    0x100C, 0x100D, 0x1016, 0x1017, 0x1400, 0x1401, 0x1600, 0x1601, 0x1800, 0x1801, 0x1A00,
    0x1A01, 0x6007, 0x6040, 0x6060, 0x6071, 0x6072, 0x607C, 0x6098, 0x6099, 0x609A, 0x60B8,
    0x60FE,
}  # fmt: skip
BOOT, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127
TORQUE, HOMING = 10, 6  # modes of operation
START_HOMING = 1 << 4  # of the controlword
NO_SUCH_OBJECT, READ_ONLY = 0x0602_0000, 0x0601_0002
# Of the touch probe, 0x60B8: on, triggered by the encoder's index, at its positive edge.
PROBE_ON, PROBE_INDEX, PROBE_RISING = 1 << 0, 1 << 2, 1 << 4
PROBE_STORED = 1 << 1  # of 0x60B9


@dataclass
class Cia402Device:
    """The drive.

    Attributes:
        node: Its number.
        rated: Rated torque in mN m.
        counts: Position of the shaft now, set by whoever owns it.
        inputs: Digital inputs now, set by whoever owns what is wired to them.
        index: Position of the encoder's index in counts of the shaft, once a turn.
        turn: Counts from one index to the next.
        voltage: Of the DC link, mV.
        temperature: In 0.1 degC.
        missing: Objects (index, sub) that this drive does not have.
        acting: Torque that acts, per mille of rated.
        log: (time, acting) at every change.
    """

    node: int = 1
    rated: int = 40_000
    counts: int = 0
    inputs: int = 0
    index: int = 0
    turn: int = 20_000
    voltage: int = 48_000
    temperature: int = 314
    missing: frozenset[tuple[int, int]] = frozenset()
    acting: int = 0
    log: list[tuple[float, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.values = dict.fromkeys(SIZES, 0)
        self.values[0x1000, 0] = 0x0002_0192
        self.values[0x6076, 0] = self.rated
        self.values[0x6072, 0] = 1000
        self._nmt = BOOT
        self.state = 'switch on disabled'
        self._word = 0
        self._pending: dict[int, bytes] = {}
        self._host_seen: float | None = None
        self._guarded: float | None = None
        self._toggle = 0
        self._command_seen: float | None = None
        self._beaten = -1.0
        self._inputs_sent = -1.0, -1
        self._homing: HomingMode | None = None
        self._origin = 0  # position of the shaft that it calls zero
        self._counts, self._moved = self.counts, 0.0
        self.dead = False  # power off: it says and does nothing

    # From outside

    def power_on(self) -> list[Frame]:
        """It says that it is there."""
        self._nmt = PRE_OPERATIONAL
        return [(0x700 + self.node, b'\x00')]

    def fault(self, code: int, now: float) -> list[Frame]:
        """Something is wrong; the emergency object that says so."""
        self.state, self._homing = 'fault', None
        self.values[0x603F, 0], self.values[0x1001, 0] = code, 1
        self._act(0, now)
        return [(0x080 + self.node, struct.pack('<HB5x', code, 1))]

    @property
    def outputs(self) -> int:
        """Digital outputs that are on: those that the mask lets pass."""
        return self.values[0x60FE, 1] & self.values[0x60FE, 2]

    def receive(self, cob: int, data: bytes | None, now: float) -> list[Frame]:
        """What it sends on a frame; data is None for a remote request."""
        if self.dead:
            return []
        if data is None:
            return self._guard(now) if cob == 0x700 + self.node else []
        if cob == 0x000 and len(data) == 2 and data[1] in (0, self.node):
            self._nmt = {1: OPERATIONAL, 2: STOPPED, 128: PRE_OPERATIONAL}.get(data[0], self._nmt)
        elif cob == 0x600 + self.node and len(data) == 8 and self._nmt != STOPPED:
            return [(0x580 + self.node, self._sdo(data))]
        elif self._nmt != OPERATIONAL:
            return []
        elif cob == 0x080:
            return self._sync(now)
        for number in (0, 1):
            about = 0x1400 + number
            if self._is_on(about) and cob == self.values[about, 1] & 0x7FF:
                self._command_seen = now if number == 0 else self._command_seen
                self._pending[number] = data
                if self.values[about, 2] >= 254:  # acts when it comes
                    self._take(number)
        if cob == 0x700 + (self.values[0x1016, 1] >> 16 & 0x7F):
            self._host_seen = now
        return []

    def step(self, now: float) -> list[Frame]:
        """What it sends by itself, and what it does when others are silent."""
        if self.dead:
            return []
        self._turn(now)
        frames: list[Frame] = []
        beat = self.values[0x1017, 0] / 1000
        if beat and now - self._beaten >= beat:
            self._beaten = now
            frames.append((0x700 + self.node, bytes([self._nmt])))
        if self._nmt == OPERATIONAL and self._is_on(0x1801) and self.values[0x1801, 2] >= 254:
            again = now - self._inputs_sent[0] >= self.values[0x1801, 5] / 1000
            if again or self.inputs != self._inputs_sent[1]:
                self._inputs_sent = now, self.inputs
                self.values[0x60FD, 0] = self.inputs
                frames.append(self._pdo(1))
        if self.state != 'fault' and self._nmt == OPERATIONAL:
            patience = (self.values[0x1016, 1] & 0xFFFF) / 1000
            life = self.values[0x100C, 0] * self.values[0x100D, 0] / 1000
            for wait, seen in ((patience, self._host_seen), (life, self._guarded)):
                if wait and seen is not None and now - seen > wait and self.state != 'fault':
                    frames += self.fault(0x8130, now)
            deadline = self.values[0x1400, 5] / 1000
            late = self._command_seen is not None and now - self._command_seen > deadline
            if deadline and late and self.state != 'fault':
                frames += self.fault(0x8250, now)
        return frames

    # Inside

    def _act(self, target: int, now: float) -> None:
        if target != self.acting:
            self.acting = target
            self.log.append((now, target))

    def _guard(self, now: float) -> list[Frame]:
        """Node guarding: its state, and a bit that turns over each time."""
        if self.values[0x1017, 0]:
            return []  # it has a heartbeat, and that is what it is watched by
        self._guarded = now
        answer = bytes([self._toggle << 7 | self._nmt])
        self._toggle ^= 1
        return [(0x700 + self.node, answer)]

    def _turn(self, now: float) -> None:
        """The shaft has turned: its index may have come by, and homing goes on."""
        before, after = ((c - self.index) // self.turn for c in (self._counts, self.counts))
        if before != after:
            direction = 1 if after > before else -1
            self._pass_index(self.index + self.turn * max(before, after), direction)
        self._counts = self.counts
        passed, self._moved = now - self._moved, now
        if self._homing is not None and self.state == 'operation enabled' and passed > 0.0:
            limit = self.values[0x6072, 0]
            torque = self._homing.torque(self.counts, passed)
            self._act(min(max(torque, -limit), limit), now)
            if self._homing.bits == 0x1400:  # attained and at rest
                assert self._homing.home is not None
                offset = _signed(self.values[0x607C, 0], 4)
                self._origin = self._homing.home + offset

    def _pass_index(self, position: int, direction: int) -> None:
        if self._homing is not None:
            self._homing.pass_index(position, direction)
        function, status = self.values[0x60B8, 0], self.values[0x60B9, 0]
        armed = PROBE_ON | PROBE_INDEX | PROBE_RISING
        if function & armed == armed and not status & PROBE_STORED:
            self.values[0x60BA, 0] = (position - self._origin) & 0xFFFF_FFFF
            self.values[0x60B9, 0] |= PROBE_STORED

    def _sdo(self, data: bytes) -> bytes:
        """The answer to an expedited transfer."""
        command, index, sub = data[0], *struct.unpack('<HB', data[1:4])
        size = SIZES.get((index, sub))
        if size is None or (index, sub) in self.missing:
            return bytes([0x80]) + data[1:4] + struct.pack('<I', NO_SUCH_OBJECT)
        self.values[0x6079, 0] = self.voltage
        self.values[TEMPERATURE] = self.temperature & 0xFFFF
        if command >> 5 == 2:
            value = self.values[index, sub].to_bytes(size, 'little')
            return bytes([0x43 | 4 - size << 2]) + data[1:4] + value.ljust(4, b'\0')
        if command >> 5 != 1 or index not in WRITABLE:
            return bytes([0x80]) + data[1:4] + struct.pack('<I', READ_ONLY)
        self.values[index, sub] = int.from_bytes(data[4 : 4 + size], 'little')
        if index == 0x6060:
            self.values[0x6061, 0] = self.values[0x6060, 0]
            self._homing = None
        if index == 0x60B8:  # a probe that is switched on is a new one
            self.values[0x60B9, 0] = self.values[0x60B8, 0] & PROBE_ON
        return bytes([0x60]) + data[1:4] + b'\0\0\0\0'

    def _sync(self, now: float) -> list[Frame]:
        for number in list(self._pending):
            self._take(number)
        self._follow(self.values[0x6040, 0])
        mode, enabled = self.values[0x6061, 0], self.state == 'operation enabled'
        if not enabled:
            self._homing = None
        if mode == HOMING:
            start = enabled and self._word & START_HOMING
            if start and self._homing is None:
                self._homing = HomingMode(
                    self.values[0x6098, 0], self.values[0x6099, 2], self.values[0x609A, 0],
                    self.counts,
                )  # fmt: skip
        if self._homing is None:
            target = _signed(self.values[0x6071, 0], 2)
            limit = self.values[0x6072, 0]
            held = min(max(target, -limit), limit)
            self._act(held if enabled and mode == TORQUE else 0, now)
        self.values[0x6064, 0] = (self.counts - self._origin) & 0xFFFF_FFFF
        self.values[0x6077, 0] = self.acting & 0xFFFF
        self.values[0x60FD, 0] = self.inputs
        status = {
            'switch on disabled': 0x0250, 'ready to switch on': 0x0231, 'switched on': 0x0233,
            'operation enabled': 0x0237, 'fault': 0x0218,
        }[self.state]  # fmt: skip
        if mode == HOMING:
            status |= self._homing.bits if self._homing is not None else 1 << 10  # not started
        self.values[0x6041, 0] = status
        return [
            self._pdo(k) for k in (0, 1)
            if self._is_on(0x1800 + k) and self.values[0x1800 + k, 2] <= 240
        ]  # fmt: skip

    def _is_on(self, about: int) -> bool:
        """Whether a PDO has an identifier, and is not off."""
        cob = self.values[about, 1]
        return cob > 0 and not cob >> 31

    def _pdo(self, number: int) -> Frame:
        data, mapping = b'', 0x1A00 + number
        for k in range(1, self.values[mapping, 0] + 1):
            entry = self.values[mapping, k]
            value = self.values[entry >> 16, entry >> 8 & 0xFF]
            data += value.to_bytes((entry & 0xFF) // 8, 'little')
        return self.values[0x1800 + number, 1] & 0x7FF, data

    def _take(self, number: int) -> None:
        """Objects of the PDO that came last."""
        data, at, mapping = self._pending.pop(number), 0, 0x1600 + number
        for k in range(1, self.values[mapping, 0] + 1):
            entry = self.values[mapping, k]
            size = (entry & 0xFF) // 8
            self.values[entry >> 16, entry >> 8 & 0xFF] = int.from_bytes(
                data[at : at + size], 'little'
            )
            at += size

    def _follow(self, word: int) -> None:
        """The state machine of CiA 402, one step for each SYNC."""
        rising = word & 0x80 and not self._word & 0x80
        self._word = word
        if self.state == 'fault':
            if rising:
                self.state = 'switch on disabled'
                self.values[0x603F, 0] = self.values[0x1001, 0] = 0
            return
        if not word & 0x02 or not word & 0x04:  # voltage off, or quick stop
            self.state = 'switch on disabled'
        elif word & 0x0F == 0x06:
            self.state = 'ready to switch on'
        elif word & 0x0F == 0x07 and self.state != 'switch on disabled':
            self.state = 'switched on'
        elif word & 0x0F == 0x0F and self.state in ('switched on', 'operation enabled'):
            self.state = 'operation enabled'


def _signed(value: int, size: int) -> int:
    """A number of so many bytes in two's complement."""
    return value - (1 << 8 * size) * (value >> 8 * size - 1)
