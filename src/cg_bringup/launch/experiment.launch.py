"""One experiment on the live system: simulated hardware, excitation, recorder.

    ros2 launch cg_bringup experiment.launch.py experiment:=chirp bag:=/tmp/chirp seed:=2

The same data as `ros2 run cg_bringup experiment`, for people who launch. When the machine has
finished, the launch ends and the recorder closes its bag. The exit code is 1 if a node died.
"""

from pathlib import Path

from launch import LaunchDescription

from cg_bringup.launching import description, node_actions, number
from cg_bringup.runs import MODES, Run, experiment_nodes
from cg_description.paths import model_path
from cg_sysid.experiments.catalogue import experiment_names, load_experiment

ARGUMENTS = {
    'experiment': ('spring_stabilised_inner', 'what to carry out', experiment_names()),
    'bag': ('', 'bag directory to write; empty for bags/<experiment>_seed<seed>', None),
    'model': ('', 'model of the simulated robot, a file or a name; empty: nominal', None),
    'seed': ('1', 'seed of sensor noise and excitation', None),
    'mode': ('real_time', 'clock of the machine', list(MODES)),
    'duration': ('0', 'length in s; 0 for that of the experiment', None),
}


def start(given: dict[str, str]) -> list:
    """The nodes of the experiment that the arguments describe."""
    experiment = load_experiment(given['experiment'])
    bag = given['bag'] or f'bags/{experiment.name}_seed{given["seed"]}'
    run = Run(
        experiment,
        bag=Path(bag).expanduser().resolve(),
        model_file=model_path(given['model']).resolve() if given['model'] else None,
        seed=number(given, 'seed', int),
        mode=given['mode'],
        duration=number(given, 'duration') or None,
    )
    return node_actions(experiment_nodes(run))


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes."""
    return description(ARGUMENTS, start)
