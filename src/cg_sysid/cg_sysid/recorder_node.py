"""ROS node of the recorder: raw subscriptions into a bag. What is on disk: recorder.py.

A message is written when it comes in. A SIGKILL loses what had not come in; `cg recover
BAG` makes a bag of the rest. SIGINT and SIGTERM close the bag properly.

in    the sensor and torque topics of `mechanism`, /experiment, and those of `also`
out   /recorder/progress
"""

import contextlib
import functools
import importlib
import os
import time

from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from std_msgs.msg import Header

from cg_description.reading import path_of
from cg_interfaces import topics
from cg_interfaces.ros import LATCHED_QOS, SENSOR_QOS, DeclaredSettings, run, to_stamp
from cg_interfaces.topics import EXPERIMENT
from cg_sysid.records.recorder import (
    RecorderSettings,
    Recording,
    expected_topics,
    needed_topics,
    topics_to_record,
)

PROGRESS_TOPIC = topics.RECORDER_PROGRESS
PROGRESS_PERIOD = 0.002  # s
READY_PERIOD = 0.02  # s
SETTLING = 0.5  # s without news after which all publishers are known; nothing waits for it
NICENESS = -15  # far before ordinary work, behind nothing that keeps a machine alive
PARTING = 10  # niceness while a bag is made of what came in: a robot may still stand


class RecorderNode(Node):
    """Records the topics of one machine."""

    linger = 0.1  # s; messages that were sent before the order to stop are still stored

    def __init__(self, **kwargs):
        super().__init__('recorder', **kwargs)
        self.finished = False
        self.exit_status = 0
        settings = DeclaredSettings(self, RecorderSettings).values
        topics = topics_to_record(settings)
        self.expected = expected_topics(settings)
        self.recording = Recording(
            path_of(settings.bag),
            topics,
            settings.time == 'stamp',
            self.expected,
            {'niceness': os.nice(0)},
        )
        self.patience = settings.patience
        self._first_sample_at: float | None = None
        self._was_ready = False
        self._note_heard = False
        self._screen_at = 0.0
        self._scene: list[tuple[int, bool]] = []
        self._scene_at = 0.0
        # Waiting messages of all topics share one thread; the depth rides out a busy machine.
        qos = QoSProfile(depth=settings.depth, reliability=ReliabilityPolicy.RELIABLE)
        self.progress = self.create_publisher(Header, PROGRESS_TOPIC, SENSOR_QOS)
        self._progress = Header(frame_id=self.get_fully_qualified_name())
        self._told_ns = 0
        self._told_at = 0.0
        self.subscriptions_to = {}
        self.needed = needed_topics(settings)
        for topic, msgtype in topics.items():
            self.subscriptions_to[topic] = self.create_subscription(
                message_class(msgtype),
                topic,
                functools.partial(self.on_message, topic),
                LATCHED_QOS if topic == EXPERIMENT else qos,
                raw=True,
            )
        self.get_logger().info(
            f'{self.recording.path}: waiting until all of {", ".join(self.needed)} are heard'
        )

    def on_message(self, topic: str, serialised: bytes) -> None:
        """Store a message."""
        if self.finished:
            return
        try:
            if not self.recording.knows(topic):
                self._begin_topic(topic)
            self.recording.write(topic, serialised, time.time_ns(), time.monotonic())
        except OSError as error:
            self._fail(error)

    def _begin_topic(self, topic: str) -> None:
        self.recording.announce(topic, self._offered_qos(topic))
        if topic == EXPERIMENT:
            self._note_heard = True
        elif self._first_sample_at is None:
            self._first_sample_at = time.monotonic()
            self._was_ready = self._told_at > 0.0
        if self.recording.begun and topic in self.needed:
            self.get_logger().warning(f'{topic} began late')

    def poll(self) -> float:
        """Begin when everything is heard, tell how far the recording has come."""
        now = time.monotonic()
        if self.finished:
            return 0.0
        if not self.recording.begun and now >= self._screen_at:
            self._screen_at = now + READY_PERIOD
            try:
                self._begin_if_heard(now)
            except OSError as error:
                self._fail(error)
                return 0.0
        stored_ns = self.recording.complete_until_ns
        if stored_ns == 0:
            # Until the first sample, a progress of zero says that this recorder hears everything.
            if now > self._told_at + READY_PERIOD and self._note_heard and self._hears_all():
                self._told_at = now
                self.progress.publish(self._progress)
        elif stored_ns != self._told_ns:
            if now < self._told_at + PROGRESS_PERIOD:
                return PROGRESS_PERIOD
            self._told_ns, self._told_at = stored_ns, now
            self._progress.stamp = to_stamp(stored_ns)
            self.progress.publish(self._progress)
        return READY_PERIOD

    def _begin_if_heard(self, now: float) -> None:
        """Once samples come: begin when nothing is missing, or when patience ends."""
        if self._first_sample_at is None:
            return
        missing = list(self.recording.silent)
        if not self._note_heard:
            missing.append(EXPERIMENT)
        missing += [topic for topic in self._unmatched() if topic not in missing]
        waited = now - self._first_sample_at
        if missing and waited < self.patience:
            return
        if not self._settled(now) and waited < self.patience:
            return
        if missing:
            self.recording.begin(self._was_ready)
            self.get_logger().warning(
                f'recording begins after {waited:.3f} s without {", ".join(missing)}; the bag '
                'tells how late they begin'
            )
            return
        begin_ns = self.recording.begin(self._was_ready)
        left_out = '; what came before the last of them began is left out' if begin_ns else ''
        self.get_logger().info(f'all topics are heard, {waited:.3f} s after the first{left_out}')

    def _unmatched(self) -> list[str]:
        """Topics of which a publisher is known that no subscription hears yet."""
        return [
            topic
            for topic, subscription in self.subscriptions_to.items()
            if subscription.get_publisher_count() < self.count_publishers(topic)
        ]

    def _settled(self, now: float) -> bool:
        """Whether no publisher has come and no topic has begun for a while."""
        scene = [
            (self.count_publishers(topic), self.recording.knows(topic))
            for topic in self.subscriptions_to
        ]
        if scene != self._scene:
            self._scene, self._scene_at = scene, now
        return now >= self._scene_at + SETTLING

    def _hears_all(self) -> bool:
        # Asked of the readers: a writer that has matched a reader may not be matched by it yet.
        return all(self.subscriptions_to[topic].get_publisher_count() for topic in self.needed)

    def _fail(self, error: OSError) -> None:
        path, why = self.recording.path, error.strerror or error
        self.get_logger().error(f'{path}: recording stopped: {why}; what came before is kept')
        self.finished, self.exit_status = True, 1

    def _offered_qos(self, topic: str) -> list[dict]:
        return [qos_entry(info.qos_profile) for info in self.get_publishers_info_by_topic(topic)]

    def close(self) -> None:
        """Make the recording an ordinary bag."""
        # Somebody may have given the robot's nodes real-time priority, where niceness counts for
        # nothing: then this would keep a processor from the loop that still balances.
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
        try:
            result = self.recording.close()
        except (ValueError, OSError) as error:
            path, log = self.recording.path, self.get_logger()
            if self.exit_status:  # the disk that stopped the recording is still full
                log.warning(f'{path} is no bag yet: make room, then `cg recover {path}`')
            else:
                log.error(f'{path}: {error}; `cg recover {path}` makes a bag of what there is')
            self.exit_status = 1
            return
        if result.messages == 0:
            self.get_logger().warning('nothing was recorded, no bag is left')
            return
        self.get_logger().info(f'{result.messages} messages in {result.path}')
        for line in result.remarks:
            self.get_logger().warning(line)


def message_class(msgtype: str) -> type:
    """The class of a message type such as sensor_msgs/msg/Imu."""
    package, _, name = msgtype.partition('/msg/')
    try:
        return getattr(importlib.import_module(f'{package}.msg'), name)
    except (ImportError, AttributeError):
        raise ValueError(f'message type {msgtype!r} is not installed') from None


def qos_entry(profile: QoSProfile) -> dict:
    """A QoS profile in the form of rosbag2's `offered_qos_profiles`."""
    # Discovery tells neither history nor depth; rosbag2 writes them as unknown, 0.
    durability = {
        DurabilityPolicy.TRANSIENT_LOCAL: 'transient_local',
        DurabilityPolicy.VOLATILE: 'volatile',
    }
    reliability = {
        ReliabilityPolicy.RELIABLE: 'reliable',
        ReliabilityPolicy.BEST_EFFORT: 'best_effort',
    }
    forever = {'sec': 9223372036, 'nsec': 854775807}
    known = profile.history == HistoryPolicy.KEEP_LAST
    return {
        'history': 'keep_last' if known else 'unknown',
        'depth': profile.depth if known else 0,
        'reliability': reliability.get(profile.reliability, 'unknown'),
        'durability': durability.get(profile.durability, 'unknown'),
        'deadline': forever,
        'lifespan': forever,
        'liveliness': 'automatic',
        'liveliness_lease_duration': forever,
        'avoid_ros_namespace_conventions': False,
    }


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_sysid recorder_node`."""
    return run(RecorderNode, RecorderSettings, args, NICENESS, PARTING)


if __name__ == '__main__':
    raise SystemExit(main())
