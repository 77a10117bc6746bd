"""A recording on disk: from the first message to an ordinary bag. Pure; no ROS.

While it runs, a recording is a directory that holds a journal (journal.py). `close` turns it
into an ordinary rosbag2 directory; `recover.py` does the same for one that was never closed.

A recording that starts while data already flow hears the topics one after the other. Everything
is written, and the journal notes where the last of the expected topics began: the bag begins
there, unless all of them began with the same stamp.
"""

import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rosbags.typesys import Stores, get_typestore

from cg_dynamics.rig import STANCES
from cg_interfaces import topics
from cg_interfaces.channels import STRING, mechanism
from cg_interfaces.settings import Settings, setting
from cg_interfaces.stamps import stamp_of
from cg_interfaces.topics import EXPERIMENT
from cg_sysid.records.journal import Journal
from cg_sysid.records.recover import JOURNAL_NAME, Recovered, recover

SAME_CLOCK_NS = 10_000_000_000  # stamps this near to the receipt are of the recorder's clock
WRENCH = 'geometry_msgs/msg/WrenchStamped'
EXTRA_TOPICS = {
    'compass_gait': {topics.FOOT_CONTACT.format(leg=leg): WRENCH for leg in STANCES},
}
TYPESTORE = get_typestore(Stores.ROS2_JAZZY)


@dataclass(frozen=True)
class RecorderSettings(Settings):
    """Parameters of the recorder node."""

    bag: str = setting('', 'directory to write, which must not exist yet')
    mechanism: str = setting('compass_gait', 'whose topics to record')
    also: tuple[str, ...] = setting((), 'further topics, each as name:type')
    time: str = setting(
        'receipt',
        'log time of a message: when it was received, or its own stamp (lock-step)',
        choices=('receipt', 'stamp'),
    )
    patience: float = setting(
        5.0,
        'longest wait, from the first sample on, for topics that have not begun',
        unit='s',
        minimum=0.0,
    )
    depth: int = setting(
        2000, 'messages of one topic that may wait to be stored', minimum=10, maximum=100000
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        for entry in self.also:
            if entry.count(':') != 1:
                raise ValueError(f'also: {entry!r} is not of the form /topic:package/msg/Type')


def topics_to_record(settings: RecorderSettings) -> dict[str, str]:
    """Topic name -> message type of what the settings ask for.

    Raises:
        ValueError: A message type is unknown.
    """
    topics = {EXPERIMENT: STRING}
    for topic in mechanism(settings.mechanism).topics.values():
        topics[topic.name] = topic.msgtype
    topics |= EXTRA_TOPICS.get(settings.mechanism, {})
    for entry in settings.also:
        name, msgtype = entry.split(':')
        topics[name] = msgtype
    for name, msgtype in topics.items():
        if msgtype not in TYPESTORE.fielddefs:
            raise ValueError(f'{name}: message type {msgtype!r} is not known')
    return topics


def needed_topics(settings: RecorderSettings) -> tuple[str, ...]:
    """Topics that must have a publisher before the recorder calls itself ready."""
    return (EXPERIMENT, *expected_topics(settings))


def expected_topics(settings: RecorderSettings) -> tuple[str, ...]:
    """Topics of which every sample counts: a recording begins when all of them have begun."""
    machine = mechanism(settings.mechanism)
    topics = [machine.torque.name, *(topic.name for topic in machine.outputs)]
    topics += EXTRA_TOPICS.get(settings.mechanism, {})
    if settings.time == 'stamp':
        topics.append(machine.command.name)
    return tuple(topics)


def is_stamped(msgtype: str) -> bool:
    """Whether messages of this type begin with a Header."""
    _, fields = TYPESTORE.fielddefs[msgtype]
    return bool(fields) and fields[0][0] == 'header'


@dataclass
class RecordedTopic:
    """A topic that has delivered at least one message."""

    channel: int
    stamped: bool
    count: int = 0
    newest_ns: int = 0
    first_stamp_ns: int = 0
    first_log_ns: int = 0


class Recording:
    """One bag being written.

    Attributes:
        path: The bag directory.
        messages: Messages stored so far.
        begun: Whether it is known where the bag begins.
    """

    def __init__(
        self,
        path: Path,
        topics: dict[str, str],
        by_stamp: bool,
        expected: tuple[str, ...] = (),
        status: Mapping[str, Any] | None = None,
    ):
        """Create the directory and the journal in it.

        Args:
            path: The bag directory, which must not exist yet.
            topics: Topic name -> message type.
            by_stamp: Log messages at their own stamps instead of their receipt.
            expected: Topics that must have begun where the bag begins.
            status: What else the journal shall hold (journal.py).

        Raises:
            ValueError: There is no path, or something is there already.
        """
        if not str(path) or str(path) == '.':
            raise ValueError('bag is empty; name the directory to write')
        if path.exists():
            raise ValueError(f'{path} exists already; recordings are never overwritten')
        path.mkdir(parents=True)
        self.path = path
        self.messages = 0
        self.begun = False
        self._types = topics
        # Not while samples wait: making a definition takes tens of ms.
        self._definitions = {
            msgtype: TYPESTORE.generate_msgdef(msgtype, ros_version=2)[0]
            for msgtype in sorted(set(topics.values()))
        }
        self._by_stamp = by_stamp
        self._expected = expected
        self._journal = Journal(path / JOURNAL_NAME)
        self._topics: dict[str, RecordedTopic] = {}
        self._waiting: list[tuple[str, bytes]] = []
        self._first_ns: int | None = None
        self._status = {**(status or {}), 'expected': list(expected), 'qos': {}}

    def knows(self, topic: str) -> bool:
        """Whether the topic has been announced."""
        return topic in self._topics

    def announce(self, topic: str, qos_profiles: list[dict[str, Any]]) -> None:
        """Open a channel for the topic, and note the QoS that its publishers offer."""
        msgtype = self._types[topic]
        channel = self._journal.add_channel(topic, msgtype, self._definitions[msgtype])
        self._topics[topic] = RecordedTopic(channel, is_stamped(msgtype))
        self._status['qos'][topic] = qos_profiles
        self._journal.set_status(self._status, 0)

    @property
    def silent(self) -> tuple[str, ...]:
        """Expected topics that have not begun."""
        return tuple(
            name
            for name in self._expected
            if name not in self._topics or self._topics[name].count == 0
        )

    def begin(self, was_ready: bool = False) -> int:
        """Say where the bag begins: where the last of the topics did that are heard by now.

        Everything is kept if nothing can have been missed, because all expected topics began with
        the same stamp while the recorder was ready, or if some are silent: then what there is
        counts.

        Args:
            was_ready: Whether every topic had been matched when the first sample came.

        Returns:
            Where the bag begins in ns; 0 if everything is kept. A stamp where stamps are of the
            recorder's clock, a log time elsewhere.
        """
        expected = [self._topics[name] for name in self._expected if name in self._topics]
        heard = [topic for name, topic in self._topics.items() if name != EXPERIMENT]
        begin_ns, by = 0, 'receipt'
        together = was_ready and len({topic.first_stamp_ns for topic in expected}) == 1
        if expected and not self.silent and not together:
            begin_ns = max(topic.first_log_ns for topic in heard)
            delays = [topic.first_log_ns - topic.first_stamp_ns for topic in heard]
            if max(abs(delay) for delay in delays) < SAME_CLOCK_NS:
                # What a busy machine held up comes in after others that were sent later.
                begin_ns, by = max(topic.first_stamp_ns for topic in heard), 'stamp'
        self.begun = True
        # As a text: not every reader of JSON keeps all digits of an integer.
        self._status |= {'begin_ns': str(begin_ns), 'begin_by': by}
        self._journal.set_status(self._status, begin_ns)
        return begin_ns

    def write(self, topic: str, data: bytes, receipt_ns: int, now: float) -> None:
        """Store one serialised message of an announced topic.

        Args:
            topic: Its name.
            data: The message in CDR.
            receipt_ns: When it came in, in ns of the clock that the bag is to show.
            now: Monotonic time in s.
        """
        recorded = self._topics[topic]
        if recorded.stamped:
            stamp_ns = max(stamp_of(data), 0)
            if self._by_stamp and stamp_ns <= recorded.newest_ns:
                return  # lock-step repeats its first sample until somebody answers
            recorded.newest_ns = max(recorded.newest_ns, stamp_ns)
        elif self._by_stamp:
            if self._first_ns is None:
                # It has no time of its own: it gets that of the first stamped message.
                self._waiting.append((topic, data))
                return
            stamp_ns = self._first_ns
        else:
            stamp_ns = receipt_ns
        if self._by_stamp and self._first_ns is None:
            self._first_ns = stamp_ns
            waiting, self._waiting = self._waiting, []
            for early_topic, early_data in waiting:
                self.write(early_topic, early_data, receipt_ns, now)
        log_ns = stamp_ns if self._by_stamp else receipt_ns
        if recorded.count == 0:
            recorded.first_stamp_ns, recorded.first_log_ns = stamp_ns, log_ns
        self._journal.write(recorded.channel, recorded.count, log_ns, stamp_ns, data)
        self._journal.repeat_if_due(log_ns, now)
        recorded.count += 1
        self.messages += 1

    @property
    def complete_until_ns(self) -> int:
        """Stamp up to which every stamped topic that has spoken is stored; 0 before that."""
        stamps = [topic.newest_ns for topic in self._topics.values() if topic.stamped]
        return min(stamps, default=0)

    def close(self) -> Recovered:
        """End the recording and make it an ordinary bag; nothing recorded leaves nothing."""
        if self.messages == 0 and not self._waiting:
            self._journal.close()
            shutil.rmtree(self.path)
            return Recovered(self.path, 0)
        for topic, data in self._waiting:
            recorded = self._topics[topic]
            self._journal.write(recorded.channel, recorded.count, 0, 0, data)
            recorded.count += 1
        self._journal.close()
        return recover(self.path)
