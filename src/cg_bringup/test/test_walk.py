"""Walking: in the loop with an observer, and with all its nodes on real topics in lock-step."""

import time

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy')

from geometry_msgs.msg import Twist  # noqa: E402
from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402

from cg_bringup.balancing import balance  # noqa: E402
from cg_bringup.verdict import walk_verdict  # noqa: E402
from cg_bringup.walk_run import WalkRunOptions, walk_nodes  # noqa: E402
from cg_control.balancing.balance import BALANCING, BalanceController, balance_gains  # noqa: E402
from cg_control.balancing.basin import shipped_basins  # noqa: E402
from cg_control.following.nodes import Way  # noqa: E402
from cg_control.tree_controller_node import TreeControllerNode  # noqa: E402
from cg_control.tree_server_node import TreeServerNode  # noqa: E402
from cg_control.trees.recovery import (  # noqa: E402
    OUTSIDE,
    ReadyTree,
    RecoverySettings,
    TreeController,
)
from cg_control.trees.tree import Tree, TreeError  # noqa: E402
from cg_control.trees.tree_files import tree_path  # noqa: E402
from cg_description.paths import model_path  # noqa: E402
from cg_dynamics.model import Model  # noqa: E402
from cg_dynamics.plant import Plant  # noqa: E402
from cg_dynamics.rig import Setup  # noqa: E402
from cg_estimation.high_gain import HighGainObserver  # noqa: E402
from cg_estimation.observer_node import ObserverNode  # noqa: E402
from cg_hardware.simulation_node import SimulationNode  # noqa: E402
from cg_hardware.standing import Outcome  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402

NODES = {
    'observer': ObserverNode,
    'tree_server': TreeServerNode,
    'tree_controller': TreeControllerNode,
    'simulation_node': SimulationNode,
}
PATIENCE = 90.0  # s
MODEL = Model.load(model_path('compass_gait_mit'))


@pytest.fixture(scope='module')
def ready():
    return ReadyTree.of(Tree.load(tree_path('compass_gait_mit_walk'), MODEL), MODEL, 0.002)


@pytest.fixture
def walker(ready):
    def make(**changes):
        settings = RecoverySettings(**changes)
        gains = balance_gains(MODEL, settings, 0.002)
        basins = shipped_basins(MODEL, gains, MODEL.torque_limit)
        found = TreeController(BalanceController(MODEL, settings, gains, basins), settings)
        found.take(ready)
        return found

    return make


class Uneven(Plant):
    """A machine on ground that rises where one of its feet lands."""

    rise, at, landed = 0.0, 0, 0  # m, number of the landing, landings so far

    def _height(self, x):
        return super()._height(x) - (self.rise if self.landed == self.at else 0.0)

    def _stands_on(self, stance):
        super()._stands_on(stance)
        self.landed += 1


def run(controller, duration, pushes=(), seed=2, robot=MODEL, rise=0.0):
    """From upright on the inner leg, with noise, quantisation and an observer."""
    setup = Setup(stance='inner', on_blocks=False)
    plant = Uneven(robot, setup, np.zeros(4), seed=seed)
    # On the outer leg: at 0.3 m/s the foot swings 95 mm above the ground there, 2 mm on the inner.
    plant.rise, plant.at = rise, 5
    return balance(plant, HighGainObserver(MODEL, setup, 0.01), controller, duration, pushes)


def landings(done):
    return done.time[1:][np.diff(done.standing) != 0]


def test_it_steps_in_walks_and_stands_again(walker):
    controller = walker(speed=0.3, steps=6)
    done = run(controller, 19.0)
    assert done.upright(19.0)
    at = landings(done)
    # It stops from the orbit that it is on: in the step that it is in, or the next one.
    assert 6 <= len(at) <= 7
    # 0.3 m/s in steps of 0.3 m; one leg's step takes longer than the other's.
    assert (at[5] - at[3]) / 2 == pytest.approx(1.0, abs=0.1)


def test_a_push_does_not_stop_it(walker):
    """Pushed by 3 N s while it walks: it is in the tube again some steps later, and walks on."""
    controller = walker(speed=0.25)
    done = run(controller, 16.0, ((7.3, 3.0),))
    assert done.time[-1] > 15.9
    assert controller.way == Way.ORBIT
    assert controller.depth <= 1.0
    at = landings(done)
    assert (np.diff(at[at > 9.0]) < 1.5).all()


HIDDEN = {
    'less gravity': {'robot': MODEL.with_values({'gravity': 9.5})},
    'a payload': {'robot': MODEL.with_effect('payload', 'outer', mass=0.8, distance=0.4)},
    'a step up': {'rise': 0.004},
    'a step down': {'rise': -0.004},
}


@pytest.mark.parametrize('hidden', [
    hidden if hidden == 'a payload' else pytest.param(hidden, marks=pytest.mark.evidence)
    for hidden in HIDDEN
])  # fmt: skip
def test_it_walks_on_with_what_nobody_told_it(walker, hidden):
    controller = walker(speed=0.3, steps=6)
    done = run(controller, 19.0, **HIDDEN[hidden])
    assert done.upright(19.0)
    assert len(landings(done)) >= 6


def test_a_fall_is_told_and_ends_without_torque(walker):
    """With 4 kg on one leg pair that it does not know of nothing brings it home."""
    controller = walker(speed=0.3)
    heavy = MODEL.with_effect('payload', 'inner', mass=4.0, distance=0.5)
    done = run(controller, 16.0, robot=heavy)
    assert done.time[-1] < 15.0  # it fell
    assert controller.mode == OUTSIDE
    assert (done.torque[-3:] == 0.0).all()
    lying = np.array([1.0, *done.estimates[-1][1:]])
    said = controller.step(round(1e9 * done.time[-1]) + 2_000_000, 'inner', lying)
    assert said.torque == 0.0
    assert 'leaning by 1 rad' in said.reason


def test_a_robot_that_is_told_nothing_stands(walker):
    controller = walker()
    done = run(controller, 1.0)
    assert controller.mode == BALANCING
    assert not len(landings(done))
    assert controller.speed == 0.0


def test_a_speed_that_no_orbit_has_is_that_of_the_nearest(walker):
    controller = walker(speed=0.9)
    assert controller.wanted == 4
    controller.demand = 0.05
    assert controller.wanted == -1


def test_it_walks_at_the_speed_of_cmd_vel_and_stops_when_nobody_says_so():
    options = WalkRunOptions(mode='lockstep', speed=0.0, duration=14.0)
    speeds = []
    with own_domain():
        rclpy.init()
        try:
            started = walk_nodes(options)
            nodes = {
                name: kind(
                    parameter_overrides=[
                        Parameter(key, value=value)
                        for key, value in started[name].parameters.items()
                    ]
                )
                for name, kind in NODES.items()
            }
            operator = rclpy.create_node('operator')
            drive = operator.create_publisher(Twist, '/cmd_vel', 10)
            executor = EventsExecutor()
            for node in (*nodes.values(), operator):
                executor.add_node(node)
            machine, node = nodes['simulation_node'], nodes['tree_controller']
            deadline, said = time.monotonic() + PATIENCE, -1.0
            while not machine.finished:
                assert time.monotonic() < deadline
                now = machine.standing.outcome.duration
                if 1.0 < now < 7.0 and now - said > 0.1:
                    message = Twist()
                    message.linear.x = 0.21
                    drive.publish(message)
                    said = now
                for each in nodes.values():
                    each.poll()
                executor.spin_once(timeout_sec=0.002)
                if not speeds or node.controller.speed != speeds[-1]:
                    speeds.append(node.controller.speed)
            outcome = machine.standing.outcome
            mode = node.controller.mode
            for each in (*nodes.values(), operator):
                executor.remove_node(each)
                getattr(each, 'close', lambda: None)()
                each.destroy_node()
        finally:
            rclpy.try_shutdown()
    assert speeds == [0.0, 0.2, 0.0]
    assert mode == BALANCING
    assert machine.exit_status == 0
    assert len(outcome.stepped_at) >= 3
    assert outcome.stepped_at[0] > 1.0


def test_nodes_are_told_how_to_walk():
    nodes = walk_nodes(WalkRunOptions(speed=0.3, steps=10, pushes=(5.0, 2.0), bag='here'))
    controller = nodes['tree_controller'].parameters
    assert (controller['speed'], controller['steps']) == (0.3, 10)
    # How it follows the tree is the tree's own law.
    assert not {'remedy', 'pull', 'fastest'} & set(controller)
    machine = nodes['simulation_node'].parameters
    assert machine['initial_state'] == [0.0] * 4
    assert machine['pushes'] == [5.0, 2.0]
    # Ten steps of the slowest orbit take 15 s, and there is time around them.
    assert 20.0 < machine['duration'] < 40.0
    assert walk_nodes(WalkRunOptions(steps=0))['simulation_node'].parameters['duration'] == 0.0
    with pytest.raises(TreeError, match='has no orbit to walk on; make one with plan_walk'):
        walk_nodes(WalkRunOptions(tree='compass_gait_mit'))


def test_verdicts():
    stands = Outcome(20.0, 'inner', 0.2, 0.01, None, tuple(np.arange(2.0, 12.0)))
    assert walk_verdict(stands, 10).worked
    assert walk_verdict(stands, 10).line.startswith('10 steps from 2.00 to 11.00 s, upright at')
    assert not walk_verdict(stands, 12).worked
    assert '10 steps from 2.00 to 11.00 s of 12 asked for' in walk_verdict(stands, 12).line
    fell = Outcome(9.0, 'outer', 0.6, 0.6, 9.0, (2.0, 3.0))
    assert not walk_verdict(fell, 0).worked
    assert 'fell at 9.00 s on the outer leg, after 2 steps' in walk_verdict(fell, 0).line
    assert walk_verdict(Outcome(9.0, 'outer', 0.2, 0.15, None, (2.0,)), 0).worked
