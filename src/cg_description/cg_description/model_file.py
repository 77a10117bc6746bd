"""Model files: one YAML file holds every number of a robot, with unit and source.

This module knows the form of the file (what is required, that numbers are numbers, that a file
is written whole or not at all). What the numbers mean, and which are allowed, is known where the
physics is, in cg_dynamics.
"""

import hashlib
import math
import os
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

FORMAT = 'cg_model/1'


class ModelFileError(ValueError):
    """A model file that cannot be used; the message says what, where and what is allowed."""


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
        """The mapping that `quantity` reads back."""
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
    """

    name: str
    mechanism: str
    parameters: dict[str, Quantity]
    effects: tuple[EffectEntry, ...] = ()
    sensors: dict[str, dict[str, Quantity]] = field(default_factory=dict)
    actuators: dict[str, dict[str, Quantity]] = field(default_factory=dict)
    description: str = ''
    provenance: dict[str, Any] = field(default_factory=dict)


def quantity(entry: Any, where: str) -> Quantity:
    """Read one quantity, `{value: 1.0, unit: m, ...}`.

    Raises:
        ModelFileError: if it has another form.
    """
    if not isinstance(entry, dict) or 'value' not in entry or 'unit' not in entry:
        raise ModelFileError(f'{where}: expected {{value: <number>, unit: <text>}}, got {entry!r}')
    unknown = set(entry) - {'value', 'unit', 'tolerance', 'fixed', 'source'}
    if unknown:
        raise ModelFileError(
            f'{where}: unknown entry {sorted(unknown)[0]!r}; '
            'allowed are value, unit, tolerance, fixed, source'
        )
    return Quantity(
        value=_number(entry['value'], f'{where}.value', finite=False),
        unit=str(entry['unit']),
        tolerance=None
        if entry.get('tolerance') is None
        else _number(entry['tolerance'], f'{where}.tolerance'),
        fixed=bool(entry.get('fixed', False)),
        source=str(entry.get('source', '')),
    )


def parse(text: str, where: str = 'model') -> ModelFile:
    """Read the text of a model file.

    Raises:
        ModelFileError: naming the entry that is wrong and what is allowed there.
    """
    try:
        tree = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ModelFileError(f'{where}: not YAML: {" ".join(str(error).split())}') from None
    if not isinstance(tree, dict):
        raise ModelFileError(f'{where}: expected a mapping with format: {FORMAT}')
    if tree.get('format') != FORMAT:
        raise ModelFileError(f'{where}: format is {tree.get("format")!r}, expected {FORMAT!r}')
    for key in ('name', 'mechanism', 'parameters'):
        if key not in tree:
            raise ModelFileError(f'{where}: {key!r} is missing')
    allowed = {'format', *ModelFile.__dataclass_fields__}
    for key in tree:
        if key not in allowed:
            raise ModelFileError(f'{where}: unknown entry {key!r}; allowed: {sorted(allowed)}')
    return ModelFile(
        name=str(tree['name']),
        mechanism=str(tree['mechanism']),
        parameters=_quantities(tree['parameters'], f'{where}: parameters'),
        effects=tuple(
            _effect(entry, f'{where}: effects[{index}]')
            for index, entry in enumerate(tree.get('effects') or ())
        ),
        sensors={
            name: _quantities(entry, f'{where}: sensors.{name}')
            for name, entry in (tree.get('sensors') or {}).items()
        },
        actuators={
            name: _quantities(entry, f'{where}: actuators.{name}')
            for name, entry in (tree.get('actuators') or {}).items()
        },
        description=str(tree.get('description', '')),
        provenance=dict(tree.get('provenance') or {}),
    )


def load(path: str | Path) -> ModelFile:
    """Read a model file from disk.

    Raises:
        ModelFileError: if it is missing, unreadable or wrong.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise ModelFileError(f'cannot read model file {path}: {error}') from None
    return parse(text, str(path))


def dump(model: ModelFile) -> str:
    """The text of a model file; `parse` reads it back to an equal `ModelFile`."""
    tree: dict[str, Any] = {
        'format': FORMAT,
        'name': model.name,
        'mechanism': model.mechanism,
        'description': model.description,
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
    return yaml.safe_dump(tree, sort_keys=False, allow_unicode=True, width=99)


def save(model: ModelFile, path: str | Path) -> None:
    """Write a model file, whole or not at all."""
    write_atomically(path, dump(model))


def write_atomically(path: str | Path, text: str) -> None:
    """Write text to path through a temporary file in the same directory."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.')
    try:
        with os.fdopen(handle, 'w', encoding='utf-8') as file:
            file.write(text)
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


def _number(value: Any, where: str, finite: bool = True) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ModelFileError(f'{where}: expected a number, got {value!r}')
    if math.isnan(value) or (finite and math.isinf(value)):
        raise ModelFileError(f'{where}: expected a finite number, got {value!r}')
    return float(value)


def _quantities(entries: Any, where: str) -> dict[str, Quantity]:
    if not isinstance(entries, dict):
        raise ModelFileError(f'{where}: expected a mapping of quantities, got {entries!r}')
    return {str(name): quantity(entry, f'{where}.{name}') for name, entry in entries.items()}


def _effect(entry: Any, where: str) -> EffectEntry:
    if not isinstance(entry, dict) or 'name' not in entry:
        raise ModelFileError(f'{where}: expected {{name: <effect>, parameters: ...}}')
    unknown = set(entry) - {'name', 'at', 'parameters'}
    if unknown:
        raise ModelFileError(
            f'{where}: unknown entry {sorted(unknown)[0]!r}; allowed are name, at, parameters'
        )
    return EffectEntry(
        name=str(entry['name']),
        at=None if entry.get('at') is None else str(entry['at']),
        parameters=_quantities(entry.get('parameters') or {}, f'{where}.parameters'),
    )
