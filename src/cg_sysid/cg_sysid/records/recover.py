"""Make an ordinary bag of what a recording left on disk, complete, killed or damaged. No ROS.

`cg recover BAG` for people, `needs_recovery` and `recover` for programs. Works on
the journals of this project's recorder, and on any MCAP bag whose writer died or that was damaged
later: everything intact is kept, before and after the damage, and what was lost is told. The bag
is complete on disk at every moment: the new file replaces the old one in one step, and
metadata.yaml comes last. A damaged file stays beside it, as `NAME.damaged`.
"""

import argparse
import contextlib
import functools
import heapq
import json
import os
import shutil
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from rosbags.interfaces import Connection, Qos
from rosbags.rosbag2.metadata import parse_qos
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from cg_description.reading import parse_json, parse_yaml
from cg_interfaces.channels import MECHANISMS, STRING
from cg_interfaces.topics import EXPERIMENT
from cg_sysid.progress import Bars
from cg_sysid.records.bag_file import BagWriter
from cg_sysid.records.journal import STATUS_TOPIC, TYPE_KEY
from cg_sysid.records.mcap_records import LATEST_NS, MAGIC
from cg_sysid.records.mcap_scan import Gap, Survey, messages, survey

JOURNAL_NAME = 'journal.mcap'
WORK_NAME = '.recovering'
METADATA = 'metadata.yaml'
DAMAGED = '.damaged'
REORDER_NS = 1_000_000_000  # messages are sorted by log time within this horizon
LATE_NS = 20_000_000  # what is later than this is told in the bag
LOSSES_SHOWN = 20

JAZZY = get_typestore(Stores.ROS2_JAZZY)
# For a journal or bag in which every copy of a schema is damaged.
KNOWN_TYPES = {EXPERIMENT: STRING} | {
    topic.name: topic.msgtype
    for mechanism in MECHANISMS.values()
    for topic in mechanism.topics.values()
}


class RecoveryError(ValueError):
    """A path that holds nothing to recover; the message says what is there instead."""


@dataclass(frozen=True)
class Loss:
    """A damaged place of a file.

    Attributes:
        file: Name of the file.
        start: First byte that is lost.
        stop: The byte after the last.
        reason: What is wrong there.
        from_ns: Log time of the newest message before it; 0 without one.
        until_ns: Log time of the next message after it; 0 without one.
        messages: Topic -> messages that are missing there, where they are numbered.
        estimate: Messages that are missing there.
    """

    file: str
    start: int
    stop: int
    reason: str
    from_ns: int
    until_ns: int
    messages: dict[str, int]
    estimate: int

    def __str__(self) -> str:
        place = f'{self.file}, bytes {self.start} to {self.stop}: {self.reason}'
        if not self.estimate:
            return f'{place}; no message lost'
        topics = ', '.join(f'{n} of {topic}' for topic, n in sorted(self.messages.items()))
        about = f' ({topics})' if topics else ''
        return f'{place}; about {self.estimate} messages lost{about}{self._when()}'

    def _when(self) -> str:
        begin, end = f'{1e-9 * self.from_ns:.3f} s', f'{1e-9 * self.until_ns:.3f} s'
        if self.from_ns and self.until_ns:
            return f', from {begin} to {end}'
        if self.from_ns or self.until_ns:
            return f', after {begin}' if self.from_ns else f', before {end}'
        return ''


@dataclass(frozen=True)
class Recovered:
    """What became of a recording.

    Attributes:
        path: The bag directory.
        messages: Messages in it.
        losses: Damaged places.
        undecodable: Topic -> messages left out because they do not decode.
        left_out: Messages from before all expected topics had begun.
        began_late: Expected topic -> s by which it began after the bag; None: never.
        received_late: Topic -> longest time in s that a message took, over the shortest.
    """

    path: Path
    messages: int
    losses: tuple[Loss, ...] = ()
    undecodable: dict[str, int] = field(default_factory=dict)
    left_out: int = 0
    began_late: dict[str, float | None] = field(default_factory=dict)
    received_late: dict[str, float] = field(default_factory=dict)

    @property
    def damage(self) -> tuple[str, ...]:
        """What was lost and where, a line for each place; empty for a file that just ends."""
        lines = [str(loss) for loss in self.losses[:LOSSES_SHOWN]]
        if len(self.losses) > LOSSES_SHOWN:
            rest = self.losses[LOSSES_SHOWN:]
            count = sum(loss.estimate for loss in rest)
            lines.append(f'{len(rest)} more damaged places, about {count} messages lost')
        lines += [
            f'{count} messages of {topic} do not decode and are left out'
            for topic, count in sorted(self.undecodable.items())
        ]
        return tuple(lines)

    @property
    def remarks(self) -> tuple[str, ...]:
        """What a reader of the bag should know, a line each."""
        late = [
            f'{topic} never began' if delay is None else f'{topic} began {delay:.3f} s late'
            for topic, delay in self.began_late.items()
        ]
        late += [
            f'{topic} was received up to {delay:.3f} s late'
            for topic, delay in self.received_late.items()
        ]
        return (*self.damage, *late)


class Entry(NamedTuple):
    """A message with its place in the order of the bag."""

    log_ns: int
    topic: str
    number: int
    data: bytes


@dataclass
class Topic:
    """What a bag must know of a topic, and what became of its messages."""

    name: str
    msgtype: str
    store: Typestore
    qos: list[Qos]
    count: int = 0
    undecodable: int = 0
    first_ns: int = 0  # of its first message in the bag
    delays: tuple[int, int] | None = None  # shortest and longest, ns

    def note_delay(self, delay: int) -> None:
        """Take in how long after its stamp a message was received, in ns."""
        low, high = self.delays or (delay, delay)
        self.delays = min(low, delay), max(high, delay)


@dataclass
class Contents:
    """What the files of a recording hold, and what is found while it is read."""

    surveys: list[Survey]
    topics: dict[str, Topic] = field(default_factory=dict)
    status: dict[str, Any] = field(default_factory=dict)
    unknown: Counter[str] = field(default_factory=Counter)
    left_out: int = 0

    @property
    def begin_ns(self) -> int:
        """Where the bag begins; 0 where nothing is left out for it."""
        return self.status.get('begin_ns', 0)

    @property
    def by_stamp(self) -> bool:
        """Whether that is a stamp, and no log time."""
        return self.status.get('begin_by') == 'stamp'


def needs_recovery(path: str | Path) -> bool:
    """Whether a bag directory or MCAP file was never closed. False for what is neither."""
    path = Path(path)
    if path.is_dir():
        files = list(path.glob('*.mcap'))
        if not files:
            return False
        return not (path / METADATA).is_file() or any(_is_cut_off(file) for file in files)
    return path.suffix == '.mcap' and path.is_file() and _is_cut_off(path)


def is_damaged(path: str | Path) -> bool:
    """Whether a bag directory or MCAP file needs recovery, or is damaged inside."""
    path = Path(path)
    files = path.glob('*.mcap') if path.is_dir() else [path]
    return needs_recovery(path) or any(not survey(file).sound for file in files)


def _is_cut_off(file: Path) -> bool:
    size = file.stat().st_size
    if size < 2 * len(MAGIC):
        return True
    with file.open('rb') as stream:
        stream.seek(-len(MAGIC), 2)
        return stream.read() != MAGIC


def recover(path: str | Path) -> Recovered:
    """Make an ordinary bag of a directory that was never closed or is damaged, in place.

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
    work = target / WORK_NAME
    shutil.rmtree(work, ignore_errors=True)
    # rosbags names the file after the directory, and the file carries that name in its metadata.
    staged = work / target.resolve().name
    try:
        result = _make(staged, sources, target)
        if result.messages == 0:
            reasons = '; '.join(result.damage)
            raise RecoveryError(
                f'{path} holds no message that can be read' + (f': {reasons}' if reasons else '')
            )
        _replace(target, staged, sources, damaged=bool(result.damage))
    finally:
        shutil.rmtree(work, ignore_errors=True)
        with contextlib.suppress(OSError):
            if target != path:
                target.rmdir()  # of a single file that gave nothing
    return result


def _sources(path: Path) -> list[Path]:
    journal = path / JOURNAL_NAME
    if journal.is_file():
        return [journal]
    files = sorted(path.glob('*.mcap'))
    if not files:
        raise RecoveryError(f'{path} holds no .mcap file')
    return files


def _make(staged: Path, sources: list[Path], target: Path) -> Recovered:
    contents = contents_of(sources)
    writer = BagWriter(staged)
    with writer:
        begun, count = _write(writer, contents)
        # Only now is everything known; metadata.yaml is written at the end.
        result = _result(target, contents, contents.begin_ns or begun, count)
        for key, value in _custom_data(result).items():
            writer.set_custom_data(key, value)
    return result


def contents_of(sources: Sequence[Path]) -> Contents:
    """Look through the files of a recording.

    Raises:
        OSError: One cannot be read.
    """
    contents = Contents([survey(source) for source in sources])
    _learn_status(contents)
    return contents


def _learn_status(contents: Contents) -> None:
    """The newest status of the recorder (journal.py)."""
    for found in contents.surveys:
        if not any(channel.topic == STATUS_TOPIC for channel in found.channels.values()):
            continue
        for message in messages(found):
            if found.channels[message.channel].topic == STATUS_TOPIC and message.trusted:
                with contextlib.suppress(ValueError, TypeError, AttributeError):
                    status = parse_json(message.data.decode(), STATUS_TOPIC, ValueError)
                    contents.status = _checked_status(status)


def _checked_status(status: Any) -> dict[str, Any]:
    """What a status may hold; the rest of it left out."""
    begin_ns = int(str(status.get('begin_ns', 0))[:20])
    return {
        'begin_ns': begin_ns if 0 <= begin_ns <= LATEST_NS else 0,
        'begin_by': status.get('begin_by'),
        'qos': dict(status.get('qos', {})),
        'expected': [str(topic) for topic in status.get('expected', ())],
    }


def entries(contents: Contents) -> Iterator[Entry]:
    """Every intact message of known type from where the bag begins on."""
    begin_ns = contents.begin_ns
    for found in contents.surveys:
        topics = _topics(found, contents)
        for message in messages(found):
            topic = topics.get(message.channel)
            if topic is None:
                if not _is_status(found, message.channel):
                    contents.unknown[_name_of(found, message.channel)] += 1
                continue
            if not message.trusted and not _decodes(topic, message.data):
                topic.undecodable += 1
                continue
            log_ns = message.log_ns
            time_ns = message.publish_ns if contents.by_stamp else log_ns
            if time_ns < begin_ns:
                if topic.name != EXPERIMENT:
                    contents.left_out += 1
                    continue
                # It is latched: what it says still holds.
                log_ns = time_ns = begin_ns
            if topic.count == 0 or time_ns < topic.first_ns:
                topic.first_ns = time_ns
            topic.note_delay(message.log_ns - message.publish_ns)
            topic.count += 1
            yield Entry(log_ns, topic.name, topic.count, message.data)


def _is_status(found: Survey, channel: int) -> bool:
    return channel in found.channels and found.channels[channel].topic == STATUS_TOPIC


def _name_of(found: Survey, channel: int) -> str:
    if channel in found.channels:
        return found.channels[channel].topic
    return f'channel {channel}, whose topic is not known'


def _topics(found: Survey, contents: Contents) -> dict[int, Topic]:
    """Channel -> topic, of those whose message type is known."""
    known = {}
    for number, channel in found.channels.items():
        if channel.topic == STATUS_TOPIC:
            continue
        schema = found.schemas.get(channel.schema)
        metadata = dict(channel.metadata)
        msgtype = metadata.get(TYPE_KEY) or (
            schema.name if schema else KNOWN_TYPES.get(channel.topic, '')
        )
        trusted = schema is not None and schema.trusted and schema.name == msgtype
        definition = schema.definition if schema and schema.name == msgtype else ''
        store = _store_of(msgtype, definition, trusted)
        if store is None:
            continue
        topic = contents.topics.get(channel.topic)
        if topic is None:
            qos = contents.status.get('qos', {}).get(channel.topic)
            topic = Topic(
                channel.topic,
                msgtype,
                store,
                _qos(qos if qos is not None else metadata.get('offered_qos_profiles', '')),
            )
            contents.topics[channel.topic] = topic
        if topic.msgtype == msgtype:
            known[number] = topic
    return known


def _store_of(msgtype: str, definition: str, trusted: bool) -> Typestore | None:
    """A type store that knows this message type; None if nothing tells what it is."""
    if msgtype in JAZZY.fielddefs and not trusted:
        return JAZZY
    return _parsed(msgtype, definition) or (JAZZY if msgtype in JAZZY.fielddefs else None)


@functools.lru_cache(maxsize=256)
def _parsed(msgtype: str, definition: str) -> Typestore | None:
    """A type store with this message type; None if the definition cannot be used."""
    if msgtype in JAZZY.fielddefs and definition == _definition_of(JAZZY, msgtype):
        return JAZZY
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(get_types_from_msg(definition, msgtype))
        _definition_of(store, msgtype)
        store.hash_rihs01(msgtype)
    except Exception:  # the parser below has its own kinds, and asserts
        return None
    return store


@functools.lru_cache(maxsize=256)
def _definition_of(store: Typestore, msgtype: str) -> str:
    return store.generate_msgdef(msgtype, ros_version=2)[0]


def _decodes(topic: Topic, data: bytes) -> bool:
    try:
        topic.store.deserialize_cdr(data, topic.msgtype)
    except Exception:  # the generated decoders raise what comes
        return False
    return True


def _qos(profiles: Any) -> list[Qos]:
    """Offered QoS, from a list or YAML text; none if it is not what it should be."""
    try:
        if isinstance(profiles, str):
            profiles = parse_yaml(profiles, 'offered QoS', ValueError)
        return parse_qos(list(profiles or []))
    except (ValueError, TypeError, KeyError, AttributeError):
        return []


def _sorted(unsorted: Iterator[Entry]) -> Iterator[Entry]:
    """By log time, then topic, then order of arrival; the same for every order of arrival."""
    heap: list[Entry] = []
    newest = 0
    for entry in unsorted:
        heapq.heappush(heap, entry)
        newest = max(newest, entry.log_ns)
        while heap[0].log_ns < newest - REORDER_NS:
            yield heapq.heappop(heap)
    while heap:
        yield heapq.heappop(heap)


def _write(writer: BagWriter, contents: Contents) -> tuple[int, int]:
    """Write every message; return the first log time and the count."""
    connections: dict[str, Connection] = {}
    count, begun = 0, 0
    damaged = any(found.gaps for found in contents.surveys)
    newest: dict[str, Entry] = {}
    for entry in _sorted(entries(contents)):
        before = newest.get(entry.topic)
        if damaged and before and (before.log_ns, before.data) == (entry.log_ns, entry.data):
            continue  # a part of the file that is there twice
        newest[entry.topic] = entry
        if entry.topic not in connections:
            connections[entry.topic] = _connection(writer, contents.topics[entry.topic])
        writer.write(connections[entry.topic], entry.log_ns, entry.data)
        begun = begun if count else entry.log_ns
        count += 1
    return begun, count


def _connection(writer: BagWriter, topic: Topic) -> Connection:
    return writer.add_connection(
        topic.name,
        topic.msgtype,
        msgdef=_definition_of(topic.store, topic.msgtype),
        rihs01=topic.store.hash_rihs01(topic.msgtype),
        offered_qos_profiles=topic.qos,
    )


def _result(target: Path, contents: Contents, begun: int, count: int) -> Recovered:
    topics = contents.topics.values()
    undecodable = {topic.name: topic.undecodable for topic in topics if topic.undecodable}
    undecodable.update(contents.unknown)
    late: dict[str, float | None] = {}
    for name in contents.status.get('expected', ()):
        topic = contents.topics.get(name)
        if topic is None or topic.count == 0:
            late[name] = None
        elif topic.first_ns - begun > LATE_NS:
            late[name] = 1e-9 * (topic.first_ns - begun)
    slow = {
        topic.name: 1e-9 * (topic.delays[1] - topic.delays[0])
        for topic in topics
        if topic.delays and topic.delays[1] - topic.delays[0] > LATE_NS
    }
    losses = tuple(_loss(found, gap) for found in contents.surveys for gap in found.gaps)
    return Recovered(target, count, losses, undecodable, contents.left_out, late, slow)


def _loss(found: Survey, gap: Gap) -> Loss:
    named = {
        _name_of(found, channel): count
        for channel, count in gap.missing.items()
        if found.numbered and not _is_status(found, channel)
    }
    if found.numbered and gap.until_ns:
        estimate = sum(named.values())
    elif gap.lost:
        estimate = round(min((gap.stop - gap.start) / found.bytes_per_message, 1e12))
    else:
        estimate = 0
    return Loss(
        found.path.name, gap.start, gap.stop, gap.reason, gap.from_ns, gap.until_ns, named,
        estimate,
    )  # fmt: skip


def _custom_data(result: Recovered) -> dict[str, str]:
    """What metadata.yaml tells of the recording beside what rosbag2 does; empty if all is well."""
    told = {
        'damage': list(result.damage),
        'began_late': result.began_late,
        'received_late': result.received_late,
    }
    return {key: json.dumps(value) for key, value in told.items() if value}


def _replace(target: Path, staged: Path, sources: list[Path], damaged: bool) -> None:
    mcap = target / f'{staged.name}.mcap'
    (target / METADATA).unlink(missing_ok=True)
    if damaged:
        for source in sources:
            if source.parent == target:
                _keep(source, source.with_name(source.name + DAMAGED))
    (staged / mcap.name).replace(mcap)
    for source in sources:
        if source.parent == target and source != mcap:
            source.unlink(missing_ok=True)
    (staged / METADATA).replace(target / METADATA)


def _keep(source: Path, copy: Path) -> None:
    """Give a file a second name; one that is there already is older and stays."""
    if copy.exists():
        return
    try:
        os.link(source, copy)
    except OSError:  # a file system without links
        shutil.copy2(source, copy)


def main(args: list[str] | None = None) -> int:
    """Entry point of `cg recover`."""
    parser = argparse.ArgumentParser(
        prog='cg recover',
        description='Make an ordinary bag of a recording that was cut off or damaged.',
    )
    parser.add_argument('bag', nargs='+', help='bag directory or .mcap file')
    parser.add_argument(
        '--force', action='store_true', help='rewrite bags that are in order as well'
    )
    status = 0
    options = parser.parse_args(args)
    for done, bag in enumerate(options.bag):
        try:
            with Bars('cg recover') as bars:
                bars(f'recovering {bag}', done, len(options.bag))
                sound = Path(bag).exists() and not options.force and not is_damaged(bag)
                result = None if sound else recover(bag)
        except (RecoveryError, OSError) as error:
            print(f'error: {error}', file=sys.stderr)
            status = 1
            continue
        if result is None:
            print(f'{bag}: nothing to recover')
            continue
        print(f'{result.path}: {result.messages} messages recovered')
        for line in result.remarks:
            print(f'  {line}')
    return status


if __name__ == '__main__':
    raise SystemExit(main())
