"""A 3DM-GX3-25 that is not there: what it answers to the bytes it gets.

Written from the maker's description of the protocol, and not from our driver.
"""

import struct
from dataclasses import dataclass

TIMER_HZ = 62500
TEXTS = {0: b'6223-4220', 1: b'6223-00000', 2: b'emulated GX3-25'}


def closed(message: bytes) -> bytes:
    """A message with its sum."""
    return message + struct.pack('>H', sum(message) % 65536)


@dataclass
class Gx3Device:
    """The device.

    Attributes:
        drift: Of its quartz, [1].
        timer: Its timer at time zero.
        frozen: It repeats its last reading, timer and all.
    """

    drift: float = 0.0
    timer: int = 0
    frozen: bool = False

    def __post_init__(self) -> None:
        self._incoming = b''
        self._continuous = 0
        self._decimation = 10
        self._samples = 0
        self._last = b''

    @property
    def period(self) -> float:
        """Time from one sample to the next in s."""
        return self._decimation / 1000

    def _ticks(self, now: float) -> int:
        return (self.timer + int(now * TIMER_HZ * (1 + self.drift))) % 2**32

    def _reply(self, head: bytes, now: float) -> bytes:
        return closed(head + struct.pack('>I', self._ticks(now)))

    def receive(self, data: bytes, now: float) -> bytes:
        """What it replies at time `now`, in s."""
        self._incoming += data
        reply = b''
        while self._incoming:
            command, rest = self._incoming[0], self._incoming
            length = {0xC4: 4, 0xFA: 3, 0xDB: 20, 0xCF: 1, 0xEA: 2}.get(command, 1)
            if len(rest) < length:
                break
            message, self._incoming = rest[:length], rest[length:]
            if command == 0xC4 and message[1:3] == b'\xc1\x29':
                self._continuous = message[3]
                reply += self._reply(bytes([0xC4, message[3]]), now)
            elif command == 0xFA and message[1:] == b'\x75\xb4':
                self._continuous = 0
            elif command == 0xDB and message[1:3] == b'\xa8\xb9':
                if message[3] == 1:
                    (self._decimation,) = struct.unpack('>H', message[4:6])
                reply += self._reply(b'\xdb' + message[4:16], now)
            elif command == 0xEA and message[1] in TEXTS and not self._continuous:
                text = bytes(message) + TEXTS[message[1]].rjust(16)
                reply += text + struct.pack('>H', sum(text) % 65536)
        return reply

    def sample(self, now: float, roll: float, pitch: float, yaw: float, rates) -> bytes:
        """What it sends by itself at a time at which it takes a sample; nothing while it is quiet.

        Args:
            now: Time in s.
            roll: In rad, as pitch and yaw.
            pitch: See roll.
            yaw: See roll.
            rates: About x, y, z in rad/s.
        """
        if self._continuous != 0xCF:
            return b''
        if not (self.frozen and self._last):
            body = struct.pack('>6f', roll, pitch, yaw, *rates)
            self._last = self._reply(b'\xcf' + body, now)
        return self._last
