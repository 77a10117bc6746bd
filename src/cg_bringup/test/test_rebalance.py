"""The one-step rebalance with all its nodes, on real topics in lock-step."""

import time

import numpy as np
import pytest
import yaml

rclpy = pytest.importorskip('rclpy')

from rclpy.experimental.events_executor import EventsExecutor  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402

from cg_bringup.rebalance_run import RebalanceOptions, rebalance_nodes  # noqa: E402
from cg_control.trajectory_server_node import TrajectoryServerNode  # noqa: E402
from cg_control.tvlqr_node import TvlqrNode  # noqa: E402
from cg_description.paths import model_path  # noqa: E402
from cg_estimation.observer_node import ObserverNode  # noqa: E402
from cg_hardware.simulation_node import SimulationNode  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402

NODES = {
    'observer': ObserverNode,
    'trajectory_server': TrajectoryServerNode,
    'tvlqr': TvlqrNode,
    'simulation_node': SimulationNode,
}
PATIENCE = 60.0  # s


@pytest.mark.parametrize(
    ('robot', 'first', 'friction'),
    [('compass_gait_mit', 'inner', True), ('compass_gait_flexible', 'outer', False)],
)
def test_robot_steps_from_one_leg_to_the_other_and_stands(robot, first, friction):
    """Noise, quantisation and an observer in the loop; the second robot has a flexible hip."""
    options = RebalanceOptions(
        str(model_path(robot)), first=first, friction=friction, mode='lockstep', duration=5.0
    )
    modes = []
    with own_domain():
        rclpy.init()
        try:
            nodes = {
                name: kind(
                    parameter_overrides=[
                        Parameter(key, value=value)
                        for key, value in rebalance_nodes(options)[name].parameters.items()
                    ]
                )
                for name, kind in NODES.items()
            }
            executor = EventsExecutor()
            for node in nodes.values():
                executor.add_node(node)
            machine, controller = nodes['simulation_node'], nodes['tvlqr'].controller
            deadline = time.monotonic() + PATIENCE
            while not machine.finished:
                assert time.monotonic() < deadline
                for node in nodes.values():
                    node.poll()
                executor.spin_once(timeout_sec=0.002)
                if controller.mode not in modes:
                    modes.append(controller.mode)
            state, stance = machine.plant.state, machine.plant.stance
            for node in nodes.values():
                executor.remove_node(node)
                getattr(node, 'close', lambda: None)()
                node.destroy_node()
        finally:
            rclpy.try_shutdown()
    assert [mode for mode in modes if mode != 'idle'] == ['balancing', 'tracking', 'caught']
    assert machine.exit_status == 0
    standing = ('inner', 'outer').index(stance)
    assert stance != first
    # What dry friction and noise leave of a balanced robot.
    assert np.abs(state[[standing, 2 + standing]]).max() < 0.05


def test_nodes_are_told_one_robot():
    nodes = rebalance_nodes(RebalanceOptions(first='outer', model='mine.yaml'))
    assert nodes['trajectory_server'].parameters['trajectory'] == 'outer_to_inner'
    setup = yaml.safe_load(nodes['simulation_node'].parameters['setup'])
    assert setup == {'stance': 'outer', 'on_blocks': False}
    for name in ('observer', 'trajectory_server', 'tvlqr'):
        assert nodes[name].parameters['model_file'] == 'mine.yaml'
