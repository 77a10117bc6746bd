"""One-step rebalance: balance on one leg, step, be caught on the other leg, balance there.

    ros2 launch cg_bringup rebalance.launch.py first:=outer remedy:=phase
    ros2 launch cg_bringup rebalance.launch.py start_after:=0
    ros2 service call /trajectory_server/start std_srvs/srv/Trigger

The same nodes as `ros2 run cg_bringup rebalance`. The exit code is 0 if the robot stands on the
other leg at the end, 1 if it does not or a node died.
"""

from launch import LaunchDescription

from cg_bringup.launching import description, node_actions, number
from cg_bringup.rebalance_run import RebalanceOptions, rebalance_nodes
from cg_bringup.runs import MODES
from cg_bringup.verdict import rebalance_verdict
from cg_control.following.tracking import REMEDIES
from cg_dynamics.rig import STANCES

DEFAULT = RebalanceOptions()
ARGUMENTS = {
    'robot': (DEFAULT.robot, 'model of the simulated robot: a file or a name', None),
    'model': ('', 'model of observer, planner and controller; empty: nominal', None),
    'first': ('inner', 'leg that stands at the start', list(STANCES)),
    'remedy': ('event', 'what is done about an impact off its time', list(REMEDIES)),
    'friction': ('true', 'plan with friction; otherwise compensate it', ['true', 'false']),
    'start_after': ('1', 'step after balancing for so long, s; 0 waits for ~/start', None),
    'mode': ('real_time', 'clock of the machine', list(MODES)),
    'seed': ('1', 'seed of the sensor noise', None),
    'duration': ('0', 'length in s; 0 for ever', None),
}


def start(given: dict[str, str]) -> list:
    """The nodes that the arguments describe."""
    options = RebalanceOptions(
        **{name: given[name] for name in ('robot', 'model', 'first', 'remedy', 'mode')},
        **{name: number(given, name) for name in ('start_after', 'duration')},
        friction=given['friction'] == 'true',
        seed=number(given, 'seed', int),
    )
    asked = options.start_after > 0.0
    return node_actions(
        rebalance_nodes(options), lambda o: rebalance_verdict(o, options.first, asked)
    )


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes."""
    return description(ARGUMENTS, start)
