"""Bags: rosbag2 recordings in and out, by `rosbags`, with no ROS installed.

Reading goes in two steps. `read_raw` takes every sample as it stands in the file, so that
`check.py` sees each fault before anything is repaired. `to_record` puts the samples on one time
axis. `read_bag` does both; `write_bag` goes the other way.
"""

from collections.abc import Collection, Mapping
from dataclasses import replace
from math import isnan
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from cg_description.reading import parse_yaml, path_of, read_text, shown
from cg_description.schema import Mapping as Form
from cg_interfaces import channels
from cg_interfaces.channels import STRING, TRAJECTORY_STATE, Topic
from cg_interfaces.stamps import NS_PER_S
from cg_interfaces.topics import EXPERIMENT, JOINT_STATES
from cg_sysid.errors import RecordingError
from cg_sysid.records.alignment import to_record
from cg_sysid.records.bag_integrity import no_bag, require_sound, unfinished
from cg_sysid.records.bag_writer import write_bag
from cg_sysid.records.raw import NOTE, RawRecording, RawTopic
from cg_sysid.records.record import SHARED_ROW_NS, Record

__all__ = [
    'RawRecording',
    'RawTopic',
    'load_note',
    'no_bag',
    'parse_note',
    'read_bag',
    'read_raw',
    'to_record',
    'write_bag',
]

LONGEST_REASON = 300  # characters of what a library says


def read_bag(
    path: str | Path,
    note: Mapping[str, Any] | None = None,
    torque_topic: str | None = None,
    shared_row_ns: int = SHARED_ROW_NS,
    mechanism: channels.Mechanism | None = None,
) -> Record:
    """Read a bag to a record.

    Args:
        path: Bag directory (or a single .mcap or .db3 file).
        note: Recording note for a bag that carries none; its entries go before those in the bag.
        torque_topic: `/applied_torque` or `/torque_command`; the default is the applied torque
            where the bag has it, else the command, else the effort on `/joint_states`.
        shared_row_ns: Samples of different topics this close in ns share a row.
        mechanism: See `read_raw`.

    Raises:
        RecordingError: The bag cannot be used.
    """
    return to_record(read_raw(path, note, mechanism), torque_topic, shared_row_ns)


def read_raw(
    path: str | Path,
    note: Mapping[str, Any] | None = None,
    mechanism: channels.Mechanism | None = None,
) -> RawRecording:
    """Read every sample of a bag as it stands, in the order in which it was recorded.

    Args:
        path: Bag directory (or a single .mcap or .db3 file).
        note: Recording note for a bag that carries none; its entries go before those in the bag.
        mechanism: What was recorded where the note does not say; and where it names this one,
            which need not be in the table (`channels.interface` makes it of a model's body).

    Raises:
        RecordingError: This is no bag, it is cut off, it has no usable note, or a topic that
            the analysis reads has another message type.
    """
    path = path_of(path, RecordingError)
    if not path.exists():
        raise RecordingError(f'{path}: no such file or directory')
    if path.is_dir() and not (path / 'metadata.yaml').exists():
        raise unfinished(path)
    if path.is_file() and path.suffix not in ('.mcap', '.db3'):
        raise no_bag(path)
    require_sound(path)
    try:
        with AnyReader([path], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
            return _read_open(path, reader, note, mechanism)
    except RecordingError:
        raise
    except Exception as error:  # every library below has its own kinds: translated here
        what = ' '.join(f'{type(error).__name__}: {error}'.split())[:LONGEST_REASON]
        raise RecordingError(f'{path}: not a readable rosbag2 recording ({what})') from error


def _read_open(
    path: Path,
    reader: AnyReader,
    note: Mapping[str, Any] | None,
    of_model: channels.Mechanism | None,
) -> RawRecording:
    """The body of `read_raw`, on an open reader."""
    if reader.message_count == 0:
        raise RecordingError(f'{path}: empty; the bag holds no message')
    for name in (name for c in reader.connections for name in (c.topic, c.msgtype)):
        if not isinstance(name, str):
            msg = f'{path}: metadata.yaml calls a topic or its type {shown(name)}; expected a text'
            raise RecordingError(msg)
    merged_note = {**_read_note(path, reader), **(note or {})}
    mechanism = _mechanism_of(path, merged_note, of_model)
    topics = _topics_in(path, {c.topic: c.msgtype for c in reader.connections}, merged_note,
                        mechanism)  # fmt: skip
    gains = _effort_gains(path, merged_note, mechanism)
    used = [c for c in reader.connections if c.topic in topics]
    for connection in used:
        expected = topics[connection.topic].msgtype
        if connection.msgtype != expected:
            msg = (
                f'{path}: topic {connection.topic} has type {connection.msgtype}; '
                f'{expected} is needed'
            )
            raise RecordingError(msg)
    samples: dict[str, list[tuple[int, int, dict[str, float]]]] = {c.topic: [] for c in used}
    for connection, log_ns, data in reader.messages(connections=used) if used else ():
        message: Any = reader.deserialize(data, connection.msgtype)
        rows = samples[connection.topic]
        try:
            values = channels.extract(message, topics[connection.topic])
        except ValueError as error:
            msg = f'{path}: topic {connection.topic}, sample {len(rows)}: {error}'
            raise RecordingError(msg) from None
        if connection.topic == JOINT_STATES:
            values = {name: gains.get(name, 1.0) * value for name, value in values.items()}
        stamp = message.header.stamp
        rows.append((stamp.sec * NS_PER_S + stamp.nanosec, log_ns, values))
    may_fill = JOINT_STATES, merged_note.get('position_control', '')
    others = {
        c.topic: c.msgtype
        for c in reader.connections
        if c.topic not in topics and c.topic != EXPERIMENT
    }
    return RawRecording(
        path=str(path),
        note=merged_note,
        mechanism=mechanism,
        topics={name: _raw_topic(topics[name], rows, may_fill) for name, rows in samples.items()},
        others=others,
    )


def _topics_in(
    path: Path, recorded: Mapping[str, str], note: Mapping[str, Any],
    mechanism: channels.Mechanism,
) -> dict[str, Topic]:  # fmt: skip
    """The topics to read, by name, of those recorded (with their message types)."""
    if name := note.get('position_control'):
        if mechanism.told is None:
            msg = f'{path}: note: position_control: drives of a {mechanism.name} are told torques'
            raise RecordingError(msg)
        torques = mechanism.torque.name, mechanism.command.name
        found = {n: topic for n, topic in mechanism.topics.items() if n not in torques}
        controller = recorded.get(name) == TRAJECTORY_STATE
        kind = TRAJECTORY_STATE if controller else mechanism.told.msgtype
        return {**found, name: replace(mechanism.told, name=name, msgtype=kind)}
    has_torque = recorded.keys() & {mechanism.torque.name, mechanism.command.name}
    return mechanism.topics if has_torque else mechanism.topics_with_effort


def _raw_topic(
    topic: Topic, rows: list[tuple[int, int, dict[str, float]]], may_fill: Collection[str]
) -> RawTopic:
    nan = float('nan')
    values, absent = {}, {}
    for channel in topic.channels:
        column = [row[2].get(channel.name) for row in rows]
        # What a joint does not report, ros2_control's broadcaster fills with NaN throughout.
        filled = topic.name in may_fill and channel.field != 'position'
        if all(value is None or (filled and isnan(value)) for value in column):
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
    connections = [c for c in reader.connections if c.topic == EXPERIMENT]
    for connection in connections:
        if connection.msgtype != STRING:
            msg = f'{path}: topic {EXPERIMENT} has type {connection.msgtype}; {STRING} is needed'
            raise RecordingError(msg)
    messages = reader.messages(connections=connections) if connections else ()
    texts = set()
    for connection, _, data in messages:
        message: Any = reader.deserialize(data, connection.msgtype)
        texts.add(message.data)
    if len(texts) > 1:
        msg = f'{path}: {len(texts)} different notes on {EXPERIMENT}; a bag is one experiment'
        raise RecordingError(msg)
    return parse_note(texts.pop(), f'{path}: {EXPERIMENT}') if texts else {}


def parse_note(text: str, where: str) -> dict[str, Any]:
    """A recording note from its YAML text, as a bag carries it: other keys than ours are kept.

    Args:
        text: YAML.
        where: What to name in an error.

    Raises:
        RecordingError: No YAML mapping, a wrong value, or a format that this version does not
            know.
    """
    return _checked_note(text, where, replace(NOTE, further=True))


def load_note(path: str | Path) -> dict[str, Any]:
    """A recording note from a YAML file that somebody wrote; its keys are those of the docs.

    Raises:
        RecordingError: As `parse_note`, or an unknown key.
    """
    return _checked_note(read_text(path, RecordingError), str(path), NOTE)


def _checked_note(text: str, where: str, schema: Form) -> dict[str, Any]:
    note = parse_yaml(text, where, RecordingError)
    return schema.of(note, where, RecordingError)


def _effort_gains(
    path: Path, note: Mapping[str, Any], mechanism: channels.Mechanism
) -> dict[str, float]:
    """Channel -> what makes a torque of a recorded effort, such as of a motor's current."""
    gains = note.get('effort_gain') or {}
    driven = {c.joint: c.name for c in mechanism.torque.channels}
    for joint, gain in gains.items():
        if joint not in driven:
            msg = f'{path}: note: effort_gain of {joint!r}; joints with a drive: '
            raise RecordingError(msg + ', '.join(driven))
        if gain == 0:
            msg = f'{path}: note: effort_gain of {joint!r} is 0; any other number is allowed'
            raise RecordingError(msg)
    return {driven[joint]: gain for joint, gain in gains.items()}


def _mechanism_of(
    path: Path, note: Mapping[str, Any], of_model: channels.Mechanism | None
) -> channels.Mechanism:
    name = note.get('mechanism')
    if of_model is not None and name in (None, '', of_model.name):
        return of_model
    if not name:
        msg = (
            f'{path}: nothing says which mechanism was recorded; put a note with '
            f'`mechanism` and `setup` on {EXPERIMENT} or give one (--note note.yaml); '
            f'mechanisms are {", ".join(channels.MECHANISMS)}'
        )
        raise RecordingError(msg)
    try:
        return channels.mechanism(name)
    except ValueError as error:
        raise RecordingError(f'{path}: note: {error}') from None
