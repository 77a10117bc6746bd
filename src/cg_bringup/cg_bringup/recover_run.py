"""Recovery along a tree live: `ros2 run cg_bringup recover_balance --seed 3 --mode lockstep`.

The robot begins away from upright, somewhere from where the tree brings it home, or upright and is
pushed; it comes home as the tree says, and balances there. Starts the simulated hardware off its
blocks, the observer, the tree server, the tree controller and the safety gate as processes of
their own, for machines without `ros2 launch`; tree.launch.py starts the same nodes with the same
parameters.
The last line says whether the robot stands in the end, and so does the exit status.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml

from cg_bringup.balance_run import MACHINE, carry_out
from cg_bringup.balancing import FALLEN
from cg_bringup.runs import CLOSING, MODES, PEERS, NodeOf
from cg_bringup.verdict import recovery_verdict
from cg_control.grow_tree import BOX
from cg_control.trees.growth import Region
from cg_control.trees.preview import Preview
from cg_control.trees.tree import Tree, TreeError
from cg_control.trees.tree_files import tree_path
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_interfaces import topics

STARTS = ('tree', 'upright')
DRAWS, AT_ONCE = 300, 32  # states tried for one that comes home


@dataclass(frozen=True)
class RecoverOptions:
    """What `recover_balance` and the launch file are told.

    Attributes:
        robot: Model file of the simulated machine.
        model: Model file of observer, tree and controller.
        grown_for: Model file that the tree was grown for, where `model` knows more by now.
        tree: Name or file.
        start: 'tree': a state from which the tree brings the robot home, drawn by the seed;
            'upright'.
        stance: Leg that stands at an upright start.
        mode: Clock of the machine.
        seed: Of the start and of the sensor noise.
        duration: In s; 0 for ever.
        pushes: Instants in s and impulses in N s at the hip, in turn.
        epsilon: Of the observer, s.
        bag: Bag to record; none if empty.
    """

    robot: str = NOMINAL_MODEL
    model: str = ''
    grown_for: str = ''
    tree: str = 'compass_gait_mit'
    start: str = 'tree'
    stance: str = 'inner'
    mode: str = 'real_time'
    seed: int = 1
    duration: float = 0.0
    pushes: Sequence[float] = ()
    epsilon: float = 0.01
    bag: str = ''


def start_of(tree: Tree, model: Model, seed: int) -> tuple[str, np.ndarray]:
    """A state outside the goal regions from which a tree brings a robot home.

    Args:
        tree: Of a compass gait.
        model: The robot: previews say what comes home.
        seed: Says which.

    Returns:
        The leg that stands, and x (4,).

    Raises:
        TreeError: The tree brings hardly anything home.
    """
    preview, rng = Preview(tree, model), np.random.default_rng(seed)
    for _ in range(DRAWS):
        leg, x = Region(np.array(BOX)).draw(rng, AT_ONCE)
        away = ~(np.einsum('bi,bij,bj->b', x, tree.goal[leg], x) <= 1.0)
        found = np.flatnonzero(away & (preview.choose(leg, x) >= 0))
        if len(found):
            return STANCES[leg[found[0]]], x[found[0]]
    raise TreeError(f'the tree brings home none of {DRAWS * AT_ONCE} states outside its goals')


def recover_nodes(options: RecoverOptions) -> dict[str, NodeOf]:
    """Node name -> what to start, in the order of ending.

    Raises:
        TreeError: There is no such tree of this model.
    """
    rate = {'sample_rate_hz': 500.0}
    path = tree_path(options.tree)
    grown_for = options.grown_for or options.model
    stance, x = options.stance, np.zeros(4)
    if options.start == 'tree':
        tree = Tree.load(path, Model.load(model_path(grown_for or NOMINAL_MODEL)))
        known = Model.load(model_path(options.model or NOMINAL_MODEL))
        stance, x = start_of(tree, known, options.seed)
    machine: dict[str, Any] = {
        'model_file': options.robot,
        'setup': yaml.safe_dump({'stance': stance, 'on_blocks': False}),
        'initial_state': x.tolist(),
        'mode': options.mode,
        'seed': options.seed,
        'duration': options.duration,
        'await_answer': True,
        'peer_timeout': PEERS,
        'experiment': 'recover_balance',
        'closed_loop': True,
        'exit_when_done': True,
        'fall_angle': FALLEN,
        **rate,
    }
    if options.pushes:
        machine['pushes'] = [float(number) for number in options.pushes]
    observer = {'model_file': options.model, 'epsilon': options.epsilon, **rate}
    nodes = {
        MACHINE: NodeOf('cg_hardware', 'simulation_node', machine),
        'tree_server': NodeOf(
            'cg_control', 'tree_server_node',
            {'model_file': grown_for, 'tree': str(path)},
        ),
        'tree_controller': NodeOf(
            'cg_control', 'tree_controller_node',
            {'model_file': options.model, 'grown_for': grown_for, **rate},
            ((topics.TORQUE_COMMAND, topics.TORQUE_REQUEST),),
        ),
        'safety_gate': NodeOf('cg_hardware', 'safety_gate_node', {}),
        'observer': NodeOf('cg_estimation', 'observer_node', observer),
    }  # fmt: skip
    if options.bag:
        machine['recorders'] = 1
        recorder = {
            'bag': options.bag,
            'mechanism': 'compass_gait',
            'time': 'stamp' if options.mode == 'lockstep' else 'receipt',
        }
        nodes['recorder'] = NodeOf('cg_sysid', 'recorder_node', recorder, ending=CLOSING)
    return nodes


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_bringup recover_balance`."""
    default = RecoverOptions()
    parser = argparse.ArgumentParser(prog='recover_balance', description=__doc__)
    parser.add_argument('--robot', default=default.robot, help='simulated: a model file or a name')
    parser.add_argument('--model', default='', help='of observer, tree and controller: the same')
    parser.add_argument(
        '--grown-for', default='', help='model of the tree, where --model knows more [--model]'
    )
    parser.add_argument('--tree', default=default.tree, help=f'a file or a name [{default.tree}]')
    parser.add_argument('--start', choices=STARTS, default='tree', help='[tree]')
    parser.add_argument('--stance', choices=STANCES, default='inner', help='upright: [inner]')
    parser.add_argument('--mode', choices=MODES, default='real_time', help='[real_time]')
    parser.add_argument('--seed', type=int, default=1, help='of start and sensor noise [1]')
    parser.add_argument('--duration', type=float, default=6.0, help='in s, 0 for ever [6]')
    parser.add_argument(
        '--pushes', type=float, nargs='*', default=[], help='t1 P1 t2 P2 ... in s and N s'
    )
    parser.add_argument(
        '--epsilon', type=float, default=default.epsilon,
        help=f'of the observer, s [{default.epsilon}]',
    )  # fmt: skip
    parser.add_argument('--bag', default='', help='bag to record [none]')
    options = RecoverOptions(**vars(parser.parse_args(args)))
    try:
        nodes = recover_nodes(options)
    except (ValueError, OSError) as error:
        print(f'recover_balance: {error}', file=sys.stderr)
        return 2
    return carry_out('recover_balance', nodes, lambda o: recovery_verdict(o, options.pushes))


if __name__ == '__main__':
    raise SystemExit(main())
