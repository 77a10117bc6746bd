"""The flexible, quantised, noisy robot balances: machine, observer, controller, safety gate.

    ros2 launch cg_bringup balance.launch.py stance:=outer pushes:='[5.0, 0.3, 8.0, -0.3]'

The same nodes as `ros2 run cg_bringup balance`. Tune them while they run:
`ros2 param set /observer epsilon 0.05`, `ros2 param set /balance lean_scale 0.1`.
"""

import tempfile

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from cg_bringup.balance_run import BalanceOptions, balance_nodes
from cg_bringup.runs import MODES, parameter_file_text
from cg_dynamics.rig import STANCES

DEFAULT = BalanceOptions()
ARGUMENTS = {
    'robot': (DEFAULT.robot, 'model file of the simulated machine', None),
    'model': ('', 'model file of observer and controller; empty for the nominal one', None),
    'stance': ('inner', 'leg that stands', list(STANCES)),
    'lean': (str(DEFAULT.lean), 'of both legs at the start, rad', None),
    'mode': ('real_time', 'clock of the machine', list(MODES)),
    'seed': ('1', 'seed of the sensor noise', None),
    'duration': ('0', 'length in s; 0 for ever', None),
    'pushes': ('[]', 'instants and impulses at the hip, [t1, P1, ...] in s and N s', None),
    'method': ('high_gain', 'of the observer', None),
    'epsilon': (str(DEFAULT.epsilon), 'time constant of the observer, s', None),
}


def start_nodes(context: LaunchContext) -> list:
    """The nodes that the arguments describe."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    options = BalanceOptions(
        **{name: given[name] for name in ('robot', 'model', 'stance', 'mode', 'method')},
        **{name: float(given[name]) for name in ('lean', 'duration', 'epsilon')},
        seed=int(given['seed']),
        pushes=yaml.safe_load(given['pushes']) or (),
    )
    nodes = balance_nodes(options)
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
