"""Tree server and tree controller on real topics, parameters and services."""

import json
import math
import time
from dataclasses import replace

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus  # noqa: E402
from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from sensor_msgs.msg import JointState  # noqa: E402
from std_msgs.msg import Int32, String  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from trajectory_msgs.msg import JointTrajectory  # noqa: E402
from visualization_msgs.msg import Marker, MarkerArray  # noqa: E402

from cg_control.following.tracking import WALKING, TrackingSettings  # noqa: E402
from cg_control.tree_controller_node import TreeControllerNode  # noqa: E402
from cg_control.tree_server_node import TreeServerNode  # noqa: E402
from cg_control.trees.lookup import Lookup  # noqa: E402
from cg_control.trees.tree import Tree  # noqa: E402
from cg_control.trees.tree_files import TreeSelection, tree_path  # noqa: E402
from cg_control.trees.way_home import WayHome  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402
from cg_interfaces.ros import LATCHED_QOS, SENSOR_QOS, to_stamp  # noqa: E402

pytestmark = pytest.mark.alone

PATIENCE = 20.0  # s; discovery on a busy machine
PERIOD = 2_000_000  # ns
BEGIN = 1_000_000_000  # ns


class Bench:
    """Nodes and a peer that hears everything, in one executor."""

    def __init__(self):
        self.executor = EventsExecutor()
        self.nodes = []
        self.peer = self.add(Node('peer'))
        self.commands, self.selections, self.entered = [], [], []
        self.branches, self.markers, self.reports = [], [], []
        for kind, topic, heard, qos in (
            (JointState, '/torque_command', self.commands, SENSOR_QOS),
            (String, '/tree/selected', self.selections, LATCHED_QOS),
            (Int32, '/tree/node', self.entered, SENSOR_QOS),
            (JointTrajectory, '/tree/branch', self.branches, LATCHED_QOS),
            (MarkerArray, '/tree/markers', self.markers, LATCHED_QOS),
            (DiagnosticArray, '/diagnostics', self.reports, 10),
        ):
            self.peer.create_subscription(kind, topic, heard.append, qos)
        self.state = self.peer.create_publisher(JointState, '/state', SENSOR_QOS)
        self.applied = self.peer.create_publisher(JointState, '/applied_torque', SENSOR_QOS)
        self.selected = self.peer.create_publisher(String, '/tree/selected', LATCHED_QOS)

    def add(self, node):
        self.nodes.append(node)
        self.executor.add_node(node)
        return node

    def controller(self, **parameters):
        node = self.add(TreeControllerNode(parameter_overrides=overrides(**parameters)))
        self.until(
            lambda: self.state.get_subscription_count() and node.count_publishers('/state')
            and self.selected.get_subscription_count() >= 2
            and node.publisher.get_subscription_count()
        )  # fmt: skip
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

    def select(self, node, path):
        """Have the controller load a file."""
        before = node.controller.tree
        self.selected.publish(String(data=TreeSelection.of(path).text()))
        self.until(lambda: node.controller.tree is not before)

    def tell(self, stamp_ns, x, stance='inner'):
        """Publish a state and return the torque that answers it."""
        message = JointState(
            name=['inner', 'outer'], position=[float(a) for a in x[:2]],
            velocity=[float(a) for a in x[2:4]],
        )  # fmt: skip
        message.header.stamp, message.header.frame_id = to_stamp(stamp_ns), f'{stance}_foot'
        heard = len(self.commands)
        self.state.publish(message)
        self.until(lambda: len(self.commands) > heard)
        answer = self.commands[-1]
        assert answer.header.stamp == message.header.stamp
        return answer.effort[0]

    def report(self):
        """The next status of the controller, and its values."""
        self.reports.clear()
        self.until(lambda: any(s.name == 'tree_controller' for r in self.reports
                               for s in r.status))  # fmt: skip
        status = next(s for r in self.reports for s in r.status if s.name == 'tree_controller')
        return status, {value.key: value.value for value in status.values}

    def close(self):
        for node in self.nodes:
            self.executor.remove_node(node)
            getattr(node, 'close', lambda: None)()
            node.destroy_node()


@pytest.fixture
def bench():
    with own_domain():
        rclpy.init()
        bench = Bench()
        yield bench
        bench.close()
        rclpy.try_shutdown()


@pytest.fixture(scope='module')
def tree(robot):
    return Tree.load(tree_path('compass_gait_mit'), robot)


@pytest.fixture(scope='module')
def stranger(tree, tmp_path_factory):
    """File of a tree of another robot."""
    path = tmp_path_factory.mktemp('trees') / 'stranger.npz'
    replace(tree, nodes=replace(tree.nodes, model_hash='f' * 64)).save(path)
    return path


@pytest.fixture(scope='module')
def start(tree):
    """A node of the inner leg that is an impact away from home, and is its own best node."""
    nodes, lookup = tree.nodes, Lookup(tree.nodes)
    for node in np.flatnonzero((nodes.stance == 0) & (nodes.steps == 1) & (nodes.rho > 0)
                               & (nodes.span > 0) & (nodes.to_go > 0.5)):  # fmt: skip
        x = nodes.x0[node]
        if lookup.best(0, x).node == node and x @ tree.goal[0] @ x > 2.0:
            return int(node)
    raise AssertionError('no such node')


def overrides(**parameters):
    return [Parameter(name, value=value) for name, value in parameters.items()]


def test_the_server_selects_shows_and_refuses(bench, tree, stranger, tmp_path, start, robot):
    server = bench.add(TreeServerNode())
    bench.until(lambda: bench.selections and bench.branches and bench.markers)
    said = json.loads(bench.selections[-1].data)
    assert said['path'] == str(tree_path('compass_gait_mit').absolute())
    assert not bench.branches[-1].points
    assert bench.markers[-1].markers[0].action == Marker.DELETEALL
    # Another file, by the parameter.
    path = tmp_path / 'tree.npz'
    tree.save(path)
    assert server.set_parameters([Parameter('tree', value=str(path))])[0].successful
    bench.until(lambda: json.loads(bench.selections[-1].data)['path'] == str(path))
    # The same file, grown anew.
    before = len(bench.selections)
    replace(tree, provenance={'grown': 'anew'}).save(path)
    assert bench.ask('/tree_server/load').success
    bench.until(lambda: len(bench.selections) > before)
    assert json.loads(bench.selections[-1].data) == json.loads(TreeSelection.of(path).text())
    # One of another robot, and none at all: the tree before stays.
    for bad, reason in ((stranger, 'grown for a model with hash'), ('oak', "no tree 'oak'")):
        server.set_parameters([Parameter('tree', value=str(bad))])
        answer = bench.ask('/tree_server/load')
        assert not answer.success
        assert reason in answer.message
    assert json.loads(bench.selections[-1].data)['path'] == str(path)
    # What the controller does is shown.
    node = bench.peer.create_publisher(Int32, '/tree/node', SENSOR_QOS)
    bench.until(lambda: node.get_subscription_count() >= 2)
    node.publish(Int32(data=start))
    bench.until(lambda: bench.branches[-1].points and len(bench.markers[-1].markers) == 4)
    way = WayHome.along(tree.nodes, start)
    # What was shown before goes first.
    branch, (gone, *lines) = bench.branches[-1], bench.markers[-1].markers
    assert gone.action == Marker.DELETEALL
    assert branch.header.frame_id == 'inner_foot'
    np.testing.assert_array_equal([p.positions for p in branch.points], way.states[:, :2])
    np.testing.assert_array_equal([p.effort[0] for p in branch.points], way.torque)
    points = way.points(robot.values['leg_length'])
    for line in lines:
        assert (line.header.frame_id, line.type) == ('world', Marker.LINE_STRIP)
        np.testing.assert_array_equal([(p.x, p.z) for p in line.points], points[line.ns])
    for gone in (-1, 10**6):  # outside every funnel; a node of another tree
        shown = len(bench.branches)
        node.publish(Int32(data=gone))
        bench.until(lambda shown=shown: len(bench.branches) > shown)
        assert not bench.branches[-1].points


def test_the_controller_follows_the_tree_that_the_server_selects(bench, tree, start):
    node = bench.controller()
    # Nobody has said yet what is to be followed: no answer.
    message = JointState(name=['inner', 'outer'], position=[0.0] * 2, velocity=[0.0] * 2)
    message.header.frame_id = 'inner_foot'
    bench.state.publish(message)
    status, values = bench.report()
    assert not bench.commands
    assert (status.level, status.message) == (DiagnosticStatus.WARN, 'idle: no state yet')
    assert values['problem'] == 'no tree selected yet'
    bench.add(TreeServerNode())
    bench.until(lambda: node.controller.tree is not None)
    nodes = tree.nodes
    torque = bench.tell(BEGIN, nodes.x0[start])
    assert node.controller.mode == 'following'
    # Friction, 1.84 N m and the viscous part, is given back on top.
    assert abs(torque - nodes.u0[start]) < 8.0
    bench.until(lambda: bench.entered and bench.entered[-1].data == start)
    bench.until(lambda: bench.branches and bench.branches[-1].points)
    status, values = bench.report()
    assert status.message == 'following'  # a busy machine may be too slow for level OK
    assert values['node'] == str(start)
    assert values['branch'] == str(nodes.branch[start])
    assert float(values['depth']) <= 1.0
    assert float(values['to_go_s']) == pytest.approx(nodes.to_go[start], abs=0.01)
    for name in ('lookup', 'answer'):
        p50, p99, most = (float(values[f'{name}_{k}_us']) for k in ('p50', 'p99', 'max'))
        assert 0.0 < p50 <= p99 <= most
    # The same stamp gets the same answer again.
    assert bench.tell(BEGIN, np.zeros(4)) == torque
    # Home, and outside.
    bench.tell(BEGIN + PERIOD, np.zeros(4))
    assert node.controller.mode == 'balancing'
    bench.until(lambda: bench.entered[-1].data == -1)
    for tick in range(2, 11):  # entries are tried over some samples
        torque = bench.tell(BEGIN + tick * PERIOD, np.array([0.5, -0.5, 1.5, 4.0]))
    assert torque == 0.0
    status, values = bench.report()
    assert status.message.startswith('outside: outside every funnel: depth ')
    assert status.level == DiagnosticStatus.WARN


def test_the_controller_refuses_a_tree_and_keeps_the_one_before(
    bench, tree, stranger, start, tmp_path
):
    node = bench.controller()
    bench.select(node, tree_path('compass_gait_mit'))
    for text, reason in (
        (TreeSelection.of(stranger).text(), 'grown for a model with hash'),
        (TreeSelection(str(stranger), 'f' * 64).text(), 'has changed since'),
        (TreeSelection(str(tmp_path / 'none'), 'f' * 64).text(), 'No such file'),
        ('rubbish', 'selection: not JSON'),
    ):
        bench.selected.publish(String(data=text))
        bench.until(lambda reason=reason: reason in node.problem)
    status, values = bench.report()
    assert status.level == DiagnosticStatus.WARN
    assert 'selection: not JSON' in values['problem']
    bench.tell(BEGIN, tree.nodes.x0[start])
    assert node.controller.mode == 'following'


def test_another_tree_is_followed_from_the_next_state_on(bench, tree, start, tmp_path):
    node = bench.controller()
    bench.select(node, tree_path('compass_gait_mit'))
    bench.tell(BEGIN, tree.nodes.x0[start])
    assert node.controller.node == start
    # The roots alone, and nothing is home: this state is nobody's any more.
    path = tmp_path / 'roots.npz'
    roots, _ = tree.nodes.pruned(np.array([], int))
    roots.rho[:] = 0.01
    none = np.zeros((2, 0), np.int32)
    replace(tree, nodes=roots, goal=1e30 * tree.goal, champions=none).save(path)
    bench.select(node, path)
    assert bench.tell(BEGIN + PERIOD, tree.nodes.x0[start]) == 0.0
    assert node.controller.mode == 'outside'
    bench.select(node, tree_path('compass_gait_mit'))
    bench.tell(BEGIN + 2 * PERIOD, tree.nodes.x0[start])
    assert node.controller.node == start


def test_tube_and_surface_of_what_is_followed_are_shown(bench):
    server = bench.add(TreeServerNode(parameter_overrides=overrides(tree='compass_gait_mit_walk')))
    surfaces = []
    bench.peer.create_subscription(MarkerArray, '/tree/surface', surfaces.append, 10)
    node = bench.controller(speed=0.25)
    bench.until(lambda: node.controller.tree is not None)
    bench.until(lambda: node.reference_publisher.get_subscription_count())
    bench.until(lambda: server.surface.get_subscription_count())
    nodes = node.controller.tree.nodes
    on = int(nodes.phase_starts(1)[0])
    told = []
    bench.peer.create_subscription(Int32, '/tree/reference', told.append, SENSOR_QOS)
    bench.until(lambda: node.reference_publisher.get_subscription_count() >= 2)
    for tick in range(51):  # 0.1 s
        bench.tell(BEGIN + tick * PERIOD, nodes.x0[on])
    bench.until(lambda: len(told) >= 3 and len(surfaces) >= 3)
    # Every 50 ms, not every sample.
    assert len(told) == len(surfaces) == 3
    assert nodes.orbit_of[[m.data for m in told]].tolist() == [1, 1, 1]
    names = [m.ns for m in bench.markers[-1].markers]
    assert names == ['', 'tube_hip', 'tube_foot', 'hip', 'inner_foot', 'outer_foot']
    tube = bench.markers[-1].markers[2]
    assert tube.type == Marker.LINE_LIST
    assert 0 < len(tube.points) <= 2 * 960
    assert [m.ns for m in surfaces[-1].markers] == ['', 'surface']
    assert len(surfaces[-1].markers[1].points) == 40
    # Outside the tree there is neither.
    for tick in range(51, 110):
        bench.tell(BEGIN + tick * PERIOD, np.array([0.5, -0.5, 1.5, 4.0]))
    bench.until(lambda: len(surfaces[-1].markers) == 1 and len(bench.markers[-1].markers) == 1)
    assert surfaces[-1].markers[0].action == Marker.DELETEALL


def test_a_tree_that_is_selected_is_followed_by_its_own_law(bench, tree, start):
    """One that walks by the surfaces of its orbits, one to upright by the clock."""
    node = bench.controller(speed=0.25)
    bench.select(node, tree_path('compass_gait_mit_walk'))
    walk = node.controller.tree
    on = int(walk.nodes.phase_starts(1)[0])
    bench.tell(BEGIN, walk.nodes.x0[on])
    ready = node.controller._ready
    assert ready.tracker.settings == ready.preview.settings == WALKING
    bench.select(node, tree_path('compass_gait_mit'))
    bench.tell(BEGIN + PERIOD, tree.nodes.x0[start])
    ready = node.controller._ready
    assert ready.tracker.settings == ready.preview.settings == TrackingSettings()
    assert ready.tracker.settings.pulled == 0.0
    # What is set by hand counts.
    (result,) = node.set_parameters(overrides(remedy='event'))
    assert result.successful
    bench.select(node, tree_path('compass_gait_mit_walk'))
    bench.tell(BEGIN + 2 * PERIOD, walk.nodes.x0[on])
    assert node.controller._ready.tracker.settings.remedy == 'event'


def test_parameters_act_live_or_are_refused(bench, tree, start):
    node = bench.controller()
    bench.select(node, tree_path('compass_gait_mit'))
    x = tree.nodes.x0[start]
    bench.tell(BEGIN, x)
    results = node.set_parameters(overrides(armed=False, hold=2.0, remedy='phase', pull=7.0))
    assert all(result.successful for result in results)
    assert bench.tell(BEGIN + PERIOD, x) == 0.0
    assert node.controller.mode == 'idle'
    (result,) = node.set_parameters(overrides(armed=True))
    bench.tell(BEGIN + 2 * PERIOD, x)
    assert node.controller.mode == 'following'
    assert node.controller.settings.hold == 2.0
    assert node.controller._ready.tracker.settings.pulled == 7.0
    gain = node.controller.balance.gains['inner'].copy()
    (result,) = node.set_parameters(overrides(lean_scale=0.2))
    assert result.successful
    bench.tell(BEGIN + 3 * PERIOD, x)
    assert node.controller.balance.gains['inner'][0] < gain[0]
    for name, value in (('hold', 0.5), ('remedy', 'clock'), ('sample_rate_hz', 100.0)):
        (result,) = node.set_parameters([Parameter(name, value=value)])
        assert not result.successful
        assert name in result.reason


def test_states_that_are_none_or_missing_get_no_torque(bench, tree, start):
    node = bench.controller()
    bench.select(node, tree_path('compass_gait_mit'))
    x = tree.nodes.x0[start]
    assert bench.tell(BEGIN, x) != 0.0
    assert bench.tell(BEGIN + PERIOD, np.array([0.0, math.nan, 0.0, 0.0])) == 0.0
    assert bench.tell(BEGIN + 2 * PERIOD, x, 'middle') == 0.0
    assert bench.tell(BEGIN + 3 * PERIOD, x) != 0.0
    # After a gap it begins anew: the reference of before is void.
    node.controller._ready.tracker.begin(0)
    bench.tell(BEGIN + 600_000_000, x)
    assert node.controller.node == start


def test_ages_of_the_answers_are_reported(bench, tree, start):
    node = bench.controller(deadline=0.003, sample_rate_hz=400.0)
    bench.select(node, tree_path('compass_gait_mit'))
    assert node.controller._ready.preview.simulation.sample_time == 0.0025
    bench.until(lambda: bench.applied.get_subscription_count())
    for tick, late in enumerate((2, 2, 5)):
        x = tree.nodes.x0[start] + [0.001 * tick, 0.0, 0.0, 0.0]
        torque = bench.tell(BEGIN + tick * PERIOD, x)
        message = JointState(name=['hip'], effort=[torque])
        message.header.stamp = to_stamp(BEGIN + tick * PERIOD + late * 1_000_000)
        bench.applied.publish(message)
        bench.until(lambda tick=tick: len(node._ages) > tick)
    node._next_diagnosis = 0.0
    _, values = bench.report()
    assert values['age_max_ms'] == '5.000'
