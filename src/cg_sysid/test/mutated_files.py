"""Recordings on disk, ways to damage them, and what must survive: for tests and for the bench."""

import random
import shutil
import struct
from dataclasses import dataclass
from pathlib import Path
from unittest import mock

import lz4.frame
import numpy as np
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from cg_sysid.records import bag_file
from cg_sysid.records.mcap_records import CHUNK, MAGIC, RECORD
from cg_sysid.records.recorder import Recording

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE, STRING = 'sensor_msgs/msg/JointState', 'std_msgs/msg/String'
TOPICS = {'/experiment': STRING, '/applied_torque': JOINT_STATE, '/joint_states': JOINT_STATE}
NOTE = 'format: cg_recording/1\nmechanism: pendulum\nsetup: {}\n'
START_NS, PERIOD_NS = 1_300_000_000_000_000_000, 2_000_000
CRC_AT = RECORD.size + 24  # of a chunk


def joint_state(stamp_ns: int, value: float) -> bytes:
    types = STORE.types
    message = types[JOINT_STATE](
        types['std_msgs/msg/Header'](
            types['builtin_interfaces/msg/Time'](stamp_ns // 10**9, stamp_ns % 10**9), 'joint'
        ),
        ['joint'],
        *(np.array([value]) for _ in range(3)),
    )
    return bytes(STORE.serialize_cdr(message, JOINT_STATE))


def script(samples: int) -> list[tuple[str, int, bytes]]:
    """Topic, log time and content of every message of the recording."""
    note = bytes(STORE.serialize_cdr(STORE.types[STRING](NOTE), STRING))
    rng = np.random.default_rng(1)
    rows = [('/experiment', START_NS, note)]
    for k in range(samples):
        stamp = START_NS + PERIOD_NS * k
        for topic in ('/applied_torque', '/joint_states'):
            rows.append((topic, stamp, joint_state(stamp, float(rng.standard_normal()))))
    return rows


def write_journal(path: Path, rows) -> Path:
    recording = Recording(path, TOPICS, by_stamp=False)
    for topic in TOPICS:
        recording.announce(topic, [])
    for k, (topic, log_ns, data) in enumerate(rows):
        recording.write(topic, data, log_ns, 0.1 * k)
    recording._journal.close()
    return path / 'journal.mcap'


def write_own_bag(path: Path, rows) -> Path:
    with mock.patch.object(bag_file, 'CHUNK_BYTES', 2048):
        _write_with(bag_file.BagWriter(path), rows)
    return path / f'{path.name}.mcap'


def write_foreign_bag(path: Path, rows) -> Path:
    """As rosbags writes it: one large chunk, packed, without a CRC."""
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    _write_with(writer, rows)
    return path / f'{path.name}.mcap'


def _write_with(writer: Writer, rows) -> None:
    with writer:
        connections = {
            topic: writer.add_connection(topic, msgtype, typestore=STORE)
            for topic, msgtype in TOPICS.items()
        }
        for topic, log_ns, data in rows:
            writer.write(connections[topic], log_ns, data)


def write_mcap(path: Path, rows, **options) -> Path:
    """By the mcap library, with its options."""
    path.mkdir()
    file = path / 'bag.mcap'
    with file.open('wb') as stream:
        writer = McapWriter(stream, **options)
        writer.start('ros2', 'test')
        schemas = {
            msgtype: writer.register_schema(
                msgtype, 'ros2msg', STORE.generate_msgdef(msgtype, ros_version=2)[0].encode()
            )
            for msgtype in (STRING, JOINT_STATE)
        }
        channels = {
            topic: writer.register_channel(topic, 'cdr', schemas[msgtype])
            for topic, msgtype in TOPICS.items()
        }
        for number, (topic, log_ns, data) in enumerate(rows):
            writer.add_message(channels[topic], log_ns, data, log_ns, number)
        writer.finish()
    return file


FILES = {
    'journal': write_journal,
    'own bag': write_own_bag,
    'bag by rosbags': write_foreign_bag,
    'lz4 chunks': lambda path, rows: write_mcap(
        path, rows, compression=CompressionType.LZ4, chunk_size=2048
    ),
    'no chunks': lambda path, rows: write_mcap(path, rows, use_chunking=False),
}


@dataclass(frozen=True)
class Original:
    """A file before it is damaged.

    Attributes:
        kind: What wrote it.
        data: Its bytes.
        messages: All that is in it: topic, log time, content.
        parts: Bytes of the file, and the messages that they hold: as long as the bytes are
            there, so are the messages. With a CRC the head of a chunk before it does not count.
    """

    kind: str
    data: bytes
    messages: frozenset
    parts: tuple[tuple[bytes, frozenset], ...]


def make_original(kind: str, folder: Path, samples: int) -> Original:
    rows = script(samples)
    data = FILES[kind](folder / kind.replace(' ', '_'), rows).read_bytes()
    parts, at, left = [], len(MAGIC), list(rows)
    by_content = {row[2]: row for row in rows}
    while at < len(data) - len(MAGIC):
        opcode, length = RECORD.unpack_from(data, at)
        stop = at + RECORD.size + length
        if opcode in (CHUNK, 5):
            held = _messages_of(data, at, stop, by_content)
            crc = opcode == CHUNK and data[CRC_AT + at : CRC_AT + at + 4] != bytes(4)
            parts.append((data[at + CRC_AT - 8 if crc else at : stop], frozenset(held)))
        at = stop
    assert sum(len(held) for _, held in parts) == len(left)
    return Original(kind, data, frozenset(rows), tuple(parts))


def _messages_of(data: bytes, at: int, stop: int, by_content) -> list:
    if data[at] == 5:
        return [by_content[data[at + RECORD.size + 22 : stop]]]
    letters = struct.unpack_from('<I', data, at + CRC_AT + 4)[0]
    packed = data[at + CRC_AT + 8 + letters + 8 : stop]
    unpack = {0: bytes, 3: lz4.frame.decompress, 4: zstandard.decompress}[letters]
    content, held, place = unpack(packed), [], 0
    while place < len(content):
        opcode, length = RECORD.unpack_from(content, place)
        place += RECORD.size + length
        body = content[place - length + 22 : place]
        if opcode == 5 and body in by_content:
            held.append(by_content[body])
    return held


def one_bit(data: bytes, rng: random.Random) -> bytes:
    return several_bits(data, rng, 1)


def several_bits(data: bytes, rng: random.Random, count: int = 8) -> bytes:
    changed = bytearray(data)
    for _ in range(count):
        changed[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    return bytes(changed)


def _range(data: bytes, rng: random.Random) -> tuple[int, int]:
    """A place and a length, any order of magnitude up to a quarter of the file."""
    length = max(1, int((len(data) / 4) ** rng.random()))
    return rng.randrange(len(data) - length), length


def overwritten(data: bytes, rng: random.Random) -> bytes:
    at, length = _range(data, rng)
    return data[:at] + rng.randbytes(length) + data[at + length :]


def zeroed(data: bytes, rng: random.Random) -> bytes:
    at, length = _range(data, rng)
    return data[:at] + bytes(length) + data[at + length :]


def cut_off(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.randrange(len(data))]


def taken_out(data: bytes, rng: random.Random) -> bytes:
    at, length = _range(data, rng)
    return data[:at] + data[at + length :]


def put_in(data: bytes, rng: random.Random) -> bytes:
    at, length = _range(data, rng)
    return data[:at] + rng.randbytes(length) + data[at:]


def copied(data: bytes, rng: random.Random) -> bytes:
    at, length = _range(data, rng)
    to, _ = _range(data, rng)
    return data[:to] + data[at : at + length] + data[to:]


def false_length(data: bytes, rng: random.Random) -> bytes:
    at = rng.randrange(len(data) - 8)
    value = rng.choice([0, 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**64 - 1, len(data)])
    return data[:at] + struct.pack('<Q', value) + data[at + 8 :]


def garbage(data: bytes, rng: random.Random) -> bytes:
    return data[: rng.choice([0, 8])] + rng.randbytes(rng.randrange(len(data)))


DAMAGES = {
    'one bit': one_bit,
    'eight bits': several_bits,
    'range overwritten': overwritten,
    'range zeroed': zeroed,
    'cut off': cut_off,
    'range taken out': taken_out,
    'garbage put in': put_in,
    'range copied': copied,
    'false length': false_length,
    'nothing but garbage': garbage,
}


def intact(original: Original, changed: bytes) -> set:
    """The messages whose bytes are all there."""
    found = set()
    for part, held in original.parts:
        if part in changed:
            found |= held
    return found


def content_of(bag: Path) -> list[tuple[str, int, bytes]]:
    """Every message of a bag, read by the mcap library."""
    (file,) = bag.glob('*.mcap')
    with file.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        return [
            (channel.topic, message.log_time, message.data)
            for _, channel, message in reader.iter_messages()
        ]


def place(folder: Path, original: Original, changed: bytes) -> Path:
    """A directory that holds the damaged file as it would be found."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    name = 'journal.mcap' if original.kind == 'journal' else 'bag.mcap'
    (folder / name).write_bytes(changed)
    return folder
