"""A model: mechanism, effects and their numbers. The one thing that all other packages load."""

import functools
import math
from collections.abc import Mapping
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from cg_description.model_file import (
    EffectEntry,
    ModelFile,
    ModelFileError,
    Quantity,
    dump,
    load,
    parse,
    sha256,
    write_atomically,
)
from cg_description.paths import model_path
from cg_description.reading import shown
from cg_description.schema import meant
from cg_dynamics.effects import LIBRARY, Effect, make_effect
from cg_dynamics.errors import ModelError
from cg_dynamics.mechanisms import Mechanism, mechanism
from cg_dynamics.parameter import Parameter


@dataclass(frozen=True)
class Model:
    """A robot as numbers and physics. Immutable: every change returns a new model.

    Mappings are copied when a model is made and cannot be written to, so what is computed from
    them once stays true.

    Attributes:
        name: Name of the robot.
        mechanism: Its rigid bodies.
        effects: Effects, in the order in which they act.
        quantities: Full parameter name -> number with unit and source. A parameter of the
            mechanism goes by its own name ('c1'), one of an effect by 'label.name'
            ('coulomb_friction.torque').
        sensors: Channel -> quantities 'noise', 'resolution' (both optional).
        actuators: Input channel -> quantity 'limit' (optional).
        description: Free text.
        provenance: Where the model comes from.
    """

    name: str
    mechanism: Mechanism
    effects: tuple[Effect, ...]
    quantities: Mapping[str, Quantity]
    sensors: Mapping[str, Mapping[str, Quantity]]
    actuators: Mapping[str, Mapping[str, Quantity]]
    description: str
    provenance: Mapping[str, Any]

    def __post_init__(self):
        provenance = self.provenance
        if not isinstance(provenance, MappingProxyType):
            provenance = MappingProxyType(deepcopy(dict(provenance)))
        read_only = {
            'quantities': MappingProxyType(dict(self.quantities)),
            'sensors': _entries_read_only(self.sensors),
            'actuators': _entries_read_only(self.actuators),
            'provenance': provenance,
        }
        for name, mapping in read_only.items():
            object.__setattr__(self, name, mapping)

    def __reduce__(self):
        # Read-only mappings do not travel between processes; __post_init__ makes them again.
        content = self.to_file()
        return Model, (
            self.name, self.mechanism, self.effects, dict(self.quantities), content.sensors,
            content.actuators, self.description, content.provenance,
        )  # fmt: skip

    @classmethod
    def load(cls, path: str | Path) -> 'Model':
        """Read a model file.

        Args:
            path: Path of the file, or the name of one that comes along ('compass_gait_mit').

        Raises:
            ModelFileError, ModelError: naming the file, the entry and what is allowed there.
        """
        path = model_path(path)
        return cls.from_file(load(path), str(path))

    @classmethod
    def from_text(cls, text: str, where: str = 'model') -> 'Model':
        """Read the text of a model file, e.g. as it travels with a bag."""
        return cls.from_file(parse(text, where), where)

    @classmethod
    def from_file(cls, file: ModelFile, where: str = 'model') -> 'Model':
        """Give meaning to a model file: known names, right units, values in range."""
        try:
            body = mechanism(file.mechanism, file.robot)
            quantities = _match(
                body.parameters, file.parameters, 'parameters', needed=file.robot is None
            )
            effects: list[Effect] = []
            for index, entry in enumerate(file.effects):
                place = f'effects[{index}]'
                effect = _effect(entry, body, place)
                if any(effect.label == other.label for other in effects):
                    raise ModelError(f'{place}: effect {effect.label!r} is listed twice')
                effects.append(effect)
                found = _match(effect.parameters, entry.parameters, f'{place}.parameters')
                quantities |= {f'{effect.label}.{name}': q for name, q in found.items()}
            _known('sensors', file.sensors, body.outputs)
            _known('actuators', file.actuators, body.inputs)
            for channel, unit in zip(body.outputs, body.output_units, strict=True):
                for name, q in file.sensors.get(channel, {}).items():
                    _same_unit(f'sensors.{channel}.{name}', q.unit, unit)
                    right = 0 <= q.value < math.inf if name == 'noise' else 0 < q.value < math.inf
                    _require(
                        right,
                        f'sensors.{channel}.{name}.value',
                        q,
                        'a finite number of 0 or more'
                        if name == 'noise'
                        else 'a positive finite number',
                    )
            for channel, unit in zip(body.inputs, body.input_units, strict=True):
                for name, q in file.actuators.get(channel, {}).items():
                    _same_unit(f'actuators.{channel}.{name}', q.unit, unit)
                    _require(
                        q.value > 0, f'actuators.{channel}.{name}.value', q, 'a positive number'
                    )
        except ModelError as error:
            raise ModelError(f'{where}: {error}') from None
        model = cls(
            name=file.name,
            mechanism=body,
            effects=tuple(effects),
            quantities=quantities,
            sensors=file.sensors,
            actuators=file.actuators,
            description=file.description,
            provenance=file.provenance,
        )
        model.require_consistency(where)
        return model

    def to_file(self) -> ModelFile:
        """The content that `from_file` reads back."""
        robot = self.mechanism.robot()
        return ModelFile(
            name=self.name,
            mechanism=self.mechanism.name,
            robot=robot,
            parameters={
                p.name: self.quantities[p.name]
                for p in self.mechanism.parameters
                if robot is None or self.quantities[p.name] != _usual(p)
            },
            effects=tuple(
                EffectEntry(
                    effect.name,
                    effect.at,
                    {
                        p.name: q
                        for p in effect.parameters
                        if not _says_nothing(p, q := self.quantities[f'{effect.label}.{p.name}'])
                    },
                )
                for effect in self.effects
            ),
            sensors={c: dict(q) for c, q in self.sensors.items()},
            actuators={c: dict(q) for c, q in self.actuators.items()},
            description=self.description,
            provenance=dict(self.provenance),
        )

    def text(self) -> str:
        """The text of the model file."""
        return dump(self.to_file())

    def save(self, path: str | Path) -> None:
        """Write the model file, whole or not at all."""
        write_atomically(path, self.text())

    @functools.cached_property
    def hash(self) -> str:
        """SHA-256 of the text: the name by which bags and trajectories know this model."""
        return sha256(self.text())

    @property
    def values(self) -> dict[str, float]:
        """Full parameter name -> value."""
        return {name: q.value for name, q in self.quantities.items()}

    @property
    def declarations(self) -> dict[str, Parameter]:
        """Full parameter name -> declaration, in the order of the parameter vector."""
        found = {p.name: p for p in self.mechanism.parameters}
        for effect in self.effects:
            found |= {f'{effect.label}.{p.name}': p for p in effect.parameters}
        return found

    @property
    def torque_limit(self) -> float:
        """Smallest stated limit of the actuators, in their unit; infinite if none is stated."""
        limits = [q['limit'].value for q in self.actuators.values() if 'limit' in q]
        return min(limits, default=float('inf'))

    def effect(self, label: str) -> Effect:
        """The effect with that label."""
        for effect in self.effects:
            if effect.label == label:
                return effect
        raise ModelError(
            f'model {self.name!r} has no effect {label!r}; it has: '
            f'{", ".join(e.label for e in self.effects) or "none"}'
        )

    def dry_friction(self, joint: str) -> float:
        """Level of all dry friction at a joint together, N m (N where it slides)."""
        return sum(
            abs(self.values[f'{e.label}.{e.parameters[0].name}'])
            for e in self.effects
            if e.friction == 'dry' and e.site == joint and e.parameters[0].unit in ('N m', 'N')
        )

    def values_of(self, effect: Effect) -> dict[str, float]:
        """The values of one effect's own parameters, by their names within it."""
        return {
            p.name: self.quantities[f'{effect.label}.{p.name}'].value for p in effect.parameters
        }

    def with_effect(self, name: str, at: str | None = None, **values: float) -> 'Model':
        """This model and one more effect; parameters not given take their defaults."""
        effect = make_effect(name, self.mechanism, at)
        if any(effect.label == other.label for other in self.effects):
            raise ModelError(f'model {self.name!r} already has the effect {effect.label!r}')
        _known(effect.label, values, [p.name for p in effect.parameters])
        quantities = dict(self.quantities)
        for p in effect.parameters:
            value = p.check(float(values.get(p.name, p.default)), effect.label)
            quantities[f'{effect.label}.{p.name}'] = Quantity(value, p.unit, fixed=not p.free)
        return replace(self, effects=(*self.effects, effect), quantities=quantities)

    def without_effect(self, label: str) -> 'Model':
        """This model less one effect."""
        gone = self.effect(label)
        return replace(
            self,
            effects=tuple(e for e in self.effects if e is not gone),
            quantities={
                name: q for name, q in self.quantities.items() if not name.startswith(f'{label}.')
            },
        )

    def with_values(self, values: Mapping[str, float]) -> 'Model':
        """This model with other numbers; units, tolerances and sources stay.

        Raises:
            ModelError: for an unknown name or a value out of range.
        """
        declared = self.declarations
        _known('parameters', values, declared)
        quantities = dict(self.quantities)
        for name, value in values.items():
            declared[name].check(float(value), name.rpartition('.')[0] or self.name)
            quantities[name] = replace(quantities[name], value=float(value))
        return replace(self, quantities=quantities)

    def require_consistency(self, where: str = 'model') -> None:
        """Refuse numbers that no real bodies can have (conventions.md, "Lumps").

        Raises:
            ModelError: if a consistency condition is broken.
        """
        # Numbers that divide by zero to infinity: a condition says of itself that it is broken.
        with np.errstate(divide='ignore', invalid='ignore'):
            values = {name: np.float64(value) for name, value in self.values.items()}
            conditions = self.mechanism.consistency(values)
        for index, value in enumerate(conditions):
            if not value > 0:
                raise ModelError(
                    f'{where}: no real bodies have these parameters: condition {index + 1} of '
                    f'the {self.mechanism.name} (conventions.md, "Lumps") is {value:.3g}, '
                    'it must be positive'
                )


def _effect(entry: EffectEntry, body: Mechanism, place: str) -> Effect:
    try:
        return make_effect(entry.name, body, entry.at)
    except ModelError as error:
        hint = '' if entry.name in LIBRARY else meant(entry.name, LIBRARY)
        raise ModelError(f'{place}: {error}{hint}') from None


def _says_nothing(declared: Parameter, q: Quantity) -> bool:
    """Whether a shape of a law is as it always is.

    It stays out of files: a law that gets a shape more is still the law by whose hash bags and
    trees know the model. Not so the rate over which dry friction turns: simulators differ in it.
    """
    return bool(declared.leeway) and not declared.smoothing and q == _usual(declared)


def _usual(p: Parameter) -> Quantity:
    """What a file means that does not name a parameter.

    A number of a URDF's body is believed as far as its scale.
    """
    believed = p.scale if p.belief else None
    return Quantity(p.default, p.unit, believed, fixed=not p.free)


def _entries_read_only(channels):
    return MappingProxyType({c: MappingProxyType(dict(q)) for c, q in channels.items()})


def _match(
    declared: tuple[Parameter, ...],
    given: Mapping[str, Quantity],
    place: str,
    needed: bool = False,
) -> dict[str, Quantity]:
    """Quantities as declared; a mechanism needs all of them, an effect has typical ones."""
    _known(place, given, [p.name for p in declared])
    found = {}
    for p in declared:
        if p.name not in given:
            if needed:
                raise ModelError(f'{place}.{p.name} ({p.unit}, {p.description}) is missing')
            found[p.name] = _usual(p)
            continue
        q = given[p.name]
        _same_unit(f'{place}.{p.name}', q.unit, p.unit)
        p.check(q.value, place)
        found[p.name] = q
    return found


def _require(right: bool, place: str, q: Quantity, allowed: str) -> None:
    if not right:
        raise ModelError(f'{place}: {q.value:g} is not allowed; {allowed} is needed')


def _same_unit(place: str, unit: str, expected: str) -> None:
    if unit != expected:
        raise ModelError(f'{place}.unit: {shown(unit)} is not {expected!r}')


def _known(place: str, names, allowed) -> None:
    for name in names:
        if name not in allowed:
            raise ModelError(
                f'{place}: unknown entry {shown(name)}; allowed: '
                f'{", ".join(allowed)}{meant(name, allowed)}'
            )


__all__ = ['Model', 'ModelError', 'ModelFileError']
