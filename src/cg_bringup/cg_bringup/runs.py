"""How an experiment is carried out: the parameters of its three nodes.

For the runner and for the launch files alike. No ROS here.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_hardware.topics import MEASUREMENT, TORQUE_FRAME, joints_of
from cg_sysid.experiments import Experiment, ExperimentError

MODES = ('lockstep', 'real_time')
NOMINAL_MODEL = 'compass_gait_mit'


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
            'measurement_topic': MEASUREMENT[mechanism],
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
