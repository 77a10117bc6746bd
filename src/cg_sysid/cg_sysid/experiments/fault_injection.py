"""Faults put into sound recordings, to measure how surely the check finds them.

Each fault is a function from a recording to a spoilt one, with the place where it sets in. The
recordings are those of the simulated machine (rehearse.py) as a recorder would have seen them.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from cg_interfaces.stamps import NS_PER_S
from cg_sysid.experiments.synthetic import START_NS
from cg_sysid.records.raw import RawRecording, RawTopic
from cg_sysid.records.record import Record

ARRIVAL_S = 1e-4  # scale of the delays between stamp and arrival
ALL = 'all'

Fault = Callable[[RawRecording], RawRecording]


def as_recorded(record: Record, seed: int = 0) -> RawRecording:
    """A record as a recorder would have received it, topic by topic, with times of arrival.

    Args:
        record: The record; its stamps may begin at 0.
        seed: Of the delays of arrival.
    """
    rng = np.random.default_rng(seed)
    known = record.mechanism
    signals = {**record.inputs, **record.outputs}
    stamp = START_NS + record.stamp_ns
    topics = {}
    for topic in (known.torque, *known.outputs):
        values = {c.name: np.array(signals[c.name]) for c in topic.channels if c.name in signals}
        if not values:
            continue
        delay = np.rint(rng.gamma(2.0, ARRIVAL_S, len(stamp)) * NS_PER_S).astype(np.int64)
        absent = {name: np.zeros(len(stamp), bool) for name in values}
        arrival = np.maximum.accumulate(stamp + delay)
        topics[topic.name] = RawTopic(
            topic.name, topic.msgtype, stamp.copy(), arrival, values, absent
        )
    note = {
        'sensor_zeros': {},
        'zeroed_at': '2011-03-13T07:00:00Z',
        'model_file': 'none.yaml',
        'model_sha256': '0' * 64,
        'software': 'rehearsal',
        **record.note,
    }
    return RawRecording(record.name, note, record.mechanism, topics)


def without_arrivals(raw: RawRecording) -> RawRecording:
    """The recording as a tool writes it that knows no times of arrival: they equal the stamps."""
    topics = {name: replace(t, log_ns=t.stamp_ns) for name, t in raw.topics.items()}
    return replace(raw, topics=topics)


def shifted(channel: str, size: float, since: float) -> Fault:
    """A zero that moves by `size`, in the unit of the channel, `since` s after the start."""
    return _values((channel,), lambda v, time: v + size * (time > since))


def mirrored(channels: Sequence[str], since: float = -1.0) -> Fault:
    """Channels with the opposite sign from an instant on; from the start by default."""
    return _values(channels, lambda v, time: np.where(time > since, -v, v))


def clipped(channel: str, share: float) -> Fault:
    """A channel that cannot leave the range in which it is for this share of the time."""

    def clip(values: np.ndarray, time: np.ndarray) -> np.ndarray:
        limit = float(np.quantile(np.abs(values), share))
        return np.clip(values, -limit, limit)

    return _values((channel,), clip)


def decimated(topic: str, ratio: int, since: float, honest: bool = True) -> Fault:
    """Every `ratio`-th sample only from an instant on; stamps that know of it, or that do not."""

    def keep(count: int, time: np.ndarray) -> np.ndarray:
        first = int(np.searchsorted(time, since))
        return np.r_[0:first, first:count:ratio]

    return _samples(topic, keep, honest)


def thinned(topic: str, share: float, seed: int, honest: bool = True) -> Fault:
    """A share of the samples lost at random."""

    def keep(count: int, time: np.ndarray) -> np.ndarray:
        return np.flatnonzero(np.random.default_rng(seed).random(count) > share)

    return _samples(topic, keep, honest)


def interrupted(topic: str, length: float, since: float, honest: bool = True) -> Fault:
    """No samples for `length` s."""

    def keep(count: int, time: np.ndarray) -> np.ndarray:
        return np.flatnonzero((time < since) | (time >= since + length))

    return _samples(topic, keep, honest)


def jumped(topic: str, size: float, since: float) -> Fault:
    """Stamps that jump by `size` s, while the samples go on."""

    def fault(raw: RawRecording) -> RawRecording:
        for name in _names(raw, topic):
            old = raw.topics[name]
            later = np.where(_time(old) > since, round(size * NS_PER_S), 0)
            raw = _with(raw, replace(old, stamp_ns=old.stamp_ns + later))
        return raw

    return fault


def _values(
    channels: Sequence[str], change: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> Fault:
    def fault(raw: RawRecording) -> RawRecording:
        for topic in raw.topics.values():
            values = {
                c: change(v, _time(topic)) if c in channels else v for c, v in topic.values.items()
            }
            raw = _with(raw, replace(topic, values=values))
        return raw

    return fault


def _samples(topic: str, keep: Callable[[int, np.ndarray], np.ndarray], honest: bool) -> Fault:
    def fault(raw: RawRecording) -> RawRecording:
        for name in _names(raw, topic):
            old = raw.topics[name]
            index = keep(len(old), _time(old))
            raw = _with(
                raw,
                replace(
                    old,
                    stamp_ns=old.stamp_ns[index] if honest else old.stamp_ns[: len(index)],
                    log_ns=old.log_ns[index],
                    values={c: v[index] for c, v in old.values.items()},
                    absent={c: v[index] for c, v in old.absent.items()},
                ),
            )
        return raw

    return fault


def _names(raw: RawRecording, topic: str) -> list[str]:
    return list(raw.topics) if topic == ALL else [topic]


def _time(topic: RawTopic) -> np.ndarray:
    return (topic.stamp_ns - topic.stamp_ns[0]) / NS_PER_S


def _with(raw: RawRecording, topic: RawTopic) -> RawRecording:
    return replace(raw, topics={**raw.topics, topic.name: topic})
