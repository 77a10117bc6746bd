"""Make an ordinary bag of what a recording left on disk, complete or killed. Pure; no ROS.

`cg recover BAG` for people, `needs_recovery` and `recover` for programs. Works on
the journals of this project's recorder, and on any MCAP bag whose writer died: everything up to
the first damaged record is kept. The bag is complete on disk at every moment: the new file
replaces the old one in one step, and metadata.yaml comes last.
"""

import argparse
import contextlib
import heapq
import shutil
import struct
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Chunk, Footer, Message, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from cg_sysid.progress import Bars

JOURNAL_NAME = 'journal.mcap'
WORK_NAME = '.recovering'
MAGIC = b'\x89MCAP0\r\n'
METADATA = 'metadata.yaml'
REORDER_NS = 1_000_000_000  # messages are sorted by log time within this horizon


class RecoveryError(ValueError):
    """A path that holds nothing to recover; the message says what is there instead."""


@dataclass(frozen=True)
class Recovered:
    """What became of a recording.

    Attributes:
        path: The bag directory.
        messages: Messages in it.
        damage: What ended the reading of a damaged file; empty for a journal that just ends.
    """

    path: Path
    messages: int
    damage: str


class Entry(NamedTuple):
    """A message with its place in the order of the bag."""

    log_ns: int
    topic: str
    number: int
    data: bytes


class Kind(NamedTuple):
    """What a bag must know of a topic."""

    msgtype: str
    msgdef: str
    qos: str


def needs_recovery(path: str | Path) -> bool:
    """Whether a bag directory or MCAP file was never closed. False for what is neither."""
    path = Path(path)
    if path.is_dir():
        files = list(path.glob('*.mcap'))
        if not files:
            return False
        return not (path / METADATA).is_file() or any(_is_cut_off(file) for file in files)
    return path.suffix == '.mcap' and path.is_file() and _is_cut_off(path)


def _is_cut_off(file: Path) -> bool:
    size = file.stat().st_size
    if size < 2 * len(MAGIC):
        return True
    with file.open('rb') as stream:
        stream.seek(-len(MAGIC), 2)
        return stream.read() != MAGIC


def recover(path: str | Path) -> Recovered:
    """Make an ordinary bag of a directory that was never closed, in place.

    Of a single MCAP file, a directory of the file's name is made beside it.

    Raises:
        RecoveryError: There is no readable MCAP file, or nothing to do.
    """
    path = Path(path)
    if path.is_file() and path.suffix == '.mcap':
        sources, target = [path], path.with_suffix('')
        if target.exists():
            raise RecoveryError(f'{target} is in the way of what {path.name} would become')
        target.mkdir()
    elif path.is_dir():
        sources, target = _sources(path), path
    else:
        raise RecoveryError(f'{path} is neither a bag directory nor an .mcap file')
    kinds: dict[str, Kind] = {}
    damage: list[str] = []
    entries = _sorted(_messages(sources, kinds, damage))
    work = target / WORK_NAME
    shutil.rmtree(work, ignore_errors=True)
    # rosbags names the file after the directory, and the file carries that name in its metadata.
    staged = work / target.resolve().name
    count = _write(staged, entries, kinds)
    return _replace(target, staged, sources, Recovered(target, count, '; '.join(damage)))


def _sources(path: Path) -> list[Path]:
    journal = path / JOURNAL_NAME
    if journal.is_file():
        return [journal]
    files = sorted(path.glob('*.mcap'))
    if not files:
        raise RecoveryError(f'{path} holds no .mcap file')
    return files


def _messages(sources: list[Path], kinds: dict[str, Kind], damage: list[str]) -> Iterator[Entry]:
    """Every message up to the first damage of each file; fills `kinds` and `damage` on the way."""
    counts: dict[str, int] = {}
    for source in sources:
        schemas: dict[int, Schema] = {}
        topics: dict[int, str] = {}
        try:
            for record in _records(source):
                if isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Channel):
                    schema = schemas[record.schema_id]
                    topics[record.id] = record.topic
                    kinds[record.topic] = Kind(
                        schema.name,
                        schema.data.decode(),
                        record.metadata.get('offered_qos_profiles', ''),
                    )
                elif isinstance(record, Message):
                    topic = topics[record.channel_id]
                    counts[topic] = counts.get(topic, 0) + 1
                    yield Entry(record.log_time, topic, counts[topic], record.data)
        except (McapError, EOFError, struct.error, zstandard.ZstdError, KeyError) as error:
            damage.append(f'{source.name}: {type(error).__name__} {error}'.rstrip())


def _records(source: Path) -> Iterator[object]:
    size = source.stat().st_size
    with source.open('rb') as stream:
        for record in StreamReader(stream, emit_chunks=True, record_size_limit=size).records:
            if isinstance(record, Chunk):
                yield from breakup_chunk(record, validate_crc=True)
            elif isinstance(record, Footer):
                return
            else:
                yield record
            if stream.tell() == size:
                return


def _sorted(messages: Iterator[Entry]) -> Iterator[Entry]:
    """By log time, then topic, then order of arrival; the same for every order of arrival."""
    heap: list[Entry] = []
    newest = 0
    for message in messages:
        heapq.heappush(heap, message)
        newest = max(newest, message.log_ns)
        while heap[0].log_ns < newest - REORDER_NS:
            yield heapq.heappop(heap)
    while heap:
        yield heapq.heappop(heap)


def _write(path: Path, entries: Iterator[Entry], kinds: dict[str, Kind]) -> int:
    typestore = get_typestore(Stores.ROS2_JAZZY)
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
    connections = {}
    count = 0
    with writer:
        for entry in entries:
            if entry.topic not in connections:
                kind = kinds[entry.topic]
                if kind.msgtype not in typestore.fielddefs:
                    typestore.register(get_types_from_msg(kind.msgdef, kind.msgtype))
                connections[entry.topic] = writer.add_connection(
                    entry.topic,
                    kind.msgtype,
                    msgdef=kind.msgdef,
                    rihs01=typestore.hash_rihs01(kind.msgtype),
                    offered_qos_profiles=parse_qos(kind.qos),
                )
            writer.write(connections[entry.topic], entry.log_ns, entry.data)
            count += 1
    return count


def _replace(target: Path, staged: Path, sources: list[Path], result: Recovered) -> Recovered:
    if result.messages == 0:
        shutil.rmtree(staged.parent)
        raise RecoveryError(f'{target} holds no message that can be read')
    mcap = target / f'{staged.name}.mcap'
    (target / METADATA).unlink(missing_ok=True)
    (staged / mcap.name).replace(mcap)
    for source in sources:
        if source.parent == target and source != mcap:
            source.unlink()
    (staged / METADATA).replace(target / METADATA)
    with contextlib.suppress(OSError):
        shutil.rmtree(staged.parent)
    return result


def main(args: list[str] | None = None) -> int:
    """Entry point of `cg recover`."""
    parser = argparse.ArgumentParser(
        prog='cg recover', description='Make an ordinary bag of a recording that was cut off.'
    )
    parser.add_argument('bag', nargs='+', help='bag directory or .mcap file')
    parser.add_argument(
        '--force', action='store_true', help='rewrite bags that are in order as well'
    )
    status = 0
    options = parser.parse_args(args)
    for done, bag in enumerate(options.bag):
        if Path(bag).exists() and not options.force and not needs_recovery(bag):
            print(f'{bag}: nothing to recover')
            continue
        try:
            with Bars('cg recover') as bars:
                bars(f'recovering {bag}', done, len(options.bag))
                result = recover(bag)
        except (RecoveryError, OSError) as error:
            print(f'error: {error}', file=sys.stderr)
            status = 1
            continue
        lost = f'; the file ended in a damaged record ({result.damage})' if result.damage else ''
        print(f'{result.path}: {result.messages} messages recovered{lost}')
    return status


if __name__ == '__main__':
    raise SystemExit(main())
