"""Trajectory server, TVLQR controller and playback on real topics and services."""

import math
import time
from dataclasses import replace

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')

from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import Imu, JointState  # noqa: E402
from std_msgs.msg import String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from trajectory_msgs.msg import JointTrajectory  # noqa: E402

from cg_control.playback_node import PlaybackNode, Recital  # noqa: E402
from cg_control.trajectories.trajectory import Trajectory  # noqa: E402
from cg_control.trajectory_server_node import (  # noqa: E402
    TrajectoryServerNode,
    joint_trajectory,
)
from cg_control.tvlqr_node import TvlqrNode  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402
from cg_interfaces.ros import LATCHED_QOS, SENSOR_QOS, to_stamp  # noqa: E402

PATIENCE = 60.0  # s; discovery on a busy machine


class Bench:
    """Nodes and a peer that hears everything, in one executor."""

    def __init__(self):
        self.executor = EventsExecutor()
        self.nodes = []
        self.peer = self.add(Node('peer'))
        self.commands, self.orders, self.nominals, self.texts = [], [], [], []
        self.peer.create_subscription(
            JointState, '/torque_command', self.commands.append, SENSOR_QOS
        )
        self.peer.create_subscription(
            JointTrajectory, '/trajectory', self.orders.append, SENSOR_QOS
        )
        self.peer.create_subscription(
            JointTrajectory, '/trajectory/nominal', self.nominals.append, LATCHED_QOS
        )
        self.peer.create_subscription(
            String, '/trajectory/selected', self.texts.append, LATCHED_QOS
        )
        self.state = self.peer.create_publisher(JointState, '/state', SENSOR_QOS)
        self.imu = self.peer.create_publisher(Imu, '/imu', SENSOR_QOS)
        self.order = self.peer.create_publisher(JointTrajectory, '/trajectory', SENSOR_QOS)
        self.text = self.peer.create_publisher(String, '/trajectory/selected', LATCHED_QOS)

    def add(self, node):
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def until(self, condition):
        deadline = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < deadline
            for node in self.nodes:
                getattr(node, 'poll', lambda: 1.0)()
            self.executor.spin_once(timeout_sec=0.005)

    def ask(self, service):
        client = self.peer.create_client(Trigger, service)
        self.until(client.service_is_ready)
        future = client.call_async(Trigger.Request())
        self.until(future.done)
        return future.result()

    def tell(self, stamp_ns, x, stance='inner'):
        """Publish a state and return the torque that answers it."""
        message = state_message(stamp_ns, x, stance)
        heard = len(self.commands)
        self.state.publish(message)
        self.until(lambda: len(self.commands) > heard)
        answer = self.commands[-1]
        assert answer.header.stamp == message.header.stamp
        return answer.effort[0]

    def close(self):
        for node in self.nodes:
            self.executor.remove_node(node)
            node.destroy_node()


def state_message(stamp_ns, x, stance='inner'):
    message = JointState(
        name=['inner', 'outer'], position=[float(a) for a in x[:2]],
        velocity=[float(a) for a in x[2:4]],
    )  # fmt: skip
    message.header.stamp, message.header.frame_id = to_stamp(stamp_ns), f'{stance}_foot'
    return message


@pytest.fixture
def bench():
    with own_domain():
        rclpy.init()
        bench = Bench()
        yield bench
        bench.close()
        rclpy.try_shutdown()


def overrides(**parameters):
    return [Parameter(name, value=value) for name, value in parameters.items()]


def test_server_plans_shows_starts_stops_and_selects(bench, robot, tmp_path):
    path = tmp_path / 'step.json'
    server = bench.add(TrajectoryServerNode(parameter_overrides=overrides(save=str(path))))
    bench.until(lambda: bench.nominals and bench.texts)
    saved = Trajectory.load(path, robot)
    assert bench.texts[-1].data == saved.text()
    assert bench.nominals[-1].header.frame_id == 'inner_foot'
    answer = bench.ask('/trajectory_server/start')
    assert answer.success
    bench.until(lambda: bench.orders)
    points = bench.orders[0].points
    assert len(points) == len(saved.time)
    np.testing.assert_array_equal([p.positions for p in points], saved.states[:, :2])
    np.testing.assert_array_equal([p.effort[0] for p in points], saved.torque)
    assert all(p.effort[1] == -p.effort[0] for p in points)
    assert bench.ask('/trajectory_server/stop').success
    bench.until(lambda: len(bench.orders) == 2)
    assert not bench.orders[1].points
    # The other step, then a file, then one that is not there.
    (result,) = server.set_parameters([Parameter('trajectory', value='outer_to_inner')])
    assert result.successful
    bench.until(lambda: bench.nominals[-1].header.frame_id == 'outer_foot')
    assert bench.ask('/trajectory_server/plan').success


def test_server_starts_nothing_that_it_could_not_get(bench, tmp_path):
    server = bench.add(
        TrajectoryServerNode(parameter_overrides=overrides(trajectory=str(tmp_path / 'none')))
    )
    answer = bench.ask('/trajectory_server/start')
    assert not answer.success
    assert 'No such file' in answer.message
    server.set_parameters(
        [Parameter('torque_limit', value=0.001), Parameter('trajectory', value='inner_to_outer')]
    )
    answer = bench.ask('/trajectory_server/start')
    assert not answer.success
    assert 'no motion inner -> outer' in answer.message
    assert not bench.orders


@pytest.mark.alone
def test_controller_balances_follows_and_stops(bench, step):
    node = bench.add(TvlqrNode())
    bench.until(lambda: bench.state.get_subscription_count() and node.count_publishers('/state'))
    bench.until(lambda: bench.order.get_subscription_count() >= 2)
    bench.text.publish(String(data=step.text()))
    bench.until(lambda: node.trajectory is not None)
    period = 2_000_000
    now = 1_000_000_000
    bench.tell(now, np.zeros(4))
    bench.until(lambda: node.controller.mode == 'balancing')
    leaning = np.array([0.005, 0.0, 0.0, 0.0])
    assert abs(bench.tell(now + period, leaning)) > 0
    gain = node.controller.balance.gains['inner'].copy()
    (result,) = node.set_parameters([Parameter('lean_scale', value=0.2)])
    assert result.successful
    bench.tell(now + 2 * period, leaning)
    assert node.controller.balance.gains['inner'][0] < gain[0]
    bench.order.publish(joint_trajectory(step))
    bench.until(lambda: node.controller.mode == 'tracking')
    # On the nominal motion the answer is the nominal torque.
    start = now + 3 * period
    for k in range(5):
        stamp, t = start + k * period, k * period * 1e-9
        torque = bench.tell(stamp, step.at(t).state)
        assert torque == pytest.approx(step.at(t).torque, abs=1e-6)
    bench.order.publish(JointTrajectory(joint_names=['inner', 'outer']))
    bench.until(lambda: node.controller.mode != 'tracking')


@pytest.mark.alone
def test_controller_can_wait_for_its_trajectory(bench, step):
    node = bench.add(TvlqrNode(parameter_overrides=[Parameter('await_trajectory', value=True)]))
    node.on_state(state_message(1_000_000_000, np.zeros(4)))
    assert node.controller.mode == 'idle'
    node.on_selected(String(data=step.text()))
    node.on_state(state_message(1_000_000_000, np.zeros(4)))
    assert node.controller.mode == 'balancing'


@pytest.mark.alone
def test_controller_refuses_and_is_safe(bench, robot, step):
    node = bench.add(TvlqrNode())
    bench.until(lambda: bench.state.get_subscription_count() and node.count_publishers('/state'))
    bench.until(lambda: bench.order.get_subscription_count() >= 2)
    # Another model's trajectory.
    bench.text.publish(String(data=replace(step, model_hash='f' * 64).text()))
    bench.until(lambda: 'plan it again' in node.problem)
    bench.tell(1_000_000_000, np.zeros(4))
    bench.order.publish(joint_trajectory(step))
    bench.tell(1_002_000_000, np.zeros(4))
    assert node.controller.mode == 'balancing'
    # The right one on the wrong leg.
    bench.text.publish(String(data=step.text()))
    bench.until(lambda: node.trajectory is not None)
    bench.tell(1_004_000_000, np.zeros(4), 'outer')
    assert 'begins on the inner leg' in node.controller.start(step)
    # Far from its start.
    node.controller._state = ('inner', np.array([0.2, 0.0, 0.0, 0.0]))
    assert 'from the start of the trajectory' in node.controller.start(step)
    # States that are no states.
    assert bench.tell(1_006_000_000, np.array([0.0, math.nan, 0.0, 0.0])) == 0.0
    assert bench.tell(1_008_000_000, np.zeros(4), 'middle') == 0.0
    assert bench.tell(3_000_000_000, np.array([0.8, 0.0, 0.0, 0.0])) == 0.0


@pytest.mark.alone
def test_playback_answers_with_the_torque_of_the_stamp(bench, step):
    node = bench.add(PlaybackNode())
    bench.until(lambda: bench.imu.get_subscription_count() and node.count_publishers('/imu'))
    bench.until(lambda: bench.order.get_subscription_count() >= 2)

    def answer(stamp_ns):
        message = Imu()
        message.header.stamp = to_stamp(stamp_ns)
        heard = len(bench.commands)
        bench.imu.publish(message)
        bench.until(lambda: len(bench.commands) > heard)
        return bench.commands[-1].effort[0]

    assert answer(1_000_000_000) == 0.0
    bench.order.publish(joint_trajectory(step))
    bench.until(lambda: node.recital is not None)
    for t in (0.0, 0.1, 0.777):
        expected = step.at(t).torque
        # Stamps are whole ns.
        assert answer(2_000_000_000 + round(t * 1e9)) == pytest.approx(expected, abs=1e-6)
    assert answer(2_000_000_000 + round((step.duration + 0.01) * 1e9)) == 0.0
    bench.order.publish(JointTrajectory())
    bench.until(lambda: node.recital is None)
    assert answer(2_100_000_000) == 0.0


def test_playback_refuses_trajectories_without_torque(step):
    message = joint_trajectory(step)
    message.points[3].effort = []
    with pytest.raises(ValueError, match='without an effort'):
        Recital(message)
    message = joint_trajectory(step)
    message.joint_names = ['knee', 'ankle']
    with pytest.raises(ValueError, match="'knee'"):
        Recital(message)
