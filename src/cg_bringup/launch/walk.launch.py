"""Walking: from upright, at a speed, for so many steps or for ever.

    ros2 launch cg_bringup walk.launch.py speed:=0.25 steps:=20
    ros2 launch cg_bringup walk.launch.py pushes:='[8.0, 3.0]'
    ros2 param set /tree_controller speed 0.35
    ros2 topic pub -r 10 /cmd_vel geometry_msgs/msg/Twist '{linear: {x: 0.3}}'

The same nodes as `ros2 run cg_bringup walk`. The exit code is 0 if the robot did what was asked, 1
if it did not or a node died.
"""

from launch import LaunchDescription

from cg_bringup.launching import description, node_actions, number, pushes_of
from cg_bringup.runs import MODES
from cg_bringup.verdict import walk_verdict
from cg_bringup.walk_run import WalkRunOptions, walk_nodes
from cg_dynamics.rig import STANCES

DEFAULT = WalkRunOptions()
ARGUMENTS = {
    'robot': (DEFAULT.robot, 'model of the simulated robot: a file or a name', None),
    'model': ('', 'model of observer, tree and controller; empty: nominal', None),
    'grown_for': ('', 'model of the tree, where model knows more; empty: the same', None),
    'tree': (DEFAULT.tree, 'tree that is followed: a file or a name', None),
    'speed': (str(DEFAULT.speed), 'in m/s; the nearest orbit of the tree is taken', None),
    'steps': ('0', 'after which the robot stops; 0: it walks on', None),
    'stance': ('inner', 'leg that stands at the start', list(STANCES)),
    'mode': ('real_time', 'clock of the machine', list(MODES)),
    'seed': ('1', 'seed of the sensor noise', None),
    'duration': ('0', 'length in s; 0: as long as the steps take, for ever without', None),
    'pushes': ('[]', 'instants and impulses at the hip, [t1, P1, ...] in s and N s', None),
    'epsilon': (str(DEFAULT.epsilon), 'time constant of the observer, s', None),
    'bag': ('', 'bag to record; none if empty', None),
}


def start(given: dict[str, str]) -> list:
    """The nodes that the arguments describe."""
    options = WalkRunOptions(
        **{
            name: given[name]
            for name in ('robot', 'model', 'grown_for', 'tree', 'stance', 'mode', 'bag')
        },
        **{name: number(given, name) for name in ('speed', 'duration', 'epsilon')},
        seed=number(given, 'seed', int),
        steps=number(given, 'steps', int),
        pushes=pushes_of(given['pushes']),
    )
    return node_actions(walk_nodes(options), lambda o: walk_verdict(o, options.steps))


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes."""
    return description(ARGUMENTS, start)
