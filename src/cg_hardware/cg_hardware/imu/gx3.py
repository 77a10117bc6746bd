"""The single-byte protocol of MicroStrain's 3DM-GX3-25, as far as this robot uses it. No I/O.

From the maker's "3DM-GX3-25 Single Byte Data Communications Protocol". A command is one byte, or
one byte and two that confirm it; numbers are big-endian. A reply begins with the byte of its
command and ends with the sum of all bytes before, modulo 2^16:

    0xCF  Euler angles and rates    CF | roll pitch yaw (float32, rad) | x y z (float32, rad/s)
                                    | timer (uint32) | sum (uint16)                    31 bytes
    0xC4  continuous mode           C4 C1 29 command -> C4 | command | timer | sum      8 bytes
    0xDB  sampling settings         DB A8 B9 1 | decimation of 1 kHz | flags | windows and
                                    compensations | 5 zeros  (20 bytes) ->             19 bytes
    0xEA  a text about itself       EA n -> EA | n | 16 characters | sum                20 bytes
    0xFA  end of continuous mode    FA 75 B4, no reply

The timer counts 1/62500 s and begins anew after 2^32 of them, 19 hours.
"""

import math
import struct
from dataclasses import dataclass

EULER_AND_RATES, CONTINUOUS, SAMPLING, STOP = 0xCF, 0xC4, 0xDB, 0xFA
IDENTITY = 0xEA
TEXTS = {1: 'serial', 2: 'model'}  # that are asked for
LENGTHS = {EULER_AND_RATES: 31, CONTINUOUS: 8, SAMPLING: 19, IDENTITY: 20}  # of replies, in bytes
TICKS_PER_S = 62_500
TICKS = 1 << 32  # after which the timer begins anew
BASE_RATE = 1000.0  # Hz, which the decimation divides

BODY = struct.Struct('>6fI')  # of 0xCF, between the command and the sum
ORIENT, SWAP, NORTH_AND_UP = 0x0001, 0x0000, 0x0000  # flags of the sampling settings
FASTEST = 35.0  # rad/s: twice what the gyroscopes of any of the family can read
TURN = 2 * math.pi * (1 + 1e-6)  # rad: no Euler angle is beyond


@dataclass(frozen=True)
class Reading:
    """What the device measured at one instant.

    Attributes:
        ticks: Of its timer, 1/62500 s, modulo 2^32.
        euler: Roll, pitch, yaw in rad, axes as printed on the device.
        rates: About x, y, z in rad/s.
        received_ns: When the last of its bytes was read, on the host's clock.
    """

    ticks: int
    euler: tuple[float, float, float]
    rates: tuple[float, float, float]
    received_ns: int


def sampling_command(rate_hz: float) -> bytes:
    """Sample at this rate.

    Raises:
        ValueError: The device cannot: it divides 1 kHz by a whole number.
    """
    decimation = round(BASE_RATE / rate_hz) if rate_hz > 0 else 0
    if not 1 <= decimation <= 1000 or abs(BASE_RATE / decimation - rate_hz) > 1e-6 * rate_hz:
        raise ValueError(
            f'rate_hz is {rate_hz:g}; the device samples at 1000 Hz divided by a whole number '
            'from 1 to 1000'
        )
    # Filter windows of 15 and 17 samples and compensations of 10 s are the maker's defaults.
    settings = struct.pack('>BHHBBHHB5x', 1, decimation, ORIENT, 15, 17, 10, 10, 1)
    return bytes([SAMPLING, 0xA8, 0xB9]) + settings


def continuous_command(command: int = EULER_AND_RATES) -> bytes:
    """Send the replies to this command without being asked."""
    return bytes([CONTINUOUS, 0xC1, 0x29, command])


STOP_COMMAND = bytes([STOP, 0x75, 0xB4])
IDENTITY_COMMANDS = b''.join(bytes([IDENTITY, number]) for number in TEXTS)


def closed(body: bytes) -> bytes:
    """A message with its sum."""
    return body + struct.pack('>H', sum(body) & 0xFFFF)


def text_of(field: bytes) -> str:
    """What can be printed of a text of fixed length."""
    return ''.join(chr(b) for b in field if 0x20 <= b < 0x7F).strip()


class Parser:
    """Finds replies in a stream of bytes, whatever else is in it.

    A reply counts if its sum is right and its numbers are possible. Where one is not, the search
    goes on one byte further, so that no true reply is lost behind a false beginning.

    Attributes:
        replies: Command -> how many of its replies came.
        identity: What the device says of itself: its model and serial number.
        bad: Beginnings of a reply whose sum or numbers were wrong.
        skipped: Bytes that belong to no reply.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()
        self.replies = dict.fromkeys(LENGTHS, 0)
        self.identity: dict[str, str] = {}
        self.bad = 0
        self.skipped = 0

    def feed(self, data: bytes, now_ns: int) -> list[Reading]:
        """Take in bytes.

        Args:
            data: Whatever the line gave.
            now_ns: When, on the host's clock.

        Returns:
            Readings that are complete, in order.
        """
        self._buffer += data
        found: list[Reading] = []
        at, buffer = 0, self._buffer
        while at < len(buffer):
            length = LENGTHS.get(buffer[at])
            if length is None:
                at += 1
                self.skipped += 1
                continue
            if at + length > len(buffer):
                break
            message = bytes(buffer[at : at + length])
            reading = self._read(message, now_ns)
            if reading is None:
                self.bad += 1
                self.skipped += 1
                at += 1
                continue
            self.replies[message[0]] += 1
            if message[0] == IDENTITY and message[1] in TEXTS:
                self.identity[TEXTS[message[1]]] = text_of(message[2:-2])
            if isinstance(reading, Reading):
                found.append(reading)
            at += length
        del buffer[:at]
        return found

    @staticmethod
    def _read(message: bytes, now_ns: int) -> Reading | bool | None:
        """A reading, True for a reply of another kind, None for what is no reply."""
        if sum(message[:-2]) & 0xFFFF != int.from_bytes(message[-2:], 'big'):
            return None
        if message[0] != EULER_AND_RATES:
            return True
        *numbers, ticks = BODY.unpack(message[1:-2])
        euler, rates = tuple(numbers[:3]), tuple(numbers[3:])
        # NaN fails every comparison.
        if not all(abs(x) <= TURN for x in euler) or not all(abs(x) <= FASTEST for x in rates):
            return None
        return Reading(ticks, euler, rates, now_ns)
