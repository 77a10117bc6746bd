"""A CANopen drive that is not there: CiA 301 and 402 as far as a host can tell.

Written from the standards, and not from our driver. It has a heartbeat and looks for the host's,
sends and takes PDOs at SYNC as they are mapped, watches for the torque's PDO, and faults, with
zero torque, when anything is missing.
"""

import struct
from dataclasses import dataclass, field

Frame = tuple[int, bytes]
SIZES = {  # bytes of the objects it has; (index, sub), sub 0 where none is told
    (0x1000, 0): 4, (0x1001, 0): 1, (0x1016, 1): 4, (0x1017, 0): 2,
    **{(0x1400, k): n for k, n in ((1, 4), (2, 1), (5, 2))},
    **{(pdo, k): n for pdo in (0x1800, 0x1801) for k, n in ((1, 4), (2, 1), (5, 2))},
    **{(pdo, k): 4 for pdo in (0x1600, 0x1A00, 0x1A01) for k in range(1, 9)},
    (0x1600, 0): 1, (0x1A00, 0): 1, (0x1A01, 0): 1, (0x60FD, 0): 4,
    (0x6007, 0): 2, (0x603F, 0): 2, (0x6040, 0): 2, (0x6041, 0): 2, (0x6060, 0): 1,
    (0x6061, 0): 1, (0x6064, 0): 4, (0x6071, 0): 2, (0x6076, 0): 4, (0x6077, 0): 2,
}  # fmt: skip
WRITABLE = {
    0x1016,
    0x1017,
    0x1400,
    0x1600,
    0x1800,
    0x1801,
    0x1A00,
    0x1A01,
    0x6007,
    0x6040,
    0x6060,
    0x6071,
}
BOOT, STOPPED, OPERATIONAL, PRE_OPERATIONAL = 0, 4, 5, 127


@dataclass
class Cia402Device:
    """The drive.

    Attributes:
        node: Its number.
        rated: Rated torque in mN m.
        counts: Position now, set by whoever owns the shaft.
        inputs: Digital inputs now, set by whoever owns what is wired to them.
        acting: Torque that acts, per mille of rated.
        log: (time, acting) at every change.
    """

    node: int = 1
    rated: int = 40_000
    counts: int = 0
    inputs: int = 0
    acting: int = 0
    log: list[tuple[float, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.values = dict.fromkeys(SIZES, 0)
        self.values[0x1000, 0] = 0x0002_0192
        self.values[0x6076, 0] = self.rated
        self._nmt = BOOT
        self.state = 'switch on disabled'
        self._word = 0
        self._pending: bytes | None = None
        self._host_seen: float | None = None
        self._command_seen: float | None = None
        self._beaten = -1.0
        self._inputs_sent = -1.0, -1
        self.dead = False  # power off: it says and does nothing

    # From outside

    def power_on(self) -> list[Frame]:
        """It says that it is there."""
        self._nmt = PRE_OPERATIONAL
        return [(0x700 + self.node, b'\x00')]

    def fault(self, code: int, now: float) -> list[Frame]:
        """Something is wrong; the emergency object that says so."""
        self.state = 'fault'
        self.values[0x603F, 0], self.values[0x1001, 0] = code, 1
        self._act(0, now)
        return [(0x080 + self.node, struct.pack('<HB5x', code, 1))]

    def receive(self, cob: int, data: bytes, now: float) -> list[Frame]:
        """What it sends on a frame."""
        if self.dead:
            return []
        if cob == 0x000 and len(data) == 2 and data[1] in (0, self.node):
            self._nmt = {1: OPERATIONAL, 2: STOPPED, 128: PRE_OPERATIONAL}.get(data[0], self._nmt)
        elif cob == 0x600 + self.node and len(data) == 8 and self._nmt != STOPPED:
            return [(0x580 + self.node, self._sdo(data))]
        elif self._nmt != OPERATIONAL:
            return []
        elif cob == 0x080:
            return self._sync(now)
        elif cob == self.values[0x1400, 1] & 0x7FF and not self.values[0x1400, 1] >> 31:
            self._command_seen = now
            self._pending = data
        if cob == 0x700 + (self.values[0x1016, 1] >> 16 & 0x7F):
            self._host_seen = now
        return []

    def step(self, now: float) -> list[Frame]:
        """What it sends by itself, and what it does when others are silent."""
        if self.dead:
            return []
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
            if patience and self._host_seen is not None and now - self._host_seen > patience:
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

    def _sdo(self, data: bytes) -> bytes:
        """The answer to an expedited transfer."""
        command, index, sub = data[0], *struct.unpack('<HB', data[1:4])
        size = SIZES.get((index, sub))
        if size is None:
            return bytes([0x80]) + data[1:4] + struct.pack('<I', 0x0602_0000)
        if command >> 5 == 2:
            value = self.values[index, sub].to_bytes(size, 'little')
            return bytes([0x43 | 4 - size << 2]) + data[1:4] + value.ljust(4, b'\0')
        if command >> 5 != 1 or index not in WRITABLE:
            return bytes([0x80]) + data[1:4] + struct.pack('<I', 0x0601_0002)
        self.values[index, sub] = int.from_bytes(data[4 : 4 + size], 'little')
        if index == 0x6060:
            self.values[0x6061, 0] = self.values[0x6060, 0]
        return bytes([0x60]) + data[1:4] + b'\0\0\0\0'

    def _sync(self, now: float) -> list[Frame]:
        if self._pending is not None:
            self._take(self._pending)
            self._pending = None
        self._follow(self.values[0x6040, 0])
        enabled = self.state == 'operation enabled' and self.values[0x6061, 0] == 10
        target = self.values[0x6071, 0]
        self._act((target ^ 0x8000) - 0x8000 if enabled else 0, now)
        self.values[0x6064, 0] = self.counts & 0xFFFF_FFFF
        self.values[0x6077, 0] = self.acting & 0xFFFF
        self.values[0x60FD, 0] = self.inputs
        self.values[0x6041, 0] = {
            'switch on disabled': 0x0250, 'ready to switch on': 0x0231, 'switched on': 0x0233,
            'operation enabled': 0x0237, 'fault': 0x0218,
        }[self.state]  # fmt: skip
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

    def _take(self, data: bytes) -> None:
        """Objects of the PDO that came before this SYNC."""
        at = 0
        for k in range(1, self.values[0x1600, 0] + 1):
            entry = self.values[0x1600, k]
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
