"""Model files: one YAML file holds every number of a robot, with unit and source.

This module knows the form of the file (`SCHEMA`, the reference of which is model_file.md) and
writes files whole or not at all. What the numbers mean, and which are allowed, is known where the
physics is, in cg_dynamics.
"""

import hashlib
import os
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from cg_description.reading import DocumentError, parse_yaml, read_text
from cg_description.schema import NAME, Flag, Key, ListOf, MapOf, Mapping, Number, Text

FORMAT = 'cg_model/1'


class ModelFileError(DocumentError):
    """A model file that cannot be used; the message says what, where and what is allowed."""


QUANTITY = Mapping({
    'value': Key(Number(infinite=True), 'the number, in `unit`; `.inf` where it means rigid'),
    'unit': Key(NAME, "SI unit, spelt as in the tables below; '1' for a ratio"),
    'tolerance': Key(
        Number(0.0), 'one standard deviation of what is believed about the value; without one '
        'identification believes a number of the mechanism to 15 % and one of an effect not at '
        'all', default=None, unit='as `unit`',
    ),
    'fixed': Key(Flag(), 'true: identification leaves the number alone', default=False),
    'source': Key(Text(), 'where the number comes from', default=''),
})  # fmt: skip
EFFECT = Mapping({
    'name': Key(NAME, 'standard name of the effect ([effects.md](effects.md))'),
    'at': Key(
        NAME, 'joint, body or sensor that it acts on; the usual one of that effect if absent',
        default=None,
    ),
    'parameters': Key(
        MapOf(QUANTITY), 'its numbers; one that is absent takes the first value at which '
        'identification starts', default={},
    ),
})  # fmt: skip
SENSOR = Mapping({
    'noise': Key(QUANTITY, 'standard deviation of one sample', default=None,
                 unit='of the channel'),
    'resolution': Key(QUANTITY, 'smallest step, as one count of an encoder', default=None,
                      unit='of the channel'),
})  # fmt: skip
ACTUATOR = Mapping({
    'limit': Key(QUANTITY, 'largest torque either way; the drive clips to it, controllers and '
                 'planner stay below it', default=None, unit='N m; N along a rail'),
})  # fmt: skip
ROBOT = Mapping({
    'urdf': Key(Text(), 'the URDF itself; `cg new-robot` writes what matters of it'),
    'driven': Key(
        ListOf(NAME), 'joints and couplings with a drive; all joints that move by themselves if '
        'absent', default=None,
    ),
    'couplings': Key(
        MapOf(MapOf(Number())), 'motors that turn with several joints, as those of a differential '
        'do: motor -> joint -> rad that it turns, seen through its own gear, with each rad (m) of '
        'the joint', default=None,
    ),
    'rates': Key(Flag(), 'true: rates of the joints are measured as well', default=False),
})  # fmt: skip
SCHEMA = Mapping({
    'format': Key(Text((FORMAT,)), 'form of the file'),
    'name': Key(NAME, 'name of the robot'),
    'mechanism': Key(NAME, 'rigid bodies and joints, one of those below'),
    'description': Key(Text(), 'free text', default=''),
    'robot': Key(ROBOT, 'the robot of the mechanism `urdf`; no other has one', default=None),
    'parameters': Key(
        MapOf(QUANTITY), 'every number of the mechanism; of a `urdf` those that differ from it',
        default={},
    ),
    'effects': Key(ListOf(EFFECT), 'what the robot has beyond rigid bodies, in the order in '
                   'which it acts', default=()),
    'sensors': Key(MapOf(SENSOR), 'output channel -> how well it measures', default={}),
    'actuators': Key(MapOf(ACTUATOR), 'input channel -> what its drive can do', default={}),
    'provenance': Key(Mapping({}, further=True), 'where the file comes from; any keys',
                      default={}),
})  # fmt: skip


@dataclass(frozen=True)
class Quantity:
    """A number of the model file.

    Attributes:
        value: The number, in `unit`.
        unit: SI unit as written in the file, '1' for a ratio.
        tolerance: One standard deviation of what is believed about the value, in `unit`; None
            if the file does not say.
        fixed: True if identification must leave the number alone.
        source: Where the number comes from.
    """

    value: float
    unit: str
    tolerance: float | None = None
    fixed: bool = False
    source: str = ''

    def to_yaml(self) -> dict[str, Any]:
        """The mapping that `parse` reads back."""
        entry: dict[str, Any] = {'value': float(self.value), 'unit': self.unit}
        if self.tolerance is not None:
            entry['tolerance'] = float(self.tolerance)
        if self.fixed:
            entry['fixed'] = True
        if self.source:
            entry['source'] = self.source
        return entry


@dataclass(frozen=True)
class EffectEntry:
    """One effect as the file lists it: standard name, place (`at`) and quantities."""

    name: str
    at: str | None
    parameters: dict[str, Quantity]


@dataclass(frozen=True)
class ModelFile:
    """The content of a model file, checked for form.

    Attributes:
        name: Name of the robot.
        mechanism: Name of the rigid-body mechanism.
        parameters: Quantities of the mechanism.
        effects: Effects in the order in which they act.
        sensors: Channel -> quantities ('noise', 'resolution', 'delay').
        actuators: Channel -> quantities ('limit').
        description: Free text.
        provenance: Free mapping: where the file comes from.
        robot: What `ROBOT` says, of the mechanism 'urdf' alone.
    """

    name: str
    mechanism: str
    parameters: dict[str, Quantity]
    effects: tuple[EffectEntry, ...] = ()
    sensors: dict[str, dict[str, Quantity]] = field(default_factory=dict)
    actuators: dict[str, dict[str, Quantity]] = field(default_factory=dict)
    description: str = ''
    provenance: dict[str, Any] = field(default_factory=dict)
    robot: dict[str, Any] | None = None


def parse(text: str, where: str = 'model') -> ModelFile:
    """Read the text of a model file.

    Raises:
        ModelFileError: naming the entry that is wrong and what is allowed there.
    """
    tree = SCHEMA.of(parse_yaml(text, where, ModelFileError), where, ModelFileError)
    return ModelFile(
        name=tree['name'],
        mechanism=tree['mechanism'],
        parameters=_quantities(tree['parameters']),
        effects=tuple(
            EffectEntry(entry['name'], entry['at'], _quantities(entry['parameters']))
            for entry in tree['effects']
        ),
        sensors={channel: _quantities(entry) for channel, entry in tree['sensors'].items()},
        actuators={channel: _quantities(entry) for channel, entry in tree['actuators'].items()},
        description=tree['description'],
        provenance=dict(tree['provenance']),
        robot=tree['robot'],
    )


def load(path: str | Path) -> ModelFile:
    """Read a model file from disk.

    Raises:
        ModelFileError: if it is missing, unreadable or wrong.
    """
    return parse(read_text(path, ModelFileError), str(path))


class _Block(str):
    """A text of many lines that stands in the file as it is."""


class _Dumper(yaml.SafeDumper):
    """Safe YAML that knows blocks."""


_Dumper.add_representer(
    _Block, lambda dumper, text: dumper.represent_scalar('tag:yaml.org,2002:str', text, style='|')
)


def _robot(robot: dict[str, Any]) -> dict[str, Any]:
    """What `ROBOT` reads, without what is by default."""
    said = {name: robot[name] for name in ('driven', 'couplings', 'rates') if robot.get(name)}
    return {**said, 'urdf': _Block(robot['urdf'])}


def dump(model: ModelFile) -> str:
    """The text of a model file; `parse` reads it back to an equal `ModelFile`."""
    tree: dict[str, Any] = {
        'format': FORMAT,
        'name': model.name,
        'mechanism': model.mechanism,
        'description': model.description,
        **({'robot': _robot(model.robot)} if model.robot else {}),
        'parameters': {name: q.to_yaml() for name, q in model.parameters.items()},
        'effects': [
            {
                'name': effect.name,
                **({'at': effect.at} if effect.at else {}),
                'parameters': {name: q.to_yaml() for name, q in effect.parameters.items()},
            }
            for effect in model.effects
        ],
        'sensors': {
            channel: {name: q.to_yaml() for name, q in entries.items()}
            for channel, entries in model.sensors.items()
        },
        'actuators': {
            channel: {name: q.to_yaml() for name, q in entries.items()}
            for channel, entries in model.actuators.items()
        },
        'provenance': model.provenance,
    }
    return yaml.dump(tree, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=99)


def save(model: ModelFile, path: str | Path) -> None:
    """Write a model file, whole or not at all."""
    write_atomically(path, dump(model))


def write_atomically(path: str | Path, text: str | bytes) -> None:
    """Write text (as UTF-8) or bytes to path through a temporary file in the same directory."""
    path = Path(path)
    content = text.encode() if isinstance(text, str) else text
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.')
    try:
        with os.fdopen(handle, 'wb') as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        # mkstemp makes the file private; a model or report is as readable as its neighbours.
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


def sha256(text: str) -> str:
    """Hash by which bags and trajectories name the model they belong to."""
    return hashlib.sha256(text.encode()).hexdigest()


def _quantities(entries: dict[str, Any]) -> dict[str, Quantity]:
    return {name: Quantity(**entry) for name, entry in entries.items() if entry is not None}
