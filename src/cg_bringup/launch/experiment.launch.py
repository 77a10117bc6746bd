"""One experiment on the live system: simulated hardware, excitation, recorder.

    ros2 launch cg_bringup experiment.launch.py experiment:=chirp bag:=/tmp/chirp seed:=2

The same data as `ros2 run cg_bringup experiment`, for people who launch. When the machine has
finished, the launch ends and the recorder closes its bag.
"""

import tempfile
from pathlib import Path

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, OpaqueFunction, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from cg_bringup.runs import MODES, NODE_MODULES, Run, node_parameters, parameter_file_text
from cg_sysid.experiments import experiment_names, load_experiment

ARGUMENTS = {
    'experiment': ('spring_stabilised_inner', 'what to carry out', experiment_names()),
    'bag': ('', 'bag directory to write; empty for bags/<experiment>_seed<seed>', None),
    'model': ('', 'model file of the simulated machine; empty for the nominal one', None),
    'seed': ('1', 'seed of sensor noise and excitation', None),
    'mode': ('real_time', 'clock of the machine', list(MODES)),
    'duration': ('0', 'length in s; 0 for that of the experiment', None),
}


def start_nodes(context: LaunchContext) -> list:
    """The nodes of the experiment that the arguments describe."""
    given = {name: LaunchConfiguration(name).perform(context) for name in ARGUMENTS}
    experiment = load_experiment(given['experiment'])
    bag = given['bag'] or f'bags/{experiment.name}_seed{given["seed"]}'
    run = Run(
        experiment,
        bag=Path(bag).expanduser().resolve(),
        model_file=Path(given['model']).expanduser().resolve() if given['model'] else None,
        seed=int(given['seed']),
        mode=given['mode'],
        duration=float(given['duration']) or None,
    )
    with tempfile.NamedTemporaryFile('w', suffix='.yaml', delete=False) as file:
        file.write(parameter_file_text(node_parameters(run)))
    nodes = {
        name: Node(
            package=package,
            executable=executable,
            name=name,
            parameters=[file.name],
            output='screen',
            # A recorder that closes a long bag needs its time.
            sigterm_timeout='60',
            sigkill_timeout='60',
        )
        for name, (package, executable) in NODE_MODULES.items()
    }
    finished = RegisterEventHandler(
        OnProcessExit(
            target_action=nodes['simulation_node'],
            on_exit=[EmitEvent(event=Shutdown(reason='the experiment is over'))],
        )
    )
    return [*nodes.values(), finished]


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=text, choices=choices)
        for name, (default, text, choices) in ARGUMENTS.items()
    ]
    return LaunchDescription([*arguments, OpaqueFunction(function=start_nodes)])
