"""Writing of records as rosbag2 directories, by `rosbags`, with no ROS installed."""

import shutil
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.typesys import Stores, get_typestore

from cg_interfaces import channels
from cg_interfaces.channels import IMU, STRING, Topic
from cg_interfaces.stamps import NS_PER_S
from cg_interfaces.topics import EXPERIMENT, TORQUE_COMMAND
from cg_sysid.errors import RecordingError
from cg_sysid.records.bag_file import BagWriter
from cg_sysid.records.raw import NOTE_FORMAT
from cg_sysid.records.record import Record


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
    mechanism = record.mechanism
    signals = {**record.inputs, **record.outputs}
    series = [
        (topic, signals) for topic in mechanism.topics.values() if topic.name != TORQUE_COMMAND
    ]
    if told := record.note.get('position_control'):
        assert mechanism.told is not None
        series = [s for s in series if s[0].name != mechanism.torque.name]
        series.append((replace(mechanism.told, name=told), signals))
    if commands:
        series.append((mechanism.command, commands))
    first = int(record.stamp_ns[0])
    with BagWriter(path) as bag:
        connection = bag.add_connection(
            EXPERIMENT, STRING, typestore=store, offered_qos_profiles=[LATCHED_QOS]
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
        'mechanism': record.mechanism.name,
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
    joints = list(dict.fromkeys(c.joint for c in present))
    fields = {}
    for name in ('position', 'velocity', 'effort'):
        of = {c.joint: row[c.name] for c in present if c.field == name}
        # As many values as names, or none; one that is missing is NaN, as in ros2_control.
        values = [of.get(joint, np.nan) for joint in joints] if of else []
        fields[name] = np.array(values, dtype=float)
    return types[topic.msgtype](header=header, name=joints, **fields)


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
