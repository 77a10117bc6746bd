"""Bags: rosbag2 recordings in and out, by `rosbags`, with no ROS installed.

Reading goes in two steps. `read_raw` takes every sample as it stands in the file, so that
`check.py` sees each fault before anything is repaired. `to_record` puts the samples on one time
axis, repairs what is harmless (a repeated message, two messages that overtook each other) and
refuses the rest with one message. `read_bag` does both.
"""

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from cg_dynamics.rig import Setup
from rosbags.highlevel import AnyReader
from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability
from rosbags.interfaces import QosTime
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from cg_sysid import channels
from cg_sysid.channels import APPLIED_TORQUE, IMU, NOTE_TOPIC, STRING, TORQUE_COMMAND, Topic
from cg_sysid.errors import RecordingError
from cg_sysid.record import NS_PER_S, SHARED_ROW_NS, Record, hold, merge_stamps, place

NOTE_FORMAT = 'cg_recording/1'
REGULAR_AFTER_SORTING = 0.3  # smallest spacing after sorting over the median, [1]


@dataclass(frozen=True)
class RawTopic:
    """The samples of one topic in the order in which they were recorded, nothing repaired.

    Attributes:
        name: Topic name.
        msgtype: Message type.
        stamp_ns: Header stamps in ns, shape (M,), int64.
        log_ns: Times at which the recorder received them in ns, shape (M,), int64.
        values: Channel -> values, shape (M,), NaN where the message holds NaN.
        absent: Channel -> whether the message declares the value absent, shape (M,).
    """

    name: str
    msgtype: str
    stamp_ns: np.ndarray
    log_ns: np.ndarray
    values: dict[str, np.ndarray]
    absent: dict[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.stamp_ns)


@dataclass(frozen=True)
class RawRecording:
    """A recording as it stands in the file.

    Attributes:
        path: Where it was read from.
        note: The recording note, as read.
        mechanism: Name of the mechanism.
        topics: Topic name -> samples, of the topics that the mechanism knows.
        others: Names of the topics that the analysis does not use, with their message types.
    """

    path: str
    note: dict[str, Any]
    mechanism: str
    topics: dict[str, RawTopic]
    others: dict[str, str] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Short name of the recording."""
        return Path(self.path).name

    @property
    def setup(self) -> Setup:
        """What was done to the rig.

        Raises:
            RecordingError: The note's set-up is malformed.
        """
        try:
            return Setup.from_dict(self.note.get('setup') or {})
        except ValueError as error:
            raise RecordingError(f'{self.path}: note: {error}') from None


def read_bag(
    path: str | Path,
    note: Mapping[str, Any] | None = None,
    torque_topic: str | None = None,
    shared_row_ns: int = SHARED_ROW_NS,
) -> Record:
    """Read a bag to a record.

    Args:
        path: Bag directory (or a single .mcap or .db3 file).
        note: Recording note for a bag that carries none; its entries go before those in the bag.
        torque_topic: `/applied_torque` or `/torque_command`; the default is the applied torque
            where the bag has it, the command otherwise.
        shared_row_ns: Samples of different topics this close in ns share a row.

    Raises:
        RecordingError: The bag cannot be used.
    """
    return to_record(read_raw(path, note), torque_topic, shared_row_ns)


def read_raw(path: str | Path, note: Mapping[str, Any] | None = None) -> RawRecording:
    """Read every sample of a bag as it stands, in the order in which it was recorded.

    Args:
        path: Bag directory (or a single .mcap or .db3 file).
        note: Recording note for a bag that carries none; its entries go before those in the bag.

    Raises:
        RecordingError: This is no bag, it is cut off, it has no usable note, or a topic that
            the analysis reads has another message type.
    """
    path = Path(path)
    if not path.exists():
        raise RecordingError(f'{path}: no such file or directory')
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        raise _not_finished(path) if _storage_files(path) else _no_bag(path)
    if path.is_file() and path.suffix not in ('.mcap', '.db3'):
        raise _no_bag(path)
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            return _read_open(path, reader, note)
    except RecordingError:
        raise
    except Exception as error:  # every library below has its own kinds: translated here
        if _needs_recovery(path):
            raise _not_finished(path) from error
        msg = f'{path}: not a readable rosbag2 recording ({type(error).__name__}: {error})'
        raise RecordingError(msg) from error


def _storage_files(path: Path) -> list[Path]:
    return [f for f in path.iterdir() if f.name.endswith(('.mcap', '.db3', '.zstd'))]


def _no_bag(path: Path) -> RecordingError:
    return RecordingError(
        f'{path}: not a bag; a directory with metadata.yaml and .mcap or .db3 files is needed'
    )


def _not_finished(path: Path) -> RecordingError:
    return RecordingError(
        f'{path}: the recording was cut off (its index or metadata.yaml is missing); '
        f'rebuild it with: python3 -m cg_sysid.recover {path}'
    )


def _needs_recovery(path: Path) -> bool:
    """Whether an MCAP file of the bag lacks its closing magic, as after a kill."""
    files = [path] if path.is_file() else _storage_files(path)
    for file in files:
        if file.suffix != '.mcap':
            continue
        with file.open('rb') as stream:
            head = stream.read(8)
            stream.seek(max(0, file.stat().st_size - 8))
            if head == MCAP_MAGIC and stream.read(8) != MCAP_MAGIC:
                return True
    return False


MCAP_MAGIC = b'\x89MCAP0\r\n'


def _read_open(
    path: Path, reader: AnyReader, note: Mapping[str, Any] | None
) -> RawRecording:
    """The body of `read_raw`, on an open reader."""
    if reader.message_count == 0:
        raise RecordingError(f'{path}: empty; the bag holds no message')
    merged_note = {**_read_note(path, reader), **(note or {})}
    mechanism = _mechanism_of(path, merged_note)
    topics = mechanism.topics
    used = [c for c in reader.connections if c.topic in topics]
    for connection in used:
        expected = topics[connection.topic].msgtype
        if connection.msgtype != expected:
            msg = (f'{path}: topic {connection.topic} has type {connection.msgtype}; '
                   f'{expected} is needed')
            raise RecordingError(msg)
    samples: dict[str, list[tuple[int, int, dict[str, float]]]] = {c.topic: [] for c in used}
    for connection, log_ns, data in reader.messages(connections=used) if used else ():
        message = reader.deserialize(data, connection.msgtype)
        rows = samples[connection.topic]
        try:
            values = channels.extract(message, topics[connection.topic])
        except ValueError as error:
            msg = f'{path}: topic {connection.topic}, sample {len(rows)}: {error}'
            raise RecordingError(msg) from None
        stamp = message.header.stamp
        rows.append((stamp.sec * NS_PER_S + stamp.nanosec, log_ns, values))
    others = {
        c.topic: c.msgtype
        for c in reader.connections
        if c.topic not in topics and c.topic != NOTE_TOPIC
    }
    return RawRecording(
        path=str(path),
        note=merged_note,
        mechanism=mechanism.name,
        topics={name: _raw_topic(topics[name], rows) for name, rows in samples.items()},
        others=others,
    )


def _raw_topic(topic: Topic, rows: list[tuple[int, int, dict[str, float]]]) -> RawTopic:
    nan = float('nan')
    values, absent = {}, {}
    for channel in topic.channels:
        column = [row[2].get(channel.name) for row in rows]
        if all(value is None for value in column):
            continue
        absent[channel.name] = np.array([value is None for value in column], dtype=bool)
        values[channel.name] = np.array([nan if v is None else v for v in column], dtype=float)
    return RawTopic(
        name=topic.name,
        msgtype=topic.msgtype,
        stamp_ns=np.array([row[0] for row in rows], dtype=np.int64),
        log_ns=np.array([row[1] for row in rows], dtype=np.int64),
        values=values,
        absent=absent,
    )


def _read_note(path: Path, reader: AnyReader) -> dict[str, Any]:
    """The recording note of a bag; empty if it carries none."""
    connections = [c for c in reader.connections if c.topic == NOTE_TOPIC]
    for connection in connections:
        if connection.msgtype != STRING:
            msg = f'{path}: topic {NOTE_TOPIC} has type {connection.msgtype}; {STRING} is needed'
            raise RecordingError(msg)
    messages = reader.messages(connections=connections) if connections else ()
    texts = {reader.deserialize(data, connection.msgtype).data for connection, _, data in messages}
    if len(texts) > 1:
        msg = f'{path}: {len(texts)} different notes on {NOTE_TOPIC}; a bag is one experiment'
        raise RecordingError(msg)
    return parse_note(texts.pop(), f'{path}: {NOTE_TOPIC}') if texts else {}


def parse_note(text: str, where: str) -> dict[str, Any]:
    """A recording note from its YAML text.

    Args:
        text: YAML.
        where: What to name in an error.

    Raises:
        RecordingError: No YAML mapping, or a format that this version does not know.
    """
    try:
        note = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise RecordingError(f'{where}: the recording note is no valid YAML: {error}') from None
    if not isinstance(note, dict):
        msg = f'{where}: the recording note is a {type(note).__name__}; a mapping is needed'
        raise RecordingError(msg)
    if note.get('format', NOTE_FORMAT) != NOTE_FORMAT:
        msg = f'{where}: note of format {note["format"]!r}; this version reads {NOTE_FORMAT!r}'
        raise RecordingError(msg)
    return note


def _mechanism_of(path: Path, note: Mapping[str, Any]) -> channels.Mechanism:
    if 'mechanism' not in note:
        msg = (f'{path}: nothing says which mechanism was recorded; put a note with '
               f'`mechanism` and `setup` on {NOTE_TOPIC} or give one (--note note.yaml); '
               f'mechanisms are {", ".join(channels.MECHANISMS)}')
        raise RecordingError(msg)
    try:
        return channels.mechanism(note['mechanism'])
    except ValueError as error:
        raise RecordingError(f'{path}: note: {error}') from None


def to_record(
    raw: RawRecording, torque_topic: str | None = None, shared_row_ns: int = SHARED_ROW_NS
) -> Record:
    """Put a raw recording on one time axis.

    Rows before the first sample of every input are dropped: what acted then is not known.

    Args:
        raw: The recording as read.
        torque_topic: See `read_bag`.
        shared_row_ns: See `read_bag`.

    Raises:
        RecordingError: A topic is missing, holds too few samples, values that are not finite,
            or a time that runs backwards.
    """
    mechanism = channels.mechanism(raw.mechanism)
    setup = raw.setup
    inputs = _cleaned_inputs(raw, mechanism, setup, torque_topic)
    outputs = {}
    for topic in mechanism.outputs:
        if topic.name in raw.topics:
            outputs.update(_clean(raw, topic.name))
    if not outputs:
        wanted = ', '.join(topic.name for topic in mechanism.outputs)
        msg = f'{raw.path}: topic missing: no measurement; at least one of {wanted} is needed'
        raise RecordingError(msg)
    rows = merge_stamps([s for s, _ in (*inputs.values(), *outputs.values())], shared_row_ns)
    held = {c: hold(stamps, values, rows) for c, (stamps, values) in inputs.items()}
    for name in mechanism.input_names:
        held.setdefault(name, np.zeros(len(rows)))
    placed = {c: place(stamps, values, rows) for c, (stamps, values) in outputs.items()}
    known = np.all([~np.isnan(values) for values in held.values()], axis=0)
    if known.sum() < 2:
        msg = f'{raw.path}: {int(known.sum())} row(s) after the first torque sample; need 2'
        raise RecordingError(msg)
    return Record(
        name=raw.name,
        stamp_ns=rows[known],
        inputs={c: v[known] for c, v in held.items()},
        outputs={c: v[known] for c, v in placed.items() if not np.isnan(v[known]).all()},
        mechanism=raw.mechanism,
        setup=setup,
        note=raw.note,
        source=raw.path,
    )


def _cleaned_inputs(
    raw: RawRecording,
    mechanism: channels.Mechanism,
    setup: Setup,
    torque_topic: str | None,
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Input channel -> (stamps, values); empty where no torque can act."""
    chosen = torque_topic or (
        APPLIED_TORQUE if APPLIED_TORQUE in raw.topics else TORQUE_COMMAND
    )
    if chosen not in (APPLIED_TORQUE, TORQUE_COMMAND):
        msg = f'torque_topic is {chosen!r}; allowed: {APPLIED_TORQUE}, {TORQUE_COMMAND}'
        raise ValueError(msg)
    inputs = {}
    for topic in mechanism.extra_inputs:
        if topic.name in raw.topics:
            inputs.update(_clean(raw, topic.name))
    if chosen in raw.topics:
        torques = _clean(raw, chosen)
        missing = [name for name in mechanism.input_names if name not in torques]
        if missing:
            place_name = mechanism.channel(missing[0]).place
            msg = f'{raw.path}: topic {chosen} holds no {place_name}'
            raise RecordingError(msg)
        return {**torques, **inputs}
    if setup.fixture == 'legs_tied' and torque_topic is None:
        return inputs  # with the legs tied a hip torque does no work
    msg = (f'{raw.path}: topic missing: '
           f'{torque_topic or f"{APPLIED_TORQUE} (or {TORQUE_COMMAND})"} is needed; '
           f'the bag has {", ".join([*raw.topics, *raw.others]) or "none"}')
    raise RecordingError(msg)


def _clean(raw: RawRecording, topic_name: str) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Channel -> (stamps, values) of one topic, in order of stamps, repeats dropped."""
    samples = raw.topics[topic_name]
    where = f'{raw.path}: topic {topic_name}'
    mechanism = channels.mechanism(raw.mechanism)
    cleaned = {}
    for name, values in samples.values.items():
        keep = ~samples.absent[name]
        bad = np.flatnonzero(keep & ~np.isfinite(values))
        if len(bad):
            k = int(bad[0])
            since = (samples.stamp_ns[k] - samples.stamp_ns[0]) / NS_PER_S
            msg = (f'{where}: {mechanism.channel(name).place} is {values[k]} at sample {k} '
                   f'(t = {since:.3f} s); {len(bad)} such value(s), only finite ones are allowed')
            raise RecordingError(msg)
        cleaned[name] = _ordered(where, samples.stamp_ns[keep], values[keep])
    if not cleaned:
        raise RecordingError(f'{where}: no value that the analysis reads; it has '
                             f'{len(samples)} message(s)')
    return cleaned


def _ordered(
    where: str, stamps: np.ndarray, values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Samples in strict order of stamps, or an error where order cannot be restored."""
    if len(stamps) < 2:
        raise RecordingError(f'{where}: {len(stamps)} sample(s); at least 2 are needed')
    if np.all(np.diff(stamps) > 0):
        return stamps, values
    first = int(np.flatnonzero(np.diff(stamps) <= 0)[0]) + 1
    at = (stamps[first] - stamps[0]) / NS_PER_S
    order = np.argsort(stamps, kind='stable')
    stamps, values = stamps[order], values[order]
    repeated = np.concatenate([[False], np.diff(stamps) == 0])
    conflicting = np.flatnonzero(repeated[1:] & (np.diff(values) != 0.0))
    stamps, values = stamps[~repeated], values[~repeated]
    spacing = np.diff(stamps)
    moved = len(order) > 1 and np.any(np.diff(order) < 0)
    irregular = moved and spacing.min(initial=0) < REGULAR_AFTER_SORTING * np.median(spacing)
    if len(stamps) < 2 or len(conflicting) or irregular:
        msg = (f'{where}: stamps run backwards or stand still at sample {first} '
               f'(t = {at:.3f} s) and sorting does not restore a regular order; '
               'stamps must increase (`check` shows every place)')
        raise RecordingError(msg)
    return stamps, values


def write_bag(path: str | Path, record: Record, commands: Mapping[str, Any] | None = None) -> Path:
    """Write a record as a rosbag2 directory (MCAP), the recording note first.

    The bag appears at its path only when it is complete. Inputs are written on every row,
    outputs on the rows that have a sample. Log times equal stamps.

    Args:
        path: Directory to create; it must not exist.
        record: What to write. Its `mechanism` and `setup` go into the note.
        commands: Torque channel -> commanded torque in N m by row, shape (N,); written on
            `/torque_command` beside the applied torque.

    Returns:
        The path.

    Raises:
        RecordingError: The path exists already.
    """
    path = Path(path)
    if path.exists():
        raise RecordingError(f'{path}: exists already; recordings are never overwritten')
    path.parent.mkdir(parents=True, exist_ok=True)
    scratch = Path(tempfile.mkdtemp(prefix=f'.{path.name}.', dir=path.parent))
    try:
        # The writer names the file after its directory.
        _write(scratch / path.name, record, dict(commands or {}))
        (scratch / path.name).rename(path)
    except OSError as error:
        raise RecordingError(f'{path}: cannot be written: {error}') from error
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    return path


def _write(path: Path, record: Record, commands: dict[str, Any]) -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    mechanism = channels.mechanism(record.mechanism)
    signals = {**record.inputs, **record.outputs}
    series = [(topic, signals) for topic in mechanism.topics.values()
              if topic.name != TORQUE_COMMAND]
    if commands:
        series.append((mechanism.command, commands))
    first = int(record.stamp_ns[0])
    with Writer(path, version=Writer.VERSION_LATEST, storage_plugin=StoragePlugin.MCAP) as bag:
        connection = bag.add_connection(
            NOTE_TOPIC, STRING, typestore=store, offered_qos_profiles=[LATCHED_QOS]
        )
        text = store.types[STRING](data=note_text(record))
        bag.write(connection, first, store.serialize_cdr(text, STRING))
        messages = []
        for topic, values in series:
            present = {c.name: values[c.name] for c in topic.channels if c.name in values}
            if not present:
                continue
            connection = bag.add_connection(
                topic.name, topic.msgtype, typestore=store, offered_qos_profiles=[SENSOR_QOS]
            )
            rows = np.flatnonzero(~np.all([np.isnan(v) for v in present.values()], axis=0))
            messages += [(int(record.stamp_ns[k]), k, connection, topic, present) for k in rows]
        messages.sort(key=lambda entry: entry[0])
        for stamp, k, connection, topic, present in messages:
            row = {name: float(v[k]) for name, v in present.items() if not np.isnan(v[k])}
            message = _compose(store, topic, stamp, row)
            bag.write(connection, stamp, store.serialize_cdr(message, topic.msgtype))


def note_text(record: Record) -> str:
    """The recording note of a record, as YAML."""
    note = {
        'format': NOTE_FORMAT,
        **record.note,
        'mechanism': record.mechanism,
        'setup': record.setup.to_dict(),
    }
    return yaml.safe_dump(note, sort_keys=False, allow_unicode=True)


def _compose(store: Any, topic: Topic, stamp_ns: int, row: Mapping[str, float]) -> Any:
    """The message of one topic that carries the given channel values."""
    types = store.types
    sec, nanosec = divmod(stamp_ns, NS_PER_S)
    header = types['std_msgs/msg/Header'](
        stamp=types['builtin_interfaces/msg/Time'](sec=sec, nanosec=nanosec),
        frame_id=topic.frame_id,
    )
    if topic.msgtype == IMU:
        return _compose_imu(types, header, topic, row)
    present = [c for c in topic.channels if c.name in row]
    fields = {
        name: np.array([row[c.name] for c in present if c.field == name], dtype=float)
        for name in ('position', 'velocity', 'effort')
    }
    return types[topic.msgtype](header=header, name=[c.joint for c in present], **fields)


def _compose_imu(types: Any, header: Any, topic: Topic, row: Mapping[str, float]) -> Any:
    """An Imu message; what has no value is declared absent by covariance[0] = -1."""
    by_field = {c.field: row[c.name] for c in topic.channels if c.name in row}
    absent = np.array([-1.0, *[0.0] * 8])
    known = np.zeros(9)
    x, y, z, w = channels.quaternion_from_pitch(by_field.get('pitch', 0.0))
    vector = types['geometry_msgs/msg/Vector3']
    return types[IMU](
        header=header,
        orientation=types['geometry_msgs/msg/Quaternion'](x=x, y=y, z=z, w=w),
        orientation_covariance=known if 'pitch' in by_field else absent,
        angular_velocity=vector(x=0.0, y=by_field.get('pitch_rate', 0.0), z=0.0),
        angular_velocity_covariance=known if 'pitch_rate' in by_field else absent,
        linear_acceleration=vector(x=0.0, y=0.0, z=0.0),
        linear_acceleration_covariance=absent,
    )


def _qos(durability: QosDurability, depth: int) -> Qos:
    unlimited = QosTime(sec=9_223_372_036, nsec=854_775_807)  # as rosbag2 writes it
    return Qos(
        history=QosHistory.KEEP_LAST,
        depth=depth,
        reliability=QosReliability.RELIABLE,
        durability=durability,
        deadline=unlimited,
        lifespan=unlimited,
        liveliness=QosLiveliness.AUTOMATIC,
        liveliness_lease_duration=unlimited,
        avoid_ros_namespace_conventions=False,
    )


SENSOR_QOS = _qos(QosDurability.VOLATILE, 10)
LATCHED_QOS = _qos(QosDurability.TRANSIENT_LOCAL, 1)
