"""Wires between processes: pseudo-terminals, and CAN frames on one as serial adapters speak."""

import errno
import os
import re
import tty
from pathlib import Path

FRAME = re.compile(rb't([0-9A-Fa-f]{3})([0-8])((?:[0-9A-Fa-f]{2})*)\Z')
REMOTE = re.compile(rb'r([0-9A-Fa-f]{3})[0-8]\Z')
HANDS = 'hands'  # name of the pipe, beside the wires, by which a person's hands are told
LINE_LIMIT = 64  # bytes of a line; what is longer is garbage


class Pty:
    """A serial line whose other end is a file that drivers open.

    Args:
        link: Path under which the other end is found; a link that is made, and goes with `close`.
    """

    def __init__(self, link: Path):
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.link = link
        link.unlink(missing_ok=True)
        link.symlink_to(os.ttyname(self._slave))

    def fileno(self) -> int:
        """To wait for what comes in."""
        return self._master

    def read(self) -> bytes:
        """What came in."""
        try:
            return os.read(self._master, 65536)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EIO):
                return b''
            raise

    def write(self, data: bytes) -> None:
        """Send; what nobody takes off the line is lost, as on a wire."""
        try:
            os.write(self._master, data)
        except BlockingIOError:
            pass

    def close(self) -> None:
        """Pull the plug."""
        self.link.unlink(missing_ok=True)
        os.close(self._slave)
        os.close(self._master)


class SerialCan:
    """CAN frames on a serial line, in the ASCII of Lawicel's adapters (SLCAN).

    tIIIL DD.. CR is a frame with an 11-bit identifier, rIIIL CR a remote request for one; S, O, C
    open and close, and are answered by CR.
    """

    def __init__(self, line: Pty):
        self._line, self._buffer = line, b''
        self.opened = False

    def receive(self) -> list[tuple[int, bytes | None]]:
        """Frames that came in: identifier, data, or None of a remote request."""
        *lines, self._buffer = (self._buffer + self._line.read()).split(b'\r')
        self._buffer = self._buffer[-LINE_LIMIT:]
        frames: list[tuple[int, bytes | None]] = []
        for line in lines:
            if line[:1] in (b'O', b'C', b'S'):
                self.opened = line[:1] == b'O' if line[:1] != b'S' else self.opened
                self._line.write(b'\r')
            elif match := FRAME.match(line):
                data = bytes.fromhex(match[3].decode())
                if len(data) == int(match[2]):
                    frames.append((int(match[1], 16), data))
            elif match := REMOTE.match(line):
                frames.append((int(match[1], 16), None))
        return frames

    def send(self, frames: list[tuple[int, bytes]]) -> None:
        """Frames onto the bus."""
        if self.opened and frames:
            self._line.write(b''.join(
                b't%03X%d%s\r' % (cob, len(data), data.hex().upper().encode())
                for cob, data in frames
            ))  # fmt: skip
