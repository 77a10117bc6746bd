"""The records of an MCAP file, one at a time: https://mcap.dev/spec. Pure; no ROS.

A record is opcode (1 byte), length (8), content; little endian. Nothing here trusts a length: each
is held against what is left, and against a stated limit before anything is unpacked. What does
not fit is `Damage`.
"""

import io
import mmap
import struct
from collections.abc import Iterator
from typing import Any, NamedTuple

import lz4.frame
import zstandard

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK = 1, 2, 3, 4, 5, 6
STATISTICS, METADATA, DATA_END = 0x0B, 0x0C, 0x0F
PRIVATE = 0x80  # opcodes from here on are free for applications
RECORD = struct.Struct('<BQ')  # opcode, length
MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, sequence, log time, publish time
# start and end time, size and CRC of what it unpacks to, length of the compression's name
CHUNK_HEAD = struct.Struct('<QQQII')
U32, U64 = struct.Struct('<I'), struct.Struct('<Q')
LATEST_NS = 2**63 - 1
STEP = 64 * 1024

LARGEST_CHUNK = 64 * 1024 * 1024  # bytes that a chunk may unpack to


class Damage(Exception):
    """Bytes that are not what they should be; the message says why."""


class Schema(NamedTuple):
    """A message type."""

    name: str
    encoding: str
    definition: str
    trusted: bool


class Channel(NamedTuple):
    """A topic."""

    schema: int
    topic: str
    encoding: str
    metadata: tuple[tuple[str, str], ...]


class Message(NamedTuple):
    """A message; `trusted` where a CRC vouches for it."""

    channel: int
    sequence: int
    log_ns: int
    publish_ns: int
    data: bytes
    trusted: bool


class Chunk(NamedTuple):
    """Where the content of a chunk lies in the file, and what it should unpack to."""

    start: int
    stop: int
    compression: str
    size: int
    crc: int
    whole: bool = True

    @property
    def head_size(self) -> int:
        """Bytes from the opcode to the content."""
        return RECORD.size + CHUNK_HEAD.size + len(self.compression) + U64.size


# How packed content begins.
FRAMES = {'zstd': b'\x28\xb5\x2f\xfd', 'lz4': b'\x04\x22\x4d\x18'}


def frame(view: bytes | mmap.mmap, at: int) -> tuple[int, int]:
    """Where the content of the record at this place begins and ends."""
    start = at + RECORD.size
    if start > len(view):
        raise Damage('a record is cut off by the end of the file')
    _, length = RECORD.unpack_from(view, at)
    if length > len(view) - start:
        raise Damage('a record reaches beyond the end of the file')
    return start, start + length


def may_begin(view: bytes | mmap.mmap, at: int) -> bool:
    """Whether a record, or the end of the file, is here."""
    if at == len(view):
        return True
    try:
        opcode = view[at]
        start, stop = frame(view, at)
        if opcode == CHUNK:
            chunk_at(view, at)
        else:
            parse(view, opcode, start, stop)
    except (Damage, IndexError):
        return False
    return True


def records_of(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode, start and stop of the content of each record in a chunk."""
    at, size = 0, len(content)
    while at < size:
        if size - at < RECORD.size:
            raise Damage('a record in a chunk is cut off')
        opcode, length = RECORD.unpack_from(content, at)
        start = at + RECORD.size
        if opcode not in (SCHEMA, CHANNEL, MESSAGE):
            raise Damage(f'a chunk holds a record of opcode {opcode}')
        if length > size - start:
            raise Damage('a record reaches beyond its chunk')
        at = start + length
        yield opcode, start, at


def message_at(content: bytes | mmap.mmap, start: int, stop: int, trusted: bool) -> Message:
    """The message whose content is there, with its data."""
    channel, sequence, log_ns, publish_ns = MESSAGE_HEAD.unpack_from(content, start)
    data = content[start + MESSAGE_HEAD.size : stop]
    return Message(channel, sequence, log_ns, publish_ns, data, trusted)


def chunk_at(view: bytes | mmap.mmap, at: int, cut_off: bool = False) -> Chunk:
    """The chunk at this place, by its head."""
    start = at + RECORD.size
    name = start + CHUNK_HEAD.size
    if name + U64.size > len(view):
        raise Damage('a chunk is cut off by the end of the file')
    _, length = RECORD.unpack_from(view, at)
    _, _, unpacked, crc, letters = CHUNK_HEAD.unpack_from(view, start)
    if letters > 4 or name + letters + U64.size > len(view):
        raise Damage('a chunk has a damaged head')
    compression = view[name : name + letters].decode('ascii', 'replace')
    if compression not in ('', 'zstd', 'lz4'):
        raise Damage(f'a chunk has compression {compression!r}; zstd and lz4 are known')
    (taken,) = U64.unpack_from(view, name + letters)
    begin = name + letters + U64.size
    if begin + taken != start + length:
        raise Damage('a chunk has a damaged head: its two lengths differ')
    if begin + taken > len(view) and not cut_off:
        raise Damage('a chunk reaches beyond the end of the file')
    return Chunk(begin, begin + taken, compression, unpacked, crc)


def unpacked(view: bytes | mmap.mmap, chunk: Chunk) -> bytes:
    """The content of a chunk, of exactly the size that it states."""
    packed = view[chunk.start : chunk.stop]
    try:
        if chunk.compression == '':
            content = packed
        elif chunk.compression == 'zstd':
            stated = zstandard.frame_content_size(packed)
            if stated not in (-1, chunk.size):
                raise Damage(f'a chunk of {chunk.size} bytes unpacks to {stated}')
            content = zstandard.ZstdDecompressor().decompress(
                packed, max_output_size=chunk.size or 1
            )
        else:
            unpacker = lz4.frame.LZ4FrameDecompressor()
            content = unpacker.decompress(packed, max_length=chunk.size + 1)
    except (zstandard.ZstdError, RuntimeError, MemoryError, EOFError, ValueError) as error:
        raise Damage(f'a chunk does not unpack ({error})') from None
    if len(content) != chunk.size:
        raise Damage(f'a chunk of {chunk.size} bytes unpacks to another size')
    return content


def is_bounded_zstd(packed: bytes) -> bool:
    """Whether a zstd frame says to what it unpacks, within the limit."""
    try:
        return 0 <= zstandard.frame_content_size(packed) <= LARGEST_CHUNK
    except zstandard.ZstdError:
        return False


def unpacked_part(view: bytes | mmap.mmap, chunk: Chunk) -> bytes:
    """The content of a chunk up to its first damage, of at most the size that it states."""
    if chunk.whole:
        return unpacked(view, chunk)
    packed = view[chunk.start : min(chunk.stop, len(view))]
    size = min(chunk.size, LARGEST_CHUNK)
    if chunk.compression == '':
        return packed[:size]
    parts, total = [], 0
    try:
        source: io.RawIOBase | zstandard.ZstdDecompressionReader
        if chunk.compression == 'zstd':
            source = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK).stream_reader(
                packed
            )
        else:
            source = lz4.frame.open(io.BytesIO(packed))
        while total < size:
            part = source.read(min(STEP, size - total))
            if not part:
                break
            parts.append(part)
            total += len(part)
    except (zstandard.ZstdError, RuntimeError, MemoryError, EOFError, ValueError):
        pass  # what came before stays
    return b''.join(parts)


def _text(view: bytes | mmap.mmap, at: int, stop: int) -> tuple[str, int]:
    """A text with its length before it, and where it ends."""
    if stop - at < U32.size:
        raise Damage('a text is cut off')
    (length,) = U32.unpack_from(view, at)
    begin = at + U32.size
    if length > stop - begin:
        raise Damage('a text reaches beyond its record')
    try:
        return view[begin : begin + length].decode(), begin + length
    except UnicodeDecodeError:
        raise Damage('a text is not UTF-8') from None


def _pairs(content: bytes | mmap.mmap, at: int, stop: int) -> tuple[tuple[str, str], ...]:
    """A map of texts."""
    pairs = []
    while at < stop:
        key, at = _text(content, at, stop)
        value, at = _text(content, at, stop)
        pairs.append((key, value))
    return tuple(pairs)


def parse(content: bytes | mmap.mmap, opcode: int, start: int, stop: int) -> Any:
    """What a record says, if it fits its length exactly; Damage otherwise.

    Returns:
        (channel, sequence, log time) of a message, (number, Schema), (number, Channel),
        the counts of the statistics; None of any other.
    """
    if opcode == MESSAGE:
        if stop - start < MESSAGE_HEAD.size:
            raise Damage('a message is shorter than its head')
        head = MESSAGE_HEAD.unpack_from(content, start)
        if head[2] > LATEST_NS:
            raise Damage(f'a message has the impossible time {head[2]} ns')
        return head[:3]
    if opcode >= PRIVATE:
        return None
    if opcode not in FIELDS:
        raise Damage(f'a record has the unknown opcode {opcode}')
    at = start
    values: list[Any] = []
    for kind in FIELDS[opcode]:
        if isinstance(kind, struct.Struct):
            if stop - at < kind.size:
                raise Damage('a record is shorter than its fields')
            values += kind.unpack_from(content, at)
            at += kind.size
        elif kind == 'text':
            text, at = _text(content, at, stop)
            values.append(text)
        else:  # a list of entries of that many bytes, or a map of texts, or bytes
            size, width = _LIST[kind]
            if stop - at < size.size:
                raise Damage('a list is cut off')
            (length,) = size.unpack_from(content, at)
            at += size.size
            if length > stop - at or length % width:
                raise Damage('a list does not fit its record')
            values.append((at, at + length))
            at += length
    if at != stop:
        raise Damage('a record is longer than its fields')
    if opcode == SCHEMA:
        number, name, encoding, definition = values
        return number, Schema(name, encoding, definition, False)
    if opcode == METADATA:
        _pairs(content, *values[-1])
    if opcode == CHANNEL:
        number, schema, topic, encoding, place = values
        return number, Channel(schema, topic, encoding, _pairs(content, *place))
    if opcode == STATISTICS:
        at, stop = values[-1]
        return dict(struct.iter_unpack('<HQ', content[at:stop]))
    return None


_LIST = {
    'bytes': (U64, 1), 'map': (U32, 1), 'index': (U32, 16), 'offsets': (U32, 10),
}  # fmt: skip
FIELDS: dict[int, tuple] = {
    HEADER: ('text', 'text'),
    FOOTER: (struct.Struct('<QQI'),),
    SCHEMA: (struct.Struct('<H'), 'text', 'text', 'text'),
    CHANNEL: (struct.Struct('<HH'), 'text', 'text', 'map'),
    0x07: (struct.Struct('<H'), 'index'),  # message index
    0x08: (struct.Struct('<QQQQ'), 'offsets', U64, 'text', U64, U64),  # chunk index
    0x09: (U64, U64, 'text', 'text', 'bytes', U32),  # attachment
    0x0A: (struct.Struct('<QQQQQ'), 'text', 'text'),  # attachment index
    STATISTICS: (struct.Struct('<QHIIIIQQ'), 'offsets'),
    METADATA: ('text', 'map'),
    0x0D: (U64, U64, 'text'),  # metadata index
    0x0E: (struct.Struct('<BQQ'),),  # summary offset
    DATA_END: (U32,),
}
