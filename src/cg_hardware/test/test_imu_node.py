"""The IMU node on a serial line, against a device in another process."""

import math
import time

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')
pytest.importorskip('serial')

from emulated_robot import Emulated  # noqa: E402
from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import Imu  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402

from cg_hardware.imu.zero_file import read_zero  # noqa: E402
from cg_hardware.imu_node import ImuNode  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402
from cg_interfaces.ros import SENSOR_QOS, to_nanoseconds  # noqa: E402

pytestmark = pytest.mark.alone

LEAN = 0.05  # rad of the robot that is held


class Bench:
    """The node, its device, and somebody who listens."""

    def __init__(self, folder, **settings):
        self.robot = Emulated(folder, '--state', *map(str, (LEAN, LEAN, 0, 0)))
        given = {'port': str(folder / 'imu'), 'zero_file': str(folder / 'zero.yaml'), **settings}
        self.node = ImuNode(parameter_overrides=[
            Parameter(name, value=value) for name, value in given.items()
        ])  # fmt: skip
        self.peer = Node('peer')
        self.heard = []
        self.peer.create_subscription(Imu, '/imu', self.heard.append, SENSOR_QOS)
        self.executor = EventsExecutor()
        for node in (self.node, self.peer):
            self.executor.add_node(node)
        self.until(lambda: len(self.heard) > 10)

    def until(self, condition, patience=20.0):
        deadline = time.monotonic() + patience
        while not condition():
            assert time.monotonic() < deadline, self.node.problem
            self.executor.spin_once(timeout_sec=self.node.poll())

    def listen(self, seconds):
        """What comes in so many seconds."""
        self.heard.clear()
        end = time.monotonic() + seconds
        self.until(lambda: time.monotonic() > end)
        return list(self.heard)

    def call(self, service):
        client = self.peer.create_client(Trigger, service)
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.until(future.done)
        return future.result()

    def close(self):
        self.node.close()
        for node in (self.node, self.peer):
            self.executor.remove_node(node)
            node.destroy_node()
        self.robot.__exit__()


@pytest.fixture
def bench(tmp_path):
    with own_domain():
        rclpy.init()
        bench = Bench(tmp_path)
        yield bench
        bench.close()
        rclpy.try_shutdown()


def lean(message):
    return 2 * math.atan2(message.orientation.y, message.orientation.w)


def test_samples_come_with_the_clock_of_the_device(bench):
    bench.listen(2.5)
    heard = bench.listen(2.0)
    assert 900 < len(heard) < 1100
    assert np.mean([lean(m) for m in heard]) == pytest.approx(LEAN, abs=1e-3)
    stamps = np.array([to_nanoseconds(m.header.stamp) for m in heard]) / 1e9
    steps = np.diff(stamps)
    assert (steps > 0).all()
    # A sample that the device sent late, as the host was busy, is a step of another length.
    usual = steps[np.abs(steps - 0.002) < 5e-4]
    assert len(usual) > 0.9 * len(steps)
    assert usual.std() < 2e-4


def test_a_plug_that_is_pulled_and_put_back(bench):
    bench.robot.ask('imu_unplug')
    bench.until(lambda: bench.node.problem)
    bench.listen(0.3)  # what is still on its way
    assert bench.listen(0.3) == []
    bench.robot.ask('imu_plug')
    bench.until(lambda: bench.heard)
    assert bench.node.problem == ''


@pytest.mark.parametrize('what', ['imu_silent', 'imu_frozen'])
def test_a_device_that_says_nothing_new_is_told(bench, what):
    bench.robot.ask(what)
    bench.until(lambda: bench.node.line is None)
    assert 'no samples for 0.1 s' in bench.node.problem
    bench.listen(0.3)  # what is still on its way
    assert bench.listen(0.2) == []
    bench.robot.ask('imu_back' if what == 'imu_silent' else what)
    bench.until(lambda: bench.heard)


def test_garbage_and_cut_off_replies_are_passed_over(bench):
    for k in range(20):
        bench.robot.ask(f'imu_garbage {3 + 7 * k}')
        bench.robot.ask(f'imu_cut {1 + k}')
        bench.listen(0.03)
    heard = bench.listen(0.5)
    assert len(heard) > 200
    assert max(abs(lean(m) - LEAN) for m in heard) < 0.02
    assert bench.node.parser.skipped > 0


def test_a_zero_is_taken_kept_and_read_again(bench, tmp_path):
    bench.listen(0.7)
    answer = bench.call('/imu/zero')
    assert answer.success, answer.message
    heard = bench.listen(0.3)
    assert abs(np.mean([lean(m) for m in heard])) < 1e-3
    zero, taken_at = read_zero(str(tmp_path / 'zero.yaml'))
    assert zero == pytest.approx(LEAN, abs=1e-3)
    assert taken_at.endswith('Z')


@pytest.mark.parametrize(
    ('text', 'said'),
    [
        ('format: cg_zero/1\nzero_rad: 9.0\n', 'zero_rad: 9.0 .* from -3.14159 to 3.14159'),
        ('format: cg_zero/1\nzero_rad: true\n', 'zero_rad: true is no number'),
        ('zero_rad: 0.1\n', 'format'),
        ('[]\n', 'mapping'),
        ('a: [\n', 'zero.yaml'),
    ],
)
def test_a_file_that_keeps_no_zero_is_refused(tmp_path, text, said):
    file = tmp_path / 'zero.yaml'
    file.write_text(text)
    with pytest.raises(ValueError, match=said):
        read_zero(str(file))
    assert read_zero(str(tmp_path / 'none.yaml')) == (0.0, '')
