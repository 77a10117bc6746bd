"""Experiments as data: which set-up, start, excitation and duration.

Each file of config/experiments is one experiment of experiments.md. No ROS here.
"""

from collections.abc import Mapping
from dataclasses import Field, dataclass, fields, replace
from pathlib import Path
from typing import Any

from cg_description.reading import parse_yaml, path_below, path_of, read_text
from cg_description.schema import Key, Kind, ListOf, Number, Text, Whole
from cg_description.schema import Mapping as Form
from cg_dynamics import rig
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.experiments.excitation import ExcitationSettings


class ExperimentError(ValueError):
    """An experiment that does not exist, is wrong, or did not go through."""


def _kind_of(field: Field) -> Kind:
    """What a setting may be in a file; its bounds are the settings' own to check."""
    return {str: Text(), int: Whole(0), float: Number()}[type(field.default)]


SCHEMA = Form({
    'setup': Key(replace(rig.SCHEMA, fill=False), 'what is done to the rig'),
    'initial_state': Key(ListOf(Number()), 'coordinates, then rates', unit='rad, rad/s'),
    'duration': Key(Number(positive=True), unit='s'),
    'excitation': Key(Form({
        field.name: Key(_kind_of(field), default=field.default)
        for field in fields(ExcitationSettings)
        if field.name != 'duration'
    }, fill=False)),
    'description': Key(Text(), default=''),
})  # fmt: skip


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
        source: Its file.
    """

    name: str
    setup: Setup
    initial_state: tuple[float, ...]
    duration: float
    excitation: Mapping[str, Any]
    description: str = ''
    source: str = ''


def experiments_directory() -> Path:
    """Where the experiment files are: beside the sources, or in the installed share directory."""
    package = Path(__file__).resolve().parents[1]
    candidates = [package.parent / 'config' / 'experiments']
    candidates += [
        parent / 'share' / 'cg_sysid' / 'config' / 'experiments' for parent in package.parents
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
    path = path_of(name, ExperimentError)
    if path.name == name and path.suffix != '.yaml':
        path = experiments_directory() / f'{name}.yaml'
    if not path.is_file():
        known = ', '.join(experiment_names())
        raise ExperimentError(f'no experiment {name!r}; there are: {known}')
    text = read_text(path, ExperimentError)
    return parse_experiment(path, parse_yaml(text, str(path), ExperimentError))


def experiments_for(model: Model) -> list[Experiment]:
    """All experiments that a machine like this model can be put to."""
    found = []
    for name in experiment_names():
        experiment = load_experiment(name)
        try:
            free = model.mechanism.kinematics(experiment.setup).basis.shape[1]
        except (DynamicsError, ValueError, KeyError):
            continue
        if len(experiment.initial_state) == 2 * free:
            found.append(experiment)
    return found


def parse_experiment(path: Path, entries: Any) -> Experiment:
    """An experiment from the content of its file."""
    tree = SCHEMA.of(entries, str(path), ExperimentError)
    excitation = tree['excitation']
    if excitation.get('kind') == 'file' and excitation.get('file'):
        named = excitation['file']
        file = path_below(path.parent, named, f'{path}: excitation.file', ExperimentError)
        excitation['file'] = str(file.resolve())
    try:
        ExcitationSettings(**excitation, duration=tree['duration'])
        setup = Setup.from_dict(tree['setup'])
    except ValueError as error:
        raise ExperimentError(f'{path}: {error}') from None
    return Experiment(
        name=path.stem,
        setup=setup,
        initial_state=tuple(tree['initial_state']),
        duration=tree['duration'],
        excitation=excitation,
        description=' '.join(tree['description'].split()),
        source=str(path.resolve()),
    )
