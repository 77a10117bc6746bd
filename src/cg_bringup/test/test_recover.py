"""Recovery along a tree with all its nodes, on real topics in lock-step, and in the loop."""

import time

import numpy as np
import pytest
import yaml

rclpy = pytest.importorskip('rclpy')

from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402

from cg_bringup import recover_run  # noqa: E402
from cg_bringup.balancing import balance  # noqa: E402
from cg_bringup.recover_run import RecoverOptions, recover_nodes, start_of  # noqa: E402
from cg_control.balancing.balance import BalanceController, balance_gains  # noqa: E402
from cg_control.balancing.basin import shipped_basins  # noqa: E402
from cg_control.tree_controller_node import TreeControllerNode  # noqa: E402
from cg_control.tree_server_node import TreeServerNode  # noqa: E402
from cg_control.trees.lookup import Lookup  # noqa: E402
from cg_control.trees.preview import Preview  # noqa: E402
from cg_control.trees.recovery import ReadyTree, RecoverySettings, TreeController  # noqa: E402
from cg_control.trees.tree import Tree, TreeError  # noqa: E402
from cg_control.trees.tree_files import tree_path  # noqa: E402
from cg_description.paths import model_path  # noqa: E402
from cg_dynamics.model import Model  # noqa: E402
from cg_dynamics.plant import Plant  # noqa: E402
from cg_dynamics.rig import STANCES, Setup  # noqa: E402
from cg_estimation.high_gain import HighGainObserver  # noqa: E402
from cg_estimation.observer_node import ObserverNode  # noqa: E402
from cg_hardware.simulation_node import SimulationNode  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402

NODES = {
    'observer': ObserverNode,
    'tree_server': TreeServerNode,
    'tree_controller': TreeControllerNode,
    'simulation_node': SimulationNode,
}
PATIENCE = 60.0  # s
MODEL = Model.load(model_path('compass_gait_mit'))


@pytest.fixture(scope='module')
def tree():
    return Tree.load(tree_path('compass_gait_mit'), MODEL)


def seed_of_a_step(tree):
    """A seed whose start is well inside the funnel of a node that is one step away from home."""
    for seed in range(200):
        stance, x = start_of(tree, MODEL, seed)
        claim = Lookup(tree.nodes).best(STANCES.index(stance), x)
        if claim.depth < 0.3 and tree.nodes.steps[claim.node] == 1:
            return seed
    raise AssertionError('no such start')


@pytest.mark.alone
def test_robot_comes_home_along_the_tree_and_balances(tree):
    """Noise, quantisation and an observer in the loop; the start is a step away from home."""
    options = RecoverOptions(mode='lockstep', duration=4.0, seed=seed_of_a_step(tree))
    modes = []
    with own_domain():
        rclpy.init()
        try:
            started = recover_nodes(options)
            nodes = {
                name: kind(
                    parameter_overrides=[
                        Parameter(key, value=value)
                        for key, value in started[name].parameters.items()
                    ]
                )
                for name, kind in NODES.items()
            }
            executor = EventsExecutor()
            for node in nodes.values():
                executor.add_node(node)
            machine, controller = nodes['simulation_node'], nodes['tree_controller'].controller
            deadline = time.monotonic() + PATIENCE
            while not machine.finished:
                assert time.monotonic() < deadline
                for node in nodes.values():
                    node.poll()
                executor.spin_once(timeout_sec=0.002)
                if not modes or controller.mode != modes[-1]:
                    modes.append(controller.mode)
            state, stance = machine.plant.state, machine.plant.stance
            steps = machine.standing.outcome.stepped_at
            for node in nodes.values():
                executor.remove_node(node)
                getattr(node, 'close', lambda: None)()
                node.destroy_node()
        finally:
            rclpy.try_shutdown()
    # Until the observer has seen some samples nothing may bring home what it believes.
    assert [mode for mode in modes if mode != 'outside'][:2] == ['idle', 'following']
    assert modes[-1] == 'balancing'
    assert machine.exit_status == 0
    assert steps
    # What dry friction and noise leave of a balanced robot.
    standing = STANCES.index(stance)
    assert np.abs(state[[standing, 2 + standing]]).max() < 0.05


def test_nodes_are_told_one_robot_one_tree_and_one_start(tree):
    nodes = recover_nodes(RecoverOptions(seed=5, pushes=(1.0, 2.0), bag='here'))
    machine = nodes['simulation_node'].parameters
    stance, x = start_of(tree, MODEL, 5)
    setup = yaml.safe_load(machine['setup'])
    assert setup == {'stance': stance, 'on_blocks': False}
    assert machine['initial_state'] == x.tolist()
    assert machine['pushes'] == [1.0, 2.0]
    assert (machine['recorders'], nodes['recorder'].parameters['bag']) == (1, 'here')
    assert nodes['tree_server'].parameters['tree'] == str(tree_path('compass_gait_mit'))
    upright = recover_nodes(RecoverOptions(start='upright', stance='outer', model='mine.yaml'))
    assert upright['simulation_node'].parameters['initial_state'] == [0.0] * 4
    for name in ('observer', 'tree_server', 'tree_controller'):
        assert upright[name].parameters['model_file'] == 'mine.yaml'


def test_a_start_comes_home_and_is_not_there(tree):
    preview, outside = Preview(tree, MODEL), 0
    for seed in range(20):
        stance, x = start_of(tree, MODEL, seed)
        leg = STANCES.index(stance)
        assert preview.choose(np.array([leg]), x[None])[0] >= 0
        assert x @ tree.goal[leg] @ x > 1.0
        outside += Lookup(tree.nodes).best(leg, x).depth > 1.0
    assert outside > 2  # no funnel holds these
    with pytest.raises(TreeError, match='brings home none of'):
        start_of(Tree(tree.nodes, 1e30 * tree.goal), MODEL, 1)


def test_a_tree_may_be_of_the_robot_as_it_was_known_before(tree, tmp_path):
    loaded = tmp_path / 'loaded.yaml'
    MODEL.with_effect('payload', 'inner', mass=1.0, distance=0.5).save(loaded)
    options = RecoverOptions(model=str(loaded), grown_for='compass_gait_mit')
    nodes = recover_nodes(options)
    assert nodes['tree_server'].parameters['model_file'] == 'compass_gait_mit'
    assert nodes['tree_controller'].parameters['grown_for'] == 'compass_gait_mit'
    for name in ('tree_controller', 'observer'):
        assert nodes[name].parameters['model_file'] == str(loaded)


def test_pushes_are_answered_by_steps_with_an_observer(tree):
    """5 N s at the hip: balance alone falls, the tree takes a step, without planning one."""
    settings = RecoverySettings()
    gains = balance_gains(MODEL, settings, 0.002)
    stood = []
    for ready in (None, ReadyTree.of(tree, MODEL)):
        alone = BalanceController(
            MODEL, settings, gains, shipped_basins(MODEL, gains, MODEL.torque_limit)
        )
        controller = alone
        if ready is not None:
            controller = TreeController(alone, settings)
            controller.take(ready)
        setup = Setup(stance='inner', on_blocks=False)
        plant = Plant(MODEL, setup, np.zeros(4), seed=3)
        observer = HighGainObserver(MODEL, setup, 0.01)
        run = balance(plant, observer, controller, 4.0, ((0.5, 5.0),))
        stood.append(run.upright(4.0))
        steps = np.flatnonzero(np.diff(run.standing))
    assert stood == [False, True]
    assert len(steps) == 1


@pytest.mark.parametrize(
    ('given', 'said'),
    [
        (['--tree', 'oak'], "recover_balance: no tree 'oak'"),
        (['--model', 'compass_gait_flexible'], 'grown for a model with hash'),
    ],
)
def test_a_tree_that_cannot_be_followed_starts_nothing(given, said, capsys):
    assert recover_run.main(given) == 2
    assert said in capsys.readouterr().err
