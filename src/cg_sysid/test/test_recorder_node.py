"""SIGKILL at full rate loses at most 20 ms, and a late start nothing after the beginning."""

import contextlib
import os
import resource
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
from rosbags.highlevel import AnyReader

rclpy = pytest.importorskip('rclpy')

from geometry_msgs.msg import WrenchStamped  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import Imu, JointState  # noqa: E402
from std_msgs.msg import String  # noqa: E402

from cg_interfaces.domains import own_domain  # noqa: E402
from cg_interfaces.ros import LATCHED_QOS, MACHINE_QOS, to_stamp  # noqa: E402
from cg_sysid.recorder_node import RecorderNode  # noqa: E402
from cg_sysid.records.recover import JOURNAL_NAME, needs_recovery, recover  # noqa: E402

pytestmark = pytest.mark.alone

RECORDER = 'cg_sysid.recorder_node'
PERIOD = 0.002  # s
LOSS = 0.02  # s
TOPICS = {
    '/imu': Imu,
    '/hip_encoder': JointState,
    '/applied_torque': JointState,
    '/torque_command': JointState,
}
EXPECTED = {
    **TOPICS,
    '/foot_contact/inner': WrenchStamped,
    '/foot_contact/outer': WrenchStamped,
}


@contextlib.contextmanager
def make_sender(topics=None):
    # A domain each: subscriptions of a killed recorder linger in its own.
    with own_domain():
        rclpy.init()
        node = Node('sender')
        yield Sender(node, topics or TOPICS)
        node.destroy_node()
        rclpy.try_shutdown()


class Sender:
    """Publishes topics at 500 Hz from this thread."""

    def __init__(self, node, topics):
        self.node = node
        self.sent = []  # stamps in ns
        self.publishers = {
            topic: node.create_publisher(kind, topic, MACHINE_QOS)
            for topic, kind in topics.items()
        }
        self.messages = {topic: kind() for topic, kind in topics.items()} | {
            '/imu': Imu(),
            **{
                topic: JointState(name=['hip'], position=[0.1], effort=[1.0])
                for topic in list(TOPICS)[1:]
            },
        }

    def wait_for_recorder(self, process):
        deadline = time.monotonic() + 20.0
        while any(p.get_subscription_count() == 0 for p in self.publishers.values()):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.01)

    def send(self, seconds):
        """Send that long; return the largest delay of a tick in s."""
        start = time.monotonic()
        worst = 0.0
        for tick in range(round(seconds / PERIOD)):
            wait = start + tick * PERIOD - time.monotonic()
            worst = max(worst, -wait)
            time.sleep(max(wait, 0.0))
            self.sent.append(time.time_ns())
            stamp = to_stamp(self.sent[-1])
            for topic, publisher in self.publishers.items():
                self.messages[topic].header.stamp = stamp
                publisher.publish(self.messages[topic])
        return worst


def start_recorder(bag, **options):
    return subprocess.Popen(
        [sys.executable, '-m', RECORDER, '--ros-args', '-p', f'bag:={bag}'],
        **options,
    )


def stamps_of(bag, without=''):
    stamps = {}
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            if connection.topic == without:
                continue
            stamp = reader.deserialize(data, connection.msgtype).header.stamp
            stamps.setdefault(connection.topic, []).append(stamp.sec * 10**9 + stamp.nanosec)
    return stamps


def kill_while_sending(bag, seconds):
    """Kill a recorder at full rate; loss and the sender's own worst delay in s."""
    with make_sender() as sender:
        process = start_recorder(bag)
        sender.wait_for_recorder(process)
        sender.send(1.0)
        worst = sender.send(seconds)
        killed_ns = time.time_ns()
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
    assert needs_recovery(bag)
    recover(bag)
    stored = stamps_of(bag)
    assert set(stored) == set(TOPICS)
    return max(killed_ns - stamps[-1] for stamps in stored.values()) * 1e-9, worst


def test_sigkill_loses_at_most_20_ms(tmp_path):
    # A machine that takes the processor from both delays the sender as well, and what was not
    # sent is not lost: the best of some attempts is what the recorder can do.
    excess = []
    for attempt in range(10):
        loss, worst = kill_while_sending(tmp_path / f'bag{attempt}', 0.5 + 0.0037 * attempt)
        print(f'lost {1e3 * loss:.1f} ms, sender late by at most {1e3 * worst:.1f} ms')
        if worst < 0.004:
            assert loss <= LOSS
            return
        excess.append(loss - worst)
    assert min(excess) <= LOSS


def test_sigint_closes_the_bag_and_every_message_is_there(tmp_path):
    bag = tmp_path / 'bag'
    with make_sender() as sender:
        process = start_recorder(bag)
        sender.wait_for_recorder(process)
        sender.send(0.5)  # a recorder that is still being matched may miss the first ones
        sender.sent.clear()
        sender.send(0.5)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20.0) == 0
    assert not needs_recovery(bag)
    stored = stamps_of(bag)
    assert set(stored) == set(TOPICS)
    for stamps in stored.values():
        assert stamps[-len(sender.sent) :] == sender.sent


def test_started_while_data_flow_the_bag_begins_with_all_topics_and_the_note(tmp_path):
    bag = tmp_path / 'bag'
    with make_sender(EXPECTED) as sender:
        notes = sender.node.create_publisher(String, '/experiment', LATCHED_QOS)
        notes.publish(String(data='mechanism: compass_gait'))
        sender.send(0.1)
        log = tmp_path / 'log'
        with log.open('w') as output:
            process = start_recorder(bag, stderr=output)
        deadline = time.monotonic() + 30.0
        while 'all topics are heard' not in log.read_text():
            assert time.monotonic() < deadline, log.read_text()
            sender.send(0.05)
        sender.send(0.1)
        process.send_signal(signal.SIGINT)
        assert process.wait(timeout=20.0) == 0
    with AnyReader([bag]) as reader:
        notes = [c for c, _, _ in reader.messages() if c.topic == '/experiment']
    assert len(notes) == 1
    stored = stamps_of(bag, without='/experiment')
    assert set(stored) == set(EXPECTED)
    first = max(stamps[0] for stamps in stored.values())
    for stamps in stored.values():
        assert stamps[0] == first
        assert stamps == [stamp for stamp in sender.sent if first <= stamp <= stamps[-1]]


def test_a_full_disk_ends_the_recording_with_one_error_and_keeps_what_came_before(tmp_path):
    bag, log = tmp_path / 'bag', tmp_path / 'log'
    with make_sender() as sender, log.open('w') as output:
        process = start_recorder(bag, stderr=output)
        sender.wait_for_recorder(process)
        sender.send(0.5)
        # A limit of file sizes is a disk that is full for this process alone.
        journal = bag / JOURNAL_NAME
        most = journal.stat().st_size + 20_000
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (most, most))
        sender.send(0.5)
        assert process.wait(timeout=30.0) == 1
    said = log.read_text()
    errors = [line for line in said.splitlines() if '[ERROR]' in line]
    assert len(errors) == 1
    assert f'{bag}: recording stopped: ' in errors[0]
    assert 'Traceback' not in said
    recover(bag)
    stored = stamps_of(bag)
    assert set(stored) == set(TOPICS)
    for stamps in stored.values():
        assert set(stamps) <= set(sender.sent)


def test_a_recorder_that_ends_leaves_the_processors_to_the_loop(tmp_path):
    # In a thread of its own, as policies are those of threads.
    def end_at_real_time_priority():
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(1))
        recorder.close()
        return os.sched_getscheduler(0)

    with own_domain():
        rclpy.init()
        bag = Parameter('bag', value=str(tmp_path / 'bag'))
        recorder = RecorderNode(parameter_overrides=[bag])
        try:
            with ThreadPoolExecutor(1) as thread:
                policy = thread.submit(end_at_real_time_priority).result()
        except PermissionError:
            pytest.skip('this user may give no real-time priority')
        finally:
            recorder.destroy_node()
            rclpy.try_shutdown()
    assert policy == os.SCHED_OTHER


@pytest.mark.parametrize(
    ('parameter', 'message'),
    [("bag:=''", 'bag is empty'), ('also:=[/x]', 'not of the form'), ('depth:=1', 'depth')],
)
def test_wrong_parameters_end_the_node_with_their_reason(tmp_path, parameter, message):
    command = [sys.executable, '-m', RECORDER, '--ros-args', '-p', parameter]
    if not parameter.startswith('bag'):
        command += ['-p', f'bag:={tmp_path / "bag"}']
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60.0)
    assert done.returncode == 2
    assert message in done.stderr
