"""Recovery along a tree: from away from upright, or after pushes, home to balance.

    ros2 launch cg_bringup tree.launch.py seed:=3
    ros2 launch cg_bringup tree.launch.py start:=upright pushes:='[2.0, 8.0]'
    ros2 param set /tree_server tree FILE
    ros2 service call /tree_server/load std_srvs/srv/Trigger
    ros2 param set /tree_controller hold 4.0

The same nodes as `ros2 run cg_bringup recover_balance`. The exit code is 0 if the robot stands at
the end, 1 if it does not or a node died.
"""

from launch import LaunchDescription

from cg_bringup.launching import description, node_actions, number, pushes_of
from cg_bringup.recover_run import STARTS, RecoverOptions, recover_nodes
from cg_bringup.runs import MODES
from cg_bringup.verdict import recovery_verdict
from cg_dynamics.rig import STANCES

DEFAULT = RecoverOptions()
ARGUMENTS = {
    'robot': (DEFAULT.robot, 'model of the simulated robot: a file or a name', None),
    'model': ('', 'model of observer, tree and controller; empty: nominal', None),
    'grown_for': ('', 'model of the tree, where model knows more; empty: the same', None),
    'tree': (DEFAULT.tree, 'tree that is followed: a file or a name', None),
    'start': (DEFAULT.start, 'tree: from where it brings the robot home; upright', list(STARTS)),
    'stance': ('inner', 'leg that stands at an upright start', list(STANCES)),
    'mode': ('real_time', 'clock of the machine', list(MODES)),
    'seed': ('1', 'seed of the start and of the sensor noise', None),
    'duration': ('0', 'length in s; 0 for ever', None),
    'pushes': ('[]', 'instants and impulses at the hip, [t1, P1, ...] in s and N s', None),
    'epsilon': (str(DEFAULT.epsilon), 'time constant of the observer, s', None),
    'bag': ('', 'bag to record; none if empty', None),
}


def start(given: dict[str, str]) -> list:
    """The nodes that the arguments describe."""
    options = RecoverOptions(
        **{
            name: given[name]
            for name in ('robot', 'model', 'grown_for', 'tree', 'start', 'stance', 'mode', 'bag')
        },
        **{name: number(given, name) for name in ('duration', 'epsilon')},
        seed=number(given, 'seed', int),
        pushes=pushes_of(given['pushes']),
    )
    return node_actions(recover_nodes(options), lambda o: recovery_verdict(o, options.pushes))


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes."""
    return description(ARGUMENTS, start)
