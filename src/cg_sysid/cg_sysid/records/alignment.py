"""Alignment: the samples of a raw recording on one time axis.

What is harmless is repaired (a repeated message, two messages that overtook each other, a clock
that jumped, a few lost samples of the torque); the rest is refused with one message.
"""

from collections.abc import Sequence

import numpy as np

from cg_dynamics.rig import Setup
from cg_interfaces import channels
from cg_interfaces.stamps import NS_PER_S
from cg_interfaces.topics import APPLIED_TORQUE, JOINT_STATES, TORQUE_COMMAND
from cg_sysid.errors import RecordingError
from cg_sysid.records.clock import mend_clocks
from cg_sysid.records.raw import RawRecording
from cg_sysid.records.record import SHARED_ROW_NS, Record, hold, merge_stamps, place
from cg_sysid.records.torque_gaps import fill_torque

REGULAR_AFTER_SORTING = 0.3  # smallest spacing after sorting over the median, [1]


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
    mechanism, setup = raw.mechanism, raw.setup
    raw, _ = mend_clocks(raw)
    inputs = _cleaned_inputs(raw, mechanism, setup, torque_topic)
    outputs = {}
    for topic in mechanism.outputs:
        if topic.name in raw.topics:
            outputs.update(_clean(raw, topic.name, mechanism.output_names))
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
        mechanism=mechanism,
        setup=setup,
        note=raw.note,
        source=raw.note.get('recording') or raw.path,
    )


def _cleaned_inputs(
    raw: RawRecording,
    mechanism: channels.Mechanism,
    setup: Setup,
    torque_topic: str | None,
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Input channel -> (stamps, values); empty where no torque can act."""
    if torque_topic not in (None, APPLIED_TORQUE, TORQUE_COMMAND):
        msg = f'torque_topic is {torque_topic!r}; allowed: {APPLIED_TORQUE}, {TORQUE_COMMAND}'
        raise ValueError(msg)
    chosen = torque_topic or raw.torque_topic
    inputs = _told(raw) if raw.told else {}
    for topic in mechanism.extra_inputs:
        if topic.name in raw.topics:
            inputs.update(_clean(raw, topic.name, mechanism.extra_input_names))
    if raw.told:
        return inputs
    if chosen in raw.topics:
        torques = _clean(raw, chosen, mechanism.input_names)
        missing = [name for name in mechanism.input_names if name not in torques]
        if missing:
            place_name = mechanism.channel(missing[0]).place
            msg = f'{raw.path}: topic {chosen} holds no {place_name}'
            raise RecordingError(msg)
        filled = {name: fill_torque(*samples) for name, samples in torques.items()}
        return {**filled, **inputs}
    if setup.fixture == 'legs_tied' and torque_topic is None:
        return inputs  # with the legs tied a hip torque does no work
    effort = f', or effort on {JOINT_STATES}' if JOINT_STATES in mechanism.topics else ''
    msg = (
        f'{raw.path}: topic missing: '
        f'{torque_topic or f"{APPLIED_TORQUE} (or {TORQUE_COMMAND}{effort})"} is needed; '
        f'the bag has {", ".join([*raw.topics, *raw.others]) or "none"}'
    )
    raise RecordingError(msg)


def _told(raw: RawRecording) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """What drives were told that follow positions; rates and torques are 0 where none were."""
    known, told = raw.mechanism, raw.told
    if told not in raw.topics:
        has = ', '.join([*raw.topics, *raw.others]) or 'none'
        msg = f'{raw.path}: topic missing: position_control in the note names {told}; '
        raise RecordingError(f'{msg}the bag has {has}')
    found = _clean(raw, told, (*known.told_names, *known.input_names))
    for name in (*known.told_names, *known.input_names):
        if name in found:
            continue
        channel = known.channel(name)
        if channel.field == 'position':
            raise RecordingError(f'{raw.path}: topic {told} holds no {channel.place}')
        stamps = raw.topics[told].stamp_ns
        found[name] = np.sort(stamps)[:1], np.zeros(1)
    return found


def _clean(
    raw: RawRecording, topic_name: str, names: Sequence[str]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Channel -> (stamps, values) of one topic, in order of stamps, repeats dropped."""
    samples = raw.topics[topic_name]
    where = f'{raw.path}: topic {topic_name}'
    cleaned = {}
    for name, values in samples.values.items():
        if name not in names:
            continue
        keep = ~samples.absent[name]
        bad = np.flatnonzero(keep & ~np.isfinite(values))
        if len(bad):
            k = int(bad[0])
            since = (samples.stamp_ns[k] - samples.stamp_ns[0]) / NS_PER_S
            msg = (
                f'{where}: {raw.mechanism.channel(name).place} is {values[k]} at sample {k} '
                f'(t = {since:.3f} s); {len(bad)} such value(s), only finite ones are allowed'
            )
            raise RecordingError(msg)
        cleaned[name] = _ordered(where, samples.stamp_ns[keep], values[keep])
    if not cleaned:
        wanted = ', '.join(raw.mechanism.channel(name).place for name in names)
        raise RecordingError(
            f'{where}: no value that the analysis reads ({wanted}); it has {len(samples)} '
            'message(s)'
        )
    return cleaned


def _ordered(where: str, stamps: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
    if len(stamps) < 2:
        raise RecordingError(f'{where}: every sample has the same stamp; time must go on')
    spacing = np.diff(stamps)
    moved = bool(np.any(np.diff(order) < 0))
    irregular = moved and spacing.min() < REGULAR_AFTER_SORTING * np.median(spacing)
    if len(conflicting) or irregular:
        msg = (
            f'{where}: stamps run backwards or stand still at sample {first} '
            f'(t = {at:.3f} s) and sorting does not restore a regular order; '
            'stamps must increase (`check` shows every place)'
        )
        raise RecordingError(msg)
    return stamps, values
