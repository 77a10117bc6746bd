"""Experiments as data: which set-up, start, excitation and duration; which parameters follow.

Each file of config/experiments is one experiment of docs/experiments.md. `node_parameters` turns
one into the parameters of the three nodes that carry it out, for the runner and for the launch
files alike. No ROS here.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import yaml

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_hardware.topics import TORQUE_FRAME, joints_of
from cg_sysid.excitation import ExcitationSettings

MODES = ('lockstep', 'real_time')
NOMINAL_MODEL = 'compass_gait_mit'
MEASUREMENT_TOPIC = {'compass_gait': '/imu'}


class ExperimentError(ValueError):
    """An experiment that does not exist, is wrong, or did not go through."""


@dataclass(frozen=True)
class Experiment:
    """One experiment.

    Attributes:
        name: Name of its file.
        setup: What is done to the rig.
        initial_state: Coordinates in rad, then rates in rad/s.
        duration: Length in s.
        excitation: Settings of the excitation, less duration and seed.
        description: What it is good for.
    """

    name: str
    setup: Setup
    initial_state: tuple[float, ...]
    duration: float
    excitation: Mapping[str, Any]
    description: str = ''


def experiments_directory() -> Path:
    """Where the experiment files are: beside the sources, or in the installed share directory."""
    package = Path(__file__).resolve().parent
    candidates = [package.parent / 'config' / 'experiments']
    candidates += [
        parent / 'share' / 'cg_bringup' / 'config' / 'experiments' for parent in package.parents
    ]
    for candidate in candidates:
        if candidate.is_dir():
            return candidate
    raise ExperimentError(f'no directory of experiments beside or above {package}')


def experiment_names() -> list[str]:
    """Names of all experiments."""
    return sorted(path.stem for path in experiments_directory().glob('*.yaml'))


def load_experiment(name: str) -> Experiment:
    """The experiment of that name, or in the file of that path.

    Raises:
        ExperimentError: naming what is wrong and what is allowed.
    """
    path = Path(name) if name.endswith('.yaml') else experiments_directory() / f'{name}.yaml'
    try:
        entries = yaml.safe_load(path.read_text(encoding='utf-8'))
    except OSError:
        known = ', '.join(experiment_names())
        raise ExperimentError(f'no experiment {name!r}; there are: {known}') from None
    except yaml.YAMLError as error:
        raise ExperimentError(f'{path} is not YAML: {" ".join(str(error).split())}') from None
    return parse_experiment(path, entries)


def parse_experiment(path: Path, entries: Any) -> Experiment:
    """An experiment from the content of its file."""
    allowed = {field.name for field in fields(Experiment)} - {'name'}
    needed = allowed - {'description'}
    if not isinstance(entries, dict) or not needed <= set(entries) <= allowed:
        raise ExperimentError(
            f'{path}: expected the entries {", ".join(sorted(needed))} and maybe description'
        )
    excitation = dict(entries['excitation'])
    if excitation.get('kind') == 'file':
        excitation['file'] = str((path.parent / excitation['file']).resolve())
    try:
        ExcitationSettings(**excitation, duration=float(entries['duration']))
        setup = Setup.from_dict(entries['setup'])
    except (ValueError, TypeError) as error:
        raise ExperimentError(f'{path}: {error}') from None
    return Experiment(
        name=path.stem,
        setup=setup,
        initial_state=tuple(float(value) for value in entries['initial_state']),
        duration=float(entries['duration']),
        excitation=excitation,
        description=' '.join(str(entries.get('description', '')).split()),
    )


@dataclass(frozen=True)
class Run:
    """How an experiment is carried out once.

    Attributes:
        experiment: What is done.
        bag: Where it is recorded.
        model_file: Model of the simulated machine; None for the nominal one.
        note_model_file: Model that the recording note names; None for model_file.
        seed: Of the sensor noise and of the excitation: other seeds are other records.
        mode: 'lockstep' or 'real_time'.
        duration: Instead of that of the experiment, in s; None to keep it.
    """

    experiment: Experiment
    bag: Path
    model_file: Path | None = None
    note_model_file: Path | None = None
    seed: int = 1
    mode: str = 'lockstep'
    duration: float | None = None

    def __post_init__(self) -> None:
        if self.mode not in MODES:
            raise ExperimentError(f'mode is {self.mode!r}; allowed are {", ".join(MODES)}')

    @property
    def length(self) -> float:
        """Length of the record in s."""
        return self.experiment.duration if self.duration is None else self.duration

    @property
    def model_path(self) -> Path:
        """File of the simulated machine's model."""
        return self.model_file or model_path(NOMINAL_MODEL)


def node_parameters(run: Run) -> dict[str, dict[str, Any]]:
    """Node name -> its ROS parameters."""
    mechanism = Model.load(run.model_path).mechanism.name
    experiment = run.experiment
    return {
        'simulation_node': {
            'model_file': str(run.model_path),
            'note_model_file': str(run.note_model_file or ''),
            'setup': yaml.safe_dump(experiment.setup.to_dict()),
            'seed': run.seed,
            'mode': run.mode,
            'initial_state': list(experiment.initial_state),
            'duration': run.length,
            'recorders': 1,
            'experiment': experiment.name,
            'exit_when_done': True,
        },
        'excitation': {
            **experiment.excitation,
            'duration': run.length,
            'seed': run.seed,
            'measurement_topic': MEASUREMENT_TOPIC.get(mechanism, '/joint_states'),
            'joints': list(joints_of(mechanism)),
            'frame_id': TORQUE_FRAME[mechanism],
            'listeners': 2,
        },
        'recorder': {
            'bag': str(run.bag),
            'mechanism': mechanism,
            'time': 'stamp' if run.mode == 'lockstep' else 'receipt',
        },
    }


NODE_MODULES = {
    'recorder': ('cg_sysid', 'recorder_node'),
    'excitation': ('cg_sysid', 'excitation_node'),
    'simulation_node': ('cg_hardware', 'simulation_node'),
}


def parameter_file_text(parameters: Mapping[str, Mapping[str, Any]]) -> str:
    """The text of a ROS parameter file."""
    tree = {node: {'ros__parameters': dict(values)} for node, values in parameters.items()}
    return yaml.safe_dump(tree, sort_keys=False)
