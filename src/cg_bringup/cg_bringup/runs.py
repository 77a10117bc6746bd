"""What is started: a node with its parameters, and the three nodes of an experiment.

For the runners and for the launch files alike. No ROS here.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_interfaces import channels
from cg_sysid.experiments.catalogue import Experiment, ExperimentError

MODES = ('lockstep', 'real_time')  # of the simulated machine
WIRED = 'wired'  # the machine is a real robot that is running
PATIENCE = 60.0  # s without progress; on a busy machine processes take that long to start
PEERS = 45.0  # s by which the nodes of a run may start apart
CHECKLISTS = Path('checklists')
ENDING = 5.0  # s that a node has to end in when it is told to
CLOSING = 120.0  # s that the recorder may take to close its bag
ENCLAVES = '/compass_gait'  # below it, where SROS2 finds key and permissions of a node by its name


@dataclass(frozen=True)
class NodeOf:
    """A node to start.

    Attributes:
        package: Package of its executable.
        executable: Name of executable and module.
        parameters: ROS parameters.
        remappings: (from, to) of topics.
        ending: Time in s that it has to end in when it is told to.
    """

    package: str
    executable: str
    parameters: dict[str, Any]
    remappings: tuple[tuple[str, str], ...] = ()
    ending: float = ENDING


@dataclass(frozen=True)
class Run:
    """How an experiment is carried out once.

    Attributes:
        experiment: What is done.
        bag: Where it is recorded.
        model_file: Model of the simulated machine, or of what the real one is believed to be, by
            path or name; None for the nominal one.
        note_model_file: Model that the recording note names; None for model_file.
        seed: Of the sensor noise and of the excitation: other seeds are other records.
        mode: 'lockstep' or 'real_time' of a simulated machine, 'wired' of a real one.
        duration: Instead of that of the experiment, in s; None to keep it.
        checklists: Wired: folder of the records of checklists, which the note names.
    """

    experiment: Experiment
    bag: Path
    model_file: Path | None = None
    note_model_file: Path | None = None
    seed: int = 1
    mode: str = 'lockstep'
    duration: float | None = None
    checklists: Path = CHECKLISTS

    def __post_init__(self) -> None:
        if self.mode not in (*MODES, WIRED):
            allowed = ', '.join((*MODES, WIRED))
            raise ExperimentError(f'mode is {self.mode!r}; allowed are {allowed}')

    @property
    def length(self) -> float:
        """Length of the record in s."""
        return self.experiment.duration if self.duration is None else self.duration

    @property
    def model_path(self) -> Path:
        """File of the simulated machine's model."""
        return model_path(self.model_file or NOMINAL_MODEL)


def experiment_nodes(run: Run) -> dict[str, NodeOf]:
    """Node name -> what to start, the machine first and the recorder, which hears it all, last."""
    if run.mode == WIRED:
        return wired_nodes(run)
    mechanism = Model.load(run.model_path).mechanism.name
    experiment = run.experiment
    excitation = {
        **experiment.excitation,
        'duration': run.length,
        'seed': run.seed,
        'measurement_topic': channels.mechanism(mechanism).measurement,
        'joints': list(channels.mechanism(mechanism).joints),
        'frame_id': channels.mechanism(mechanism).torque.frame_id,
        'listeners': 2,
    }
    machine = {
        'model_file': str(run.model_path),
        'note_model_file': str(run.note_model_file or ''),
        'setup': yaml.safe_dump(experiment.setup.to_dict()),
        'seed': run.seed,
        'mode': run.mode,
        'initial_state': list(experiment.initial_state),
        'duration': run.length,
        'recorders': 1,
        'peer_timeout': PEERS,
        'experiment': experiment.name,
        'exit_when_done': True,
    }
    recorder = {
        'bag': str(run.bag),
        'mechanism': mechanism,
        'time': 'stamp' if run.mode == 'lockstep' else 'receipt',
    }
    return {
        'simulation_node': NodeOf('cg_hardware', 'simulation_node', machine),
        'excitation': NodeOf('cg_sysid', 'excitation_node', excitation),
        'recorder': NodeOf('cg_sysid', 'recorder_node', recorder, ending=CLOSING),
    }


def enclave_arguments(name: str) -> list[str]:
    """ROS arguments that put a node into its enclave; without SROS2 they change nothing."""
    return ['--enclave', f'{ENCLAVES}/{name}']


def wired_nodes(run: Run) -> dict[str, NodeOf]:
    """The same on a real robot that is running: its experimenter, and the recorder."""
    experimenter = {
        'task': 'experiment',
        'experiment': run.experiment.source or run.experiment.name,
        'duration': run.length,
        'seed': run.seed,
        'model_file': str(run.model_path),
        'checklists': str(run.checklists),
        'yes': True,
    }
    recorder = {'bag': str(run.bag), 'mechanism': 'compass_gait', 'time': 'receipt'}
    return {
        'experimenter': NodeOf('cg_bringup', 'experimenter_node', experimenter),
        'recorder': NodeOf('cg_sysid', 'recorder_node', recorder, ending=CLOSING),
    }


def parameter_file_text(nodes: Mapping[str, NodeOf]) -> str:
    """The text of a ROS parameter file for these nodes."""
    tree = {name: {'ros__parameters': dict(node.parameters)} for name, node in nodes.items()}
    return yaml.safe_dump(tree, sort_keys=False)
