"""A bag while it is being written: an MCAP file that a killed process leaves readable.

Messages gather in a chunk; a chunk older than `CHUNK_AGE` is compressed and handed to the
operating system, which keeps it whatever happens to the process. So a SIGKILL loses what is
younger than that age, and nothing else. The file has no summary: `recover.py` turns a journal,
complete or not, into an ordinary bag, and a clean end of a recording takes the same way.

Format: https://mcap.dev/spec. Record = opcode (1 byte), length (8), content; little endian.
"""

import struct
import zlib
from pathlib import Path

import zstandard

MAGIC = b'\x89MCAP0\r\n'
HEADER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 0x01, 0x03, 0x04, 0x05, 0x06
CHUNK_AGE = 0.01  # s
CHUNK_BYTES = 64 * 1024
MESSAGE_HEAD = struct.Struct('<BQHIQQ')  # opcode, length, channel, sequence, log, publish time
MESSAGE_HEAD_LENGTH = 22  # of the content


def _text(text: str) -> bytes:
    encoded = text.encode()
    return struct.pack('<I', len(encoded)) + encoded


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack('<BQ', opcode, len(content)) + content


class Journal:
    """Appends messages to an MCAP file, chunk by chunk."""

    def __init__(self, path: Path):
        """Create the file; FileExistsError if it is there already."""
        self._file = path.open('xb', buffering=0)
        self._file.write(MAGIC + _record(HEADER, _text('ros2') + _text('cg_sysid')))
        self._compressor = zstandard.ZstdCompressor(level=1)
        self._schemas: dict[str, int] = {}
        self._channels = 0
        self._open_chunk()

    def _open_chunk(self) -> None:
        self._parts: list[bytes] = []
        self._size = 0
        self._opened: float | None = None
        self._first_ns = self._last_ns = 0

    def add_channel(self, topic: str, msgtype: str, msgdef: str, metadata: dict[str, str]) -> int:
        """Announce a topic; return the number to write its messages with.

        Args:
            topic: Name of the topic.
            msgtype: Message type, such as sensor_msgs/msg/Imu.
            msgdef: Its definition in ros2msg form, with those it depends on.
            metadata: Kept with the channel; rosbag2 looks for `offered_qos_profiles` there.
        """
        self.flush()
        if msgtype not in self._schemas:
            number = len(self._schemas) + 1
            self._schemas[msgtype] = number
            definition = msgdef.encode()
            self._file.write(
                _record(
                    SCHEMA,
                    struct.pack('<H', number)
                    + _text(msgtype)
                    + _text('ros2msg')
                    + struct.pack('<I', len(definition))
                    + definition,
                )
            )
        self._channels += 1
        pairs = b''.join(_text(key) + _text(value) for key, value in metadata.items())
        self._file.write(
            _record(
                CHANNEL,
                struct.pack('<HH', self._channels, self._schemas[msgtype])
                + _text(topic)
                + _text('cdr')
                + struct.pack('<I', len(pairs))
                + pairs,
            )
        )
        return self._channels

    def write(
        self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes, now: float
    ) -> None:
        """Append a message.

        Args:
            channel: What `add_channel` returned.
            sequence: Number of the message on its topic.
            log_ns: Time of receipt in ns.
            publish_ns: Stamp in ns.
            data: Serialised message.
            now: Monotonic time in s.
        """
        if self._opened is None:
            self._opened = now
            self._first_ns = self._last_ns = log_ns
        self._first_ns = min(self._first_ns, log_ns)
        self._last_ns = max(self._last_ns, log_ns)
        head = MESSAGE_HEAD.pack(
            MESSAGE, MESSAGE_HEAD_LENGTH + len(data), channel, sequence, log_ns, publish_ns
        )
        self._parts += (head, data)
        self._size += len(head) + len(data)
        if self._size >= CHUNK_BYTES:
            self.flush()
        else:
            self.flush_if_due(now)

    def flush_if_due(self, now: float) -> float:
        """Close a chunk that is old enough; return the s until the present one will be."""
        if self._opened is None:
            return CHUNK_AGE
        remaining = self._opened + CHUNK_AGE - now
        if remaining <= 0.0:
            self.flush()
            return CHUNK_AGE
        return remaining

    def flush(self) -> None:
        """Hand the open chunk to the operating system, with one write."""
        if not self._parts:
            return
        records = b''.join(self._parts)
        compressed = self._compressor.compress(records)
        content = (
            struct.pack('<QQQI', self._first_ns, self._last_ns, len(records), zlib.crc32(records))
            + _text('zstd')
            + struct.pack('<Q', len(compressed))
            + compressed
        )
        self._file.write(_record(CHUNK, content))
        self._open_chunk()

    def close(self) -> None:
        """Flush and close; the file stays a journal."""
        if not self._file.closed:
            self.flush()
            self._file.close()
