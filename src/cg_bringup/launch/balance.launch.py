"""The flexible, quantised, noisy robot balances: machine, observer, controller, safety gate.

    ros2 launch cg_bringup balance.launch.py stance:=outer pushes:='[5.0, 0.3, 8.0, -0.3]'

The same nodes as `ros2 run cg_bringup balance`. Tune them while they run:
`ros2 param set /observer epsilon 0.05`, `ros2 param set /balance lean_scale 0.1`. The exit code is
0 if the robot stood to the end, 1 if it fell or a node died.
"""

from launch import LaunchDescription

from cg_bringup.balance_run import BalanceOptions, balance_nodes
from cg_bringup.launching import description, node_actions, number, pushes_of
from cg_bringup.runs import MODES
from cg_bringup.verdict import balance_verdict
from cg_dynamics.rig import STANCES

DEFAULT = BalanceOptions()
ARGUMENTS = {
    'robot': (DEFAULT.robot, 'model of the simulated robot: a file or a name', None),
    'model': ('', 'model of observer and controller, a file or a name; empty: nominal', None),
    'stance': ('inner', 'leg that stands', list(STANCES)),
    'lean': (str(DEFAULT.lean), 'of both legs at the start, rad', None),
    'mode': ('real_time', 'clock of the machine', list(MODES)),
    'seed': ('1', 'seed of the sensor noise', None),
    'duration': ('0', 'length in s; 0 for ever', None),
    'pushes': ('[]', 'instants and impulses at the hip, [t1, P1, ...] in s and N s', None),
    'method': ('high_gain', 'of the observer', None),
    'epsilon': (str(DEFAULT.epsilon), 'time constant of the observer, s', None),
}


def start(given: dict[str, str]) -> list:
    """The nodes that the arguments describe."""
    options = BalanceOptions(
        **{name: given[name] for name in ('robot', 'model', 'stance', 'mode', 'method')},
        **{name: number(given, name) for name in ('lean', 'duration', 'epsilon')},
        seed=number(given, 'seed', int),
        pushes=pushes_of(given['pushes']),
    )
    return node_actions(balance_nodes(options), lambda o: balance_verdict(o, options.pushes))


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes."""
    return description(ARGUMENTS, start)
