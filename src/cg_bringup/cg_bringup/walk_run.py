"""The robot walks live: `ros2 run cg_bringup walk --steps 20 --speed 0.25 --mode lockstep`.

Upright at first, it steps in, walks at a speed for so many steps, stops and stands. Starts the
simulated hardware off its blocks, the observer, the tree server, the tree controller and the
safety gate as processes of their own, for machines without `ros2 launch`; walk.launch.py starts
the same nodes with the same parameters. While it walks,

    ros2 param set /tree_controller speed 0.35
    ros2 topic pub -r 10 /cmd_vel geometry_msgs/msg/Twist '{linear: {x: 0.3}}'

change its speed. The last line says how many steps it took and whether it stands in the end, and
so does the exit status.
"""

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass, replace

from cg_bringup.balance_run import MACHINE, carry_out
from cg_bringup.recover_run import RecoverOptions, recover_nodes
from cg_bringup.runs import MODES, NodeOf
from cg_bringup.verdict import walk_verdict
from cg_control.trees.tree import Tree, TreeError
from cg_control.trees.tree_files import tree_path
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES

AROUND = 12.0  # s for standing up, stepping in and stopping


@dataclass(frozen=True)
class WalkRunOptions:
    """What `walk` and the launch file are told.

    Attributes:
        robot: Model file of the simulated machine.
        model: Model file of observer, tree and controller.
        grown_for: Model file that the tree was planned for, where `model` knows more by now.
        tree: Name or file, with orbits.
        speed: In m/s; that of the nearest orbit of the tree is taken.
        steps: After which the robot stops; 0: it walks on.
        stance: Leg that stands at the start.
        mode: Clock of the machine.
        seed: Of the sensor noise.
        duration: In s; 0: as long as the steps take, for ever without.
        pushes: Instants in s and impulses in N s at the hip, in turn.
        epsilon: Of the observer, s.
        bag: Bag to record; none if empty.
    """

    robot: str = NOMINAL_MODEL
    model: str = ''
    grown_for: str = ''
    tree: str = 'compass_gait_mit_walk'
    speed: float = 0.25
    steps: int = 0
    stance: str = 'inner'
    mode: str = 'real_time'
    seed: int = 1
    duration: float = 0.0
    pushes: Sequence[float] = ()
    epsilon: float = 0.01
    bag: str = ''


def walk_nodes(options: WalkRunOptions) -> dict[str, NodeOf]:
    """Node name -> what to start, in the order of ending.

    Raises:
        TreeError: There is no such tree of this model, or one that does not walk.
    """
    model = Model.load(model_path(options.grown_for or options.model or NOMINAL_MODEL))
    tree = Tree.load(tree_path(options.tree), model)
    if not len(tree.speeds):
        raise TreeError(f'{options.tree} has no orbit to walk on; make one with plan_walk')
    duration = options.duration
    if not duration and options.steps:
        # No step of any orbit takes longer than those of the slowest one.
        nodes = tree.nodes
        period = float(nodes.span[nodes.orbiting & ~nodes.impact & (nodes.orbit_of == 0)].sum())
        duration = AROUND + options.steps * period / 2
    names = ('robot', 'model', 'grown_for', 'tree', 'stance', 'mode', 'seed', 'pushes',
             'epsilon', 'bag')  # fmt: skip
    given = {name: getattr(options, name) for name in names}
    nodes_of = recover_nodes(RecoverOptions(start='upright', duration=duration, **given))
    nodes_of[MACHINE].parameters['experiment'] = 'walk'
    nodes_of['tree_controller'].parameters.update(speed=options.speed, steps=options.steps)
    return nodes_of


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_bringup walk`."""
    default = WalkRunOptions()
    parser = argparse.ArgumentParser(prog='walk', description=__doc__)
    parser.add_argument('--robot', default=default.robot, help='simulated: a model file or a name')
    parser.add_argument('--model', default='', help='of observer, tree and controller: the same')
    parser.add_argument(
        '--grown-for', default='', help='model of the tree, where --model knows more [--model]'
    )
    parser.add_argument('--tree', default=default.tree, help=f'a file or a name [{default.tree}]')
    parser.add_argument(
        '--speed', type=float, default=default.speed, help=f'm/s [{default.speed}]'
    )
    parser.add_argument('--steps', type=int, default=20, help='then stop; 0 walks on [20]')
    parser.add_argument('--stance', choices=STANCES, default='inner', help='at first [inner]')
    parser.add_argument('--mode', choices=MODES, default='real_time', help='[real_time]')
    parser.add_argument('--seed', type=int, default=1, help='of the sensor noise [1]')
    parser.add_argument(
        '--duration', type=float, default=0.0, help='in s [0: as long as the steps take]'
    )
    parser.add_argument(
        '--pushes', type=float, nargs='*', default=[], help='t1 P1 t2 P2 ... in s and N s'
    )
    parser.add_argument(
        '--epsilon', type=float, default=default.epsilon,
        help=f'of the observer, s [{default.epsilon}]',
    )  # fmt: skip
    parser.add_argument('--bag', default='', help='bag to record [none]')
    options = replace(default, **vars(parser.parse_args(args)))
    try:
        nodes = walk_nodes(options)
    except (ValueError, OSError) as error:
        print(f'walk: {error}', file=sys.stderr)
        return 2
    return carry_out('walk', nodes, lambda o: walk_verdict(o, options.steps))


if __name__ == '__main__':
    raise SystemExit(main())
