"""A machine that is not what its model says: an effect nobody told the analysis, and other lumps.

Drawn from a seed, so that every demonstration can be repeated.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cg_description.reading import parse_yaml, read_text
from cg_description.schema import Anything, ListOf, MapOf
from cg_dynamics.effects import LIBRARY
from cg_dynamics.errors import ModelError
from cg_dynamics.model import Model
from cg_sysid.experiments.catalogue import ExperimentError

DRAWS = 200  # attempts to perturb the lumps such that real bodies can have them


@dataclass(frozen=True)
class Hidden:
    """What the simulated hardware is, and the analysis does not know.

    Attributes:
        nominal: What the analysis is to believe in.
        model: The machine.
        effect: Name of the hidden effect.
        values: Its parameters, in the units of the effect library.
        factors: Parameter of the nominal model -> true value over nominal value.
    """

    nominal: Model
    model: Model
    effect: str
    values: dict[str, float]
    factors: dict[str, float]


def hidden_effects_file() -> Path:
    """The file of effects and magnitudes to draw from."""
    package = Path(__file__).resolve().parent
    beside = package.parent / 'config' / 'hidden_effects.yaml'
    shared = (p / 'share' / 'cg_bringup' / 'config' / beside.name for p in package.parents)
    return next((path for path in (beside, *shared) if path.is_file()), beside)


def _table() -> dict[str, Any]:
    path = hidden_effects_file()
    return MapOf(MapOf(ListOf(Anything()))).of(parse_yaml(read_text(path), str(path)), str(path))


def hideable_effects(nominal: Model) -> list[str]:
    """Effects of the file that the library knows, and those that the nominal model has."""
    table = _table()
    present = [effect.label for effect in nominal.effects]
    return [name for name in table if name in LIBRARY and name not in present] + present


def hide(nominal: Model, effect: str | None, seed: int) -> Hidden:
    """Make the hidden machine.

    An effect that the nominal model has is hidden by leaving it out of the nominal model.

    Args:
        nominal: The robot as it is known.
        effect: Effect to hide; None to draw one.
        seed: Of everything that is drawn.

    Raises:
        ExperimentError: There is no such effect to hide.
    """
    rng = np.random.default_rng(seed)
    names = hideable_effects(nominal)
    drawn = str(rng.choice(names))
    name = drawn if effect is None else effect
    if name not in names:
        raise ExperimentError(f'no effect {name!r} to hide; there are: {", ".join(names)}')
    if any(name == present.label for present in nominal.effects):
        model, factors = perturb(nominal, rng)
        values = {p.name: model.values[f'{name}.{p.name}'] for p in LIBRARY[name].parameters}
        return Hidden(nominal.without_effect(name), model, name, values, factors)
    table = _table()
    values = draw_values(table[name], rng)
    model, factors = perturb(nominal, rng)
    return Hidden(nominal, model.with_effect(name, None, **values), name, values, factors)


def draw_values(ranges: dict[str, Any], rng: np.random.Generator) -> dict[str, float]:
    """Values from their ranges, log-uniformly, with a random sign where one is allowed."""
    signed = ranges.get('signed', ())
    values = {}
    for name, bounds in ranges.items():
        if name == 'signed':
            continue
        value = float(np.exp(rng.uniform(*np.log(bounds))))
        values[name] = value * float(rng.choice((-1.0, 1.0))) if name in signed else value
    return values


def perturb(nominal: Model, rng: np.random.Generator) -> tuple[Model, dict[str, float]]:
    """The model with every believed number off by 10 to 20 %, either way.

    Returns:
        The model, and parameter -> factor.
    """
    free = [name for name, q in nominal.quantities.items() if q.tolerance and not q.fixed]
    for _ in range(DRAWS):
        shares = rng.uniform(0.1, 0.2, len(free)) * rng.choice((-1.0, 1.0), len(free))
        factors = {name: 1.0 + float(share) for name, share in zip(free, shares, strict=True)}
        model = nominal.with_values(
            {name: nominal.values[name] * factor for name, factor in factors.items()}
        )
        try:
            model.require_consistency()
        except ModelError:
            continue
        return model, factors
    raise ExperimentError(f'no consistent perturbation of {nominal.name} in {DRAWS} draws')
