"""A bag while it is being written: an MCAP file that a killed process leaves readable.

Every message is a chunk of its own, handed to the operating system with one write as it arrives;
the system keeps it whatever happens to the process. The chunk says all that is needed to read it:
it repeats its channel, which names topic and message type, and carries a CRC. So a damaged place
costs the messages that lie in it, and no other. Nothing is packed, which costs more than it saves
in a file that lives as long as a recording.

The file has no summary: `recover.py` turns a journal, complete or not, into an ordinary bag, and
a clean end of a recording takes the same way. What else the bag is to tell (offered QoS, when the
recording began) is kept in `status`, a JSON text on a channel of its own, repeated now and then
together with the message definitions.

Format: https://mcap.dev/spec. Record = opcode (1 byte), length (8), content; little endian.
"""

import json
import os
import struct
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from cg_sysid.records.mcap_records import CHANNEL, CHUNK, HEADER, MAGIC, MESSAGE, SCHEMA

# opcode, length, start and end time, size, CRC, length of compression (none), length of records
CHUNK_HEAD = struct.Struct('<BQQQQIIQ')
CHUNK_HEAD_LENGTH = CHUNK_HEAD.size - 9  # of the content
MESSAGE_HEAD = struct.Struct('<BQHIQQ')  # opcode, length, channel, sequence, log, publish time
MESSAGE_HEAD_LENGTH = 22  # of the content
STATUS_TOPIC = 'recorder status'  # no name of a ROS topic
STATUS_PERIOD = 1.0  # s
TYPE_KEY = 'message_type'  # in the metadata of a channel


def _text(text: str) -> bytes:
    encoded = text.encode()
    return struct.pack('<I', len(encoded)) + encoded


def _record(opcode: int, content: bytes) -> bytes:
    return struct.pack('<BQ', opcode, len(content)) + content


def _channel(number: int, schema: int, topic: str, encoding: str, msgtype: str) -> bytes:
    pairs = _text(TYPE_KEY) + _text(msgtype) if msgtype else b''
    return _record(
        CHANNEL,
        struct.pack('<HH', number, schema)
        + _text(topic)
        + _text(encoding)
        + struct.pack('<I', len(pairs))
        + pairs,
    )


class Journal:
    """Appends messages to an MCAP file."""

    def __init__(self, path: Path):
        """Create the file; FileExistsError if it is there already."""
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_EXCL, 0o644)
        self._write(MAGIC + _record(HEADER, _text('ros2') + _text('cg_sysid')))
        self._schemas: dict[str, tuple[int, bytes]] = {}
        self._channels: dict[int, bytes] = {}
        self._status: dict[str, Any] = {}
        self._status_count = 0
        self._status_at = 0.0
        self._status_channel = _channel(0, 0, STATUS_TOPIC, 'json', '')

    def _write(self, data: bytes) -> None:
        view = memoryview(data)
        while view:  # a disk that is nearly full takes a part
            view = view[os.write(self._file, view) :]

    def _write_chunk(self, records: bytes, log_ns: int) -> None:
        size = len(records)
        head = CHUNK_HEAD.pack(
            CHUNK, CHUNK_HEAD_LENGTH + size, log_ns, log_ns, size, zlib.crc32(records), 0, size
        )
        self._write(head + records)

    def add_channel(self, topic: str, msgtype: str, msgdef: str) -> int:
        """Announce a topic; return the number to write its messages with.

        Args:
            topic: Name of the topic.
            msgtype: Message type, such as sensor_msgs/msg/Imu.
            msgdef: Its definition in ros2msg form, with those it depends on.
        """
        if msgtype not in self._schemas:
            number = len(self._schemas) + 1
            content = struct.pack('<H', number) + _text(msgtype) + _text('ros2msg') + _text(msgdef)
            self._schemas[msgtype] = (number, _record(SCHEMA, content))
        number = len(self._channels) + 1
        self._channels[number] = _channel(number, self._schemas[msgtype][0], topic, 'cdr', msgtype)
        self._write_chunk(self._schemas[msgtype][1] + self._channels[number], 0)
        return number

    def set_status(self, status: Mapping[str, Any], log_ns: int) -> None:
        """Write down what else the bag is to tell; the newest status counts.

        Args:
            status: Values that JSON can hold.
            log_ns: Time of receipt in ns.
        """
        self._status = dict(status)
        self._write_status(log_ns)

    def _write_status(self, log_ns: int) -> None:
        text = json.dumps(self._status).encode()
        head = MESSAGE_HEAD.pack(
            MESSAGE, MESSAGE_HEAD_LENGTH + len(text), 0, self._status_count, log_ns, log_ns
        )
        self._status_count += 1
        self._write_chunk(self._status_channel + head + text, log_ns)

    def repeat_if_due(self, log_ns: int, now: float) -> None:
        """Repeat status and message definitions if that was long ago.

        Args:
            log_ns: Time of the newest message in ns.
            now: Monotonic time in s.
        """
        if now >= self._status_at + STATUS_PERIOD:
            self._status_at = now
            schemas = b''.join(record for _, record in self._schemas.values())
            self._write_chunk(schemas + b''.join(self._channels.values()), 0)
            self._write_status(log_ns)

    def write(
        self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes
    ) -> None:
        """Append a message.

        Args:
            channel: What `add_channel` returned.
            sequence: Number of the message on its topic, from 0.
            log_ns: Time of receipt in ns.
            publish_ns: Stamp in ns.
            data: Serialised message.
        """
        head = MESSAGE_HEAD.pack(
            MESSAGE, MESSAGE_HEAD_LENGTH + len(data), channel, sequence, log_ns, publish_ns
        )
        self._write_chunk(self._channels[channel] + head + data, log_ns)

    def close(self) -> None:
        """Close; the file stays a journal."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
