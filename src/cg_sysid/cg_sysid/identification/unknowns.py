"""What an identification moves: parameters, what is believed of them, and in which coordinate."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cg_dynamics.model import Model
from cg_dynamics.parameter import Parameter

RELATIVE_TOLERANCE = 0.15  # of a value whose file states no tolerance
OWN_SPREAD = 100.0  # scales by which a record's own value may lie from its first guess


class IdentificationError(ValueError):
    """An identification that cannot be done; the message says why."""


NOTHING = 1e-300  # instead of 0, of which there is no logarithm


@dataclass(frozen=True)
class Unknown:
    """A shared parameter to be identified, in the coordinate in which it is moved.

    Attributes:
        name: Full parameter name.
        unit: SI unit.
        prior: Centre of what the model file believes.
        tolerance: Standard deviation of that belief; infinite where there is none. For a
            logarithmic unknown it is relative.
        lower: Smallest allowed value.
        upper: Largest allowed value.
        logarithmic: Moved as log(value).
        scale: Typical change, for damping.
        each: What has a value of its own, 'record' or 'recording'; empty for a shared one.
    """

    name: str
    unit: str
    prior: float
    tolerance: float
    lower: float
    upper: float
    logarithmic: bool
    scale: float
    each: str = ''

    def to_coordinate(self, value: float) -> float:
        """Value -> coordinate."""
        return float(np.log(value)) if self.logarithmic else value

    @property
    def ends(self) -> tuple[float, float]:
        """Smallest and largest coordinate."""
        if not self.logarithmic:
            return self.lower, self.upper
        return self.to_coordinate(max(self.lower, NOTHING)), self.to_coordinate(self.upper)

    def to_value(self, coordinate: float) -> float:
        """Coordinate -> value."""
        value = float(np.exp(coordinate)) if self.logarithmic else float(coordinate)
        return min(max(value, self.lower), self.upper)


def unknowns_of(
    model: Model, only: Sequence[str] | None = None, bounds: Mapping[str, float] | None = None
) -> tuple[Unknown, ...]:
    """The parameters of a model that identification moves: declared free, not fixed in the file.

    Args:
        model: The model.
        only: Full names of those to move instead.
        bounds: Parameters that move by so much at most, free or not: full name -> largest
            distance from the model's value, in the coordinate in which it is moved. A smoothing
            never gets wider by more than its leeway.

    Raises:
        IdentificationError: if `only` names something that the model does not have.
    """
    declared = model.declarations
    if only is not None:
        for name in only:
            if name not in declared:
                raise IdentificationError(
                    f'no parameter {name!r} to identify; there are: {", ".join(declared)}'
                )
    found = []
    bounds = bounds or {}
    for name, parameter in declared.items():
        q = model.quantities[name]
        moved = not (q.fixed or not parameter.free) or name in bounds
        if parameter.each or not (moved if only is None else name in only):
            continue
        if not np.isfinite(q.value):
            continue
        if name in bounds:
            found.append(_bounded(name, parameter, q.value, bounds[name]))
            continue
        tolerance = q.tolerance
        if tolerance is None:
            belongs = '.' not in name
            tolerance = RELATIVE_TOLERANCE * abs(q.value) if belongs and q.value else np.inf
        if parameter.logarithmic and np.isfinite(tolerance):
            tolerance = tolerance / q.value
        found.append(
            Unknown(
                name, parameter.unit, q.value, tolerance, parameter.lower,
                parameter.upper, parameter.logarithmic, parameter.scale,
            )
        )  # fmt: skip
    return tuple(found)


def _bounded(name: str, parameter: Parameter, value: float, bound: float) -> Unknown:
    if parameter.logarithmic:
        up = min(bound, parameter.leeway) if parameter.smoothing else bound
        lower, upper = value * np.exp(-bound), value * np.exp(up)
    else:
        lower, upper = value - bound, value + bound
    return Unknown(
        name, parameter.unit, value, bound, max(lower, parameter.lower),
        min(upper, parameter.upper), parameter.logarithmic, parameter.scale,
    )  # fmt: skip


def own_unknowns(model: Model) -> tuple[Unknown, ...]:
    """The parameters of which every record or recording has a value of its own."""
    return tuple(
        Unknown(
            name, p.unit, model.values[name], OWN_SPREAD * p.scale, p.lower, p.upper, False,
            p.scale, p.each,
        )
        for name, p in model.declarations.items()
        if p.each
    )  # fmt: skip


def unsettled_states(model: Model) -> tuple[str, ...]:
    """Extra states of which every record has a start of its own, as none need have settled.

    Those of effects that happen not to act are among them.
    """
    return tuple(f'{effect.label}.{state}' for effect in model.effects for state in effect.states)


def awake(model: Model) -> Model:
    """The model with a little of what every record has of its own.

    At its neutral value an effect takes no part in the equations at all.
    """
    return model.with_values({u.name: u.scale for u in own_unknowns(model)})


def without_events(model: Model) -> Model:
    """The model without what happened in single records alone, such as a push."""
    for effect in model.effects:
        if any(p.each == 'record' for p in effect.parameters):
            model = model.without_effect(effect.label)
    return model
