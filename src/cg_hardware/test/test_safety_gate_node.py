"""The gate between a controller and the hardware, on real topics."""

import math
import time

import pytest

rclpy = pytest.importorskip('rclpy')

from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402

from cg_dynamics.domains import own_domain  # noqa: E402
from cg_dynamics.ros import SENSOR_QOS, to_stamp  # noqa: E402
from cg_hardware.safety_gate_node import SafetyGateNode  # noqa: E402

pytestmark = pytest.mark.alone


@pytest.fixture
def bench():
    with own_domain():
        rclpy.init()
        gate = SafetyGateNode(parameter_overrides=[Parameter('torque_limit', value=10.0)])
        peer = Node('peer')
        commands = []
        peer.create_subscription(JointState, '/torque_command', commands.append, SENSOR_QOS)
        publisher = peer.create_publisher(JointState, '/torque_request', SENSOR_QOS)
        executor = EventsExecutor()
        for node in (gate, peer):
            executor.add_node(node)

        def until(condition):
            deadline = time.monotonic() + 20.0
            while not condition():
                assert time.monotonic() < deadline
                executor.spin_once(timeout_sec=gate.poll())

        until(
            lambda: publisher.get_subscription_count() and gate.publisher.get_subscription_count()
        )
        yield gate, publisher, commands, until
        for node in (gate, peer):
            executor.remove_node(node)
            node.destroy_node()
        rclpy.try_shutdown()


def request(torque, nanoseconds):
    message = JointState(name=['hip'], effort=[torque])
    message.header.stamp = to_stamp(nanoseconds)
    return message


def test_requests_pass_within_limits_and_keep_their_stamp(bench):
    _, publisher, commands, until = bench
    for index, torque in enumerate((2.0, 50.0, math.nan), start=1):
        publisher.publish(request(torque, index))
        until(lambda count=index: len([m for m in commands if m.header.stamp.sec == 0]) >= count)
    answers = [m for m in commands if m.header.stamp.sec == 0]
    assert [m.effort[0] for m in answers] == [2.0, 10.0, 0.0]
    assert [m.header.stamp.nanosec for m in answers] == [1, 2, 3]


def test_silence_gives_one_zero(bench):
    _, publisher, commands, until = bench
    publisher.publish(request(2.0, 5))
    until(lambda: len(commands) >= 2)
    assert commands[-1].effort[0] == 0.0


def test_limits_can_be_changed_while_it_runs_and_nonsense_is_refused(bench):
    gate, publisher, commands, until = bench
    (result,) = gate.set_parameters([Parameter('torque_limit', value=1.0)])
    assert result.successful
    (result,) = gate.set_parameters([Parameter('torque_limit', value=-1.0)])
    assert not result.successful
    (result,) = gate.set_parameters([Parameter('mechanism', value='pendulum')])
    assert 'mechanism cannot change' in result.reason
    publisher.publish(request(2.0, 5))
    until(lambda: commands)
    assert commands[0].effort[0] == 1.0
