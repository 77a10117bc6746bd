"""What is intact in an MCAP file, whatever has happened to the rest of it. Pure; no ROS.

`survey` walks over a file once and tells where it is intact, where it is not and why. `messages`
then reads the intact places. Neither trusts a length: each is held against what is left of the
file and against a stated limit before anything is unpacked.

An MCAP file (https://mcap.dev/spec) is a row of records: opcode (1 byte), length (8), content;
little endian. Messages mostly lie in chunks, which are records that hold records, packed, with
the CRC-32 of what they unpack to. Where the row breaks, the next record is sought byte by byte: a
chunk states its length twice, in 64 bits each, so that chance does not make one; any other record
must fit its length exactly, and a further one must follow. A chunk whose head is damaged is still
known by its CRC. A chunk whose CRC does not fit is lost as a whole, because nothing tells which of
its messages is false.
"""

import contextlib
import mmap
import re
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from cg_sysid.records.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    DATA_END,
    FOOTER,
    FRAMES,
    LARGEST_CHUNK,
    MAGIC,
    MESSAGE,
    PRIVATE,
    RECORD,
    SCHEMA,
    STATISTICS,
    U64,
    Channel,
    Chunk,
    Damage,
    Message,
    Schema,
    chunk_at,
    frame,
    may_begin,
    message_at,
    parse,
    records_of,
    unpacked,
    unpacked_part,
)

# A record may begin here: a known opcode and a length below 1 TB.
CANDIDATE = re.compile(rb'[\x01-\x0f](?=.{5}\x00{3})', re.DOTALL)
# The rest of the head of a chunk whose beginning is gone: size, CRC, compression; then a length,
# which for one that is not packed is the size once more.
REST_OF_HEAD = re.compile(
    rb'(?=(.{6}\x00\x00)(.{4})(?:\x00{4}\1|\x04\x00{3}zstd.{8}\x28\xb5\x2f\xfd'
    rb'|\x03\x00{3}lz4.{8}\x04\x22\x4d\x18))',
    re.DOTALL,
)
TYPE_NAME = re.compile(r'\w+/(msg/)?\w+', re.ASCII)
TOPIC_NAME = re.compile(r'/[\w/~]+', re.ASCII)
LONGEST_HEAD = 61  # bytes from the opcode of a chunk to its content
LARGEST_RATIO = 1000  # a file may unpack to this many times its size and one largest chunk


class TooLarge(Damage):
    """A limit is reached: nothing behind it is read."""


@dataclass
class Gap:
    """A damaged place.

    Attributes:
        start: Its first byte.
        stop: The byte after its last.
        reason: What is wrong.
        from_ns: Log time of the newest message before it; 0 without one.
        until_ns: Log time of the next message after it; 0 without one.
        missing: Channel -> messages whose numbers are missing there.
        lost: Whether bytes were lost that could have held messages.
    """

    start: int
    stop: int
    reason: str
    from_ns: int = 0
    until_ns: int = 0
    missing: Counter[int] = field(default_factory=Counter)
    lost: bool = True


@dataclass
class Survey:
    """What a file holds.

    Attributes:
        path: The file.
        size: Its bytes.
        closed: Whether it ends as a complete file does.
        gaps: Damaged places, in the order of the file.
        schemas: Number -> message type.
        channels: Number -> topic.
        counts: Channel -> intact messages.
        stated: Channel -> messages by the file's own statistics; empty without them.
        numbered: Whether messages are numbered, so that those that are missing can be counted.
        pieces: Offsets of intact chunks and of messages outside chunks.
        chunks: How many of them are chunks.
        odd: Offset -> chunk, of those whose head does not tell where they are.
    """

    path: Path
    size: int
    closed: bool = False
    gaps: list[Gap] = field(default_factory=list)
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    counts: Counter[int] = field(default_factory=Counter)
    stated: dict[int, int] = field(default_factory=dict)
    numbered: bool = False
    pieces: array = field(default_factory=lambda: array('Q'))
    odd: dict[int, Chunk] = field(default_factory=dict)
    chunks: int = 0

    @property
    def sound(self) -> bool:
        """Whether nothing is wrong with the file."""
        return self.closed and not self.gaps

    @property
    def bytes_per_message(self) -> float:
        """Bytes of the file that a message takes on the average."""
        count = sum(self.counts.values())
        lost = sum(gap.stop - gap.start for gap in self.gaps)
        return (self.size - lost) / count if count else float('inf')


@contextlib.contextmanager
def _mapped(path: Path) -> Iterator[bytes | mmap.mmap]:
    with path.open('rb') as file:
        if path.stat().st_size == 0:
            yield b''
            return
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as view:
            yield view


def survey(path: Path) -> Survey:
    """Walk over a file.

    Raises:
        OSError: It cannot be read.
    """
    with _mapped(path) as view:
        found = _Surveyor(path, view, chunked=False).run()
        if found.chunks and found.chunks < len(found.pieces):
            # Such a file has its messages in chunks: what lies outside is left of a broken one.
            found = _Surveyor(path, view, chunked=True).run()
        return found


def messages(found: Survey) -> Iterator[Message]:
    """The intact messages of a file, in the order in which they lie in it.

    Raises:
        OSError: It cannot be read.
    """
    with _mapped(found.path) as view:
        for offset in found.pieces:
            chunk = found.odd.get(offset)
            if chunk is None and view[offset] == MESSAGE:
                start, stop = frame(view, offset)
                yield message_at(view, start, stop, trusted=False)
                continue
            chunk = chunk or chunk_at(view, offset)
            content = unpacked_part(view, chunk)
            trusted = chunk.whole and chunk.crc != 0
            try:
                for opcode, start, stop in records_of(content):
                    if opcode == MESSAGE:
                        yield message_at(content, start, stop, trusted)
            except Damage:
                continue  # the survey has told of it


class _Surveyor:
    """The walk over one file; in a `chunked` one nothing is taken in from outside chunks."""

    def __init__(self, path: Path, view: bytes | mmap.mmap, chunked: bool):
        self.view = view
        self.found = Survey(path, len(view))
        self.allowance = LARGEST_RATIO * len(view) + LARGEST_CHUNK
        self.chunked = chunked
        self.schemas: dict[int, Counter[Schema]] = {}
        self.channels: dict[int, Counter[Channel]] = {}
        self.last: dict[int, int] = {}  # channel -> number of its newest message
        self.newest_ns = 0
        self.steps = 0
        self.before = 0  # where the record before this one begins

    def run(self) -> Survey:
        view, found = self.view, self.found
        at = len(MAGIC)
        if view[:at] != MAGIC:
            at = min(at, found.size)
            self._gap(0, at, 'the file does not begin as an MCAP file', lost=False)
        try:
            while at < found.size and not found.closed:
                at = self._step(at)
        except TooLarge as error:
            self._gap(at, found.size, str(error))
        self._settle()
        return found

    def _settle(self) -> None:
        found = self.found
        for number, schemas in self.schemas.items():
            found.schemas[number] = max(
                schemas, key=lambda s: (s.trusted, schemas[s], bool(TYPE_NAME.fullmatch(s.name)))
            )
        for number, channels in self.channels.items():
            found.channels[number] = max(
                channels, key=lambda c: (channels[c], bool(TOPIC_NAME.fullmatch(c.topic)))
            )
        found.numbered = 2 * self.steps > sum(found.counts.values())

    def _step(self, at: int) -> int:
        """Take in the record at this place; return where the next one begins."""
        try:
            opcode = self.view[at]
            start, stop = frame(self.view, at)
            if opcode == CHUNK:
                self._take_chunk(at, chunk_at(self.view, at))
            else:
                self._take(at, opcode, start, stop)
            self.before = at if opcode != CHUNK else stop
            return stop
        except TooLarge:
            raise
        except Damage as error:
            return self._mend(at, str(error))

    def _take(self, at: int, opcode: int, start: int, stop: int) -> None:
        view, found = self.view, self.found
        content = parse(view, opcode, start, stop)
        if opcode in (MESSAGE, SCHEMA, CHANNEL) or opcode >= PRIVATE:
            # No CRC vouches for it: its length does if another record follows, or none is in it.
            if not may_begin(view, stop) and self._next(at + 1, stop) < stop:
                raise Damage('no record follows where its length says')
        if opcode == MESSAGE:
            if self.chunked:
                raise Damage('a message is outside of the chunks')
            self._count(*content)
            found.pieces.append(at)
        elif opcode in (SCHEMA, CHANNEL):
            self._announce(opcode, content, trusted=False)
        elif opcode == STATISTICS:
            found.stated = content
        elif opcode == FOOTER:
            if view[stop : stop + len(MAGIC)] != MAGIC:
                raise Damage('the footer is not followed by the end of the file')
            summary, _, crc = struct.unpack_from('<QQI', view, start)
            if crc and (summary > start or zlib.crc32(view[summary : stop - 4]) != crc):
                self._gap(min(summary, at), at, 'the CRC of the index does not fit', lost=False)
            if stop + len(MAGIC) < found.size:
                self._gap(stop + len(MAGIC), found.size, 'bytes after the end', lost=False)
            found.closed = True

    def _announce(self, opcode: int, content: tuple, trusted: bool) -> None:
        number, announced = content
        if opcode == SCHEMA:
            announced = announced._replace(trusted=trusted)
            self.schemas.setdefault(number, Counter())[announced] += 1
        else:
            # A CRC outweighs any number of repetitions without one.
            self.channels.setdefault(number, Counter())[announced] += 1_000_000 if trusted else 1

    def _take_chunk(self, at: int, chunk: Chunk) -> None:
        """Take in a whole chunk; Damage, and nothing taken, unless it is intact."""
        trusted = chunk.crc != 0
        try:
            content = self._unpack(chunk)
            if trusted and zlib.crc32(content) != chunk.crc:
                raise Damage('the CRC of a chunk does not fit')
            self._take_content(content, trusted)
        except TooLarge:
            raise
        except Damage:
            if not trusted and chunk.size <= LARGEST_CHUNK:
                self._take_part(at, chunk)
            raise
        self._keep(at)

    def _keep(self, at: int, odd: Chunk | None = None) -> None:
        self.found.pieces.append(at)
        self.found.chunks += 1
        if odd is not None:
            self.found.odd[at] = odd

    def _take_content(self, content: bytes, trusted: bool) -> None:
        records = [(op, parse(content, op, a, b)) for op, a, b in records_of(content)]
        for opcode, parsed in records:
            if opcode == MESSAGE:
                self._count(*parsed)
            else:
                self._announce(opcode, parsed, trusted)

    def _take_part(self, at: int, chunk: Chunk) -> None:
        """Take in what can be read of a chunk that no CRC vouches for, or that was cut off."""
        chunk = chunk._replace(whole=False, stop=min(chunk.stop, self.found.size))
        content = unpacked_part(self.view, chunk)
        self.allowance -= len(content)
        count = 0
        with contextlib.suppress(Damage):
            for opcode, start, stop in records_of(content):
                parsed = parse(content, opcode, start, stop)
                if opcode == MESSAGE:
                    self._count(*parsed)
                    count += 1
                else:
                    self._announce(opcode, parsed, trusted=False)
        if count:
            self._keep(at, chunk)

    def _unpack(self, chunk: Chunk) -> bytes:
        if chunk.size > LARGEST_CHUNK:
            raise Damage(
                f'a chunk unpacks to {chunk.size} bytes; at most {LARGEST_CHUNK} are allowed'
            )
        self.allowance -= max(chunk.size, chunk.stop - chunk.start)
        if self.allowance < 0:
            raise TooLarge(
                f'the file unpacks to more than {LARGEST_RATIO} times its size and '
                f'{LARGEST_CHUNK} bytes; nothing behind this place is read'
            )
        return unpacked(self.view, chunk)

    def _count(self, channel: int, sequence: int, log_ns: int) -> None:
        found = self.found
        found.counts[channel] += 1
        last = self.last.get(channel, -1)
        self.last[channel] = max(sequence, last)
        if found.gaps:
            gap = found.gaps[-1]
            if not gap.until_ns:
                for earlier in reversed(found.gaps):
                    if earlier.until_ns:
                        break
                    earlier.until_ns = log_ns
            # Nothing of this channel was seen since the gap, so it is there that some are missing.
            if 0 < sequence - last - 1 <= gap.stop - gap.start:
                gap.missing[channel] += sequence - last - 1
        if sequence == last + 1 > 0:
            self.steps += 1
        self.newest_ns = max(self.newest_ns, log_ns)

    def _gap(self, start: int, stop: int, reason: str, lost: bool = True) -> None:
        self.found.gaps.append(Gap(start, stop, reason, self.newest_ns, lost=lost))

    def _mend(self, at: int, reason: str) -> int:
        """Go on behind a damaged place; return where."""
        view, size = self.view, self.found.size
        chunk = self._by_crc(at)
        if chunk is not None:
            return self._take_headless(at, chunk, reason)
        with contextlib.suppress(Damage):
            # A damaged record between others that are in their places.
            _, stop = frame(view, at)
            if view[at] == CHUNK:
                chunk_at(view, at)
            if view[at] <= DATA_END and may_begin(view, stop):
                # Unless the beginning of the next chunk lies in it.
                chunk = self._headless(at, min(stop + LONGEST_HEAD, size))
                if chunk is not None and chunk.start - chunk.head_size < stop:
                    return self._take_headless(at, chunk, reason)
                self._gap(at, stop, reason)
                return stop
        resumed = self._next(at + 1)
        chunk = self._headless(at, resumed)
        if chunk is not None:
            return self._take_headless(at, chunk, reason)
        self._gap(at, resumed, reason if resumed < size else f'{reason}; nothing follows')
        if resumed == size and view[at] == CHUNK and at not in self.found.odd:
            with contextlib.suppress(Damage):
                self._take_part(at, chunk_at(view, at, cut_off=True))
        return resumed

    def _take_headless(self, at: int, chunk: Chunk, reason: str) -> int:
        """Take in a chunk of which only the CRC vouches; return where it ends."""
        self._gap(at, max(at, chunk.start), f'a chunk has a damaged head ({reason})')
        self._take_content(unpacked(self.view, chunk), trusted=True)
        self._keep(at, chunk)
        self.before = chunk.stop
        return chunk.stop

    def _headless(self, at: int, stop: int) -> Chunk | None:
        """The first chunk that ends behind a place, of which only the beginning is damaged."""
        view = self.view
        # Where bytes are gone, the record before may have taken in the beginning of a chunk.
        for match in REST_OF_HEAD.finditer(view, min(at, self.before or at), stop):
            begin = match.start()
            size, crc, letters = struct.unpack_from('<QII', view, begin)
            place = begin + 16 + letters
            (taken,) = U64.unpack_from(view, place)
            start = place + U64.size
            if crc == 0 or not 0 < taken <= len(view) - start:
                continue
            compression = view[begin + 16 : place].decode('ascii', 'replace')
            chunk = Chunk(start, start + taken, compression, size, crc)
            if chunk.stop > at and self._fits(chunk):
                return chunk
        return None

    def _fits(self, chunk: Chunk) -> bool:
        """Whether a chunk unpacks to what its CRC says, and that to records."""
        try:
            content = self._unpack(chunk)
            if zlib.crc32(content) != chunk.crc:
                return False
            for opcode, start, stop in records_of(content):
                parse(content, opcode, start, stop)
        except TooLarge:
            raise
        except Damage:
            return False
        return True

    def _by_crc(self, at: int) -> Chunk | None:
        """A chunk whose head is damaged, recognised by the CRC of its content."""
        view, size = self.view, self.found.size
        if at + RECORD.size + CHUNK_HEAD.size + U64.size > size:
            return None
        _, length = RECORD.unpack_from(view, at)
        _, _, size_of_content, crc, _ = CHUNK_HEAD.unpack_from(view, at + RECORD.size)
        if crc == 0:
            return None
        for compression in ('', 'zstd', 'lz4'):
            head = CHUNK_HEAD.size + len(compression) + U64.size
            start = at + RECORD.size + head
            if compression and view[start : start + 4] != FRAMES[compression]:
                continue
            if start > size:
                continue
            (stated,) = U64.unpack_from(view, start - U64.size)
            lengths = {stated, length - head} | ({size_of_content} if not compression else set())
            for taken in lengths:
                if not 0 < taken <= size - start:
                    continue
                wanted = size_of_content if compression else taken
                chunk = Chunk(start, start + taken, compression, wanted, crc)
                if self._fits(chunk):
                    return chunk
        return None

    def _next(self, at: int, end: int | None = None) -> int:
        """The next place, before the end, at which a record surely begins; the end without one."""
        view = self.view
        end = len(view) if end is None else end
        for match in CANDIDATE.finditer(view, at, min(end + RECORD.size, len(view))):
            begin = match.start()
            if begin >= end:
                break
            try:
                opcode = view[begin]
                start, stop = frame(view, begin)
                if opcode == CHUNK:
                    chunk_at(view, begin)
                    return begin
                if opcode == MESSAGE and self.chunked:
                    continue
                parse(view, opcode, start, stop)
                if stop == len(view) or opcode == FOOTER:
                    if view[stop : stop + len(MAGIC)] == (MAGIC if opcode == FOOTER else b''):
                        return begin
                elif may_begin(view, stop):
                    return begin
            except Damage:
                continue
        return end
