"""One-step rebalance: balance on one leg, step, be caught on the other leg, balance there.

    ros2 launch cg_bringup rebalance.launch.py first:=outer remedy:=phase
    ros2 launch cg_bringup rebalance.launch.py start_after:=0
    ros2 service call /trajectory_server/start std_srvs/srv/Trigger

The same nodes as `ros2 run cg_bringup rebalance`.
"""

import tempfile

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from cg_bringup.rebalance_run import RebalanceOptions, rebalance_nodes
from cg_bringup.runs import MODES, parameter_file_text
from cg_control.tracking import REMEDIES
from cg_dynamics.rig import STANCES

DEFAULT = RebalanceOptions()
ARGUMENTS = {
    'robot': (DEFAULT.robot, 'model file of the simulated machine', None),
    'model': ('', 'model file of observer, planner and controller; empty: nominal', None),
    'first': ('inner', 'leg that stands at the start', list(STANCES)),
    'remedy': ('event', 'what is done about an impact off its time', list(REMEDIES)),
    'friction': ('true', 'plan with friction; otherwise compensate it', ['true', 'false']),
    'start_after': ('1', 'step after balancing for so long, s; 0 waits for ~/start', None),
    'mode': ('real_time', 'clock of the machine', list(MODES)),
    'seed': ('1', 'seed of the sensor noise', None),
    'duration': ('0', 'length in s; 0 for ever', None),
}


def start_nodes(context: LaunchContext) -> list:
    """The nodes that the arguments describe."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    options = RebalanceOptions(
        **{name: given[name] for name in ('robot', 'model', 'first', 'remedy', 'mode')},
        **{name: float(given[name]) for name in ('start_after', 'duration')},
        friction=given['friction'] == 'true',
        seed=int(given['seed']),
    )
    nodes = rebalance_nodes(options)
    with tempfile.NamedTemporaryFile('w', suffix='.yaml', delete=False) as file:
        file.write(parameter_file_text({name: node.parameters for name, node in nodes.items()}))
    actions = {
        name: Node(
            package=node.package,
            executable=node.executable,
            name=name,
            parameters=[file.name],
            remappings=list(node.remappings),
            output='screen',
        )
        for name, node in nodes.items()
    }
    finished = RegisterEventHandler(
        OnProcessExit(
            target_action=actions['simulation_node'],
            on_exit=[EmitEvent(event=Shutdown(reason='the machine has finished'))],
        )
    )
    return [*actions.values(), finished]


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=text, choices=choices)
        for name, (default, text, choices) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start_nodes)])
