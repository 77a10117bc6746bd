"""What came of fitting a candidate: errors, numbers, events, and what speaks against it."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import Effect
from cg_dynamics.model import Model
from cg_dynamics.parameter import Parameter
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.unknowns import Unknown
from cg_sysid.search import settings
from cg_sysid.search.nuisance import Bounds
from cg_sysid.search.task import Task
from cg_sysid.text import measured


@dataclass(frozen=True)
class Outcome:
    """What fitting a task gave: fits on both sets and the residuals over noise."""

    task: Task
    label: str
    model: Model
    train: Fit
    held: Fit
    residuals: tuple[np.ndarray, ...] = field(repr=False)
    belief: float
    unknowns: float
    events: Mapping[str, Mapping[str, float]]
    data_sets: tuple[tuple[str, ...], tuple[str, ...]]  # names of those trained on and held out


def chi2(o: Outcome) -> float:
    """Squared error over noise variance, training and held-out data sets together."""
    return o.train.squares + o.held.squares


def parameters_of(o: Outcome, label: str) -> dict[str, tuple[float, float, str]]:
    """Identified parameters of one effect: name -> (value, standard deviation, unit).

    And a choice, where it is not the usual one, as something known for certain.

    Of what every record has of its own, that of the record where it is surest: of those that were
    fitted, if it happened in one, as held-out records take the model's own numbers for certain.
    """
    prefix = f'{label}.'
    shared = shared_parameters(o.train, label)
    own = next((e.parameters for e in o.model.effects if e.label == label), ())
    for p in own:
        chosen = o.model.values[f'{prefix}{p.name}']
        if p.choice and p.name not in shared and chosen != p.starts[0]:
            shared[p.name] = chosen, 0.0, p.unit
    events = events_of(o, label)
    fitted = [events[name] for name in o.data_sets[0] if name in events]
    sizes = _sizes(o.model, label)
    surest = max(fitted or events.values(), key=lambda e: _sureness(e, sizes), default={})
    return {**surest, **shared}


def shared_parameters(found: Fit, label: str) -> dict[str, tuple[float, float, str]]:
    """Those parameters of an effect that all records share: name -> (value, sigma, unit)."""
    prefix = f'{label}.'
    return {
        u.name.removeprefix(prefix): (float(v), float(s), u.unit)
        for u, v, s in zip(found.unknowns, found.values, found.sigmas, strict=True)
        if u.name.startswith(prefix)
    }


def own_parameters(o: Outcome) -> dict[str, tuple[float, float, str]]:
    """Parameters of the effect tried: name -> (value, standard deviation, unit)."""
    return parameters_of(o, o.label)


def events_of(o: Outcome, label: str) -> dict[str, dict[str, tuple[float, float, str]]]:
    """What surely happened in single records: record -> own parameter -> (value, sigma, unit).

    The intervals of held-out records take the shared numbers for certain; `events_in` of a fit to
    all records (fit_to_all) does not.
    """
    train, held = o.data_sets
    return {**events_in(o.train, train, label), **events_in(o.held, held, label)}


def events_in(
    found: Fit, names: Sequence[str], label: str
) -> dict[str, dict[str, tuple[float, float, str]]]:
    """What surely happened, by one fit to the records of these names; as `events_of`."""
    events, sizes = {}, _sizes(found.model, label)
    for name, motion, sigmas in zip(names, found.motions, found.own_sigmas, strict=True):
        values = motion[len(motion) - len(found.own) :]
        row = {
            u.name.removeprefix(f'{label}.'): (float(v), float(s), u.unit)
            for u, v, s in zip(found.own, values, sigmas, strict=True)
            if u.name.startswith(f'{label}.')
        }
        if row and _sureness(row, sizes) > settings.EVENTS.sure:
            events[name] = row
    return events


def _sizes(model: Model, label: str) -> tuple[str, ...]:
    """Those of an effect's own values in a record that are 0 where nothing happens."""
    own = next((e.parameters for e in model.effects if e.label == label), ())
    return tuple(p.name for p in own if p.each and p.neutral is not None)


def _sureness(event: Mapping[str, tuple[float, float, str]], sizes: Sequence[str]) -> float:
    """Standard deviations by which the surest size of an event differs from 0."""
    return max(abs(event[name][0]) / max(event[name][1], 1e-300) for name in sizes)


def prior_conflicts(o: Outcome) -> dict[str, float]:
    """Parameters that the fit puts far from what the file believes: tolerances away."""
    return far(o.train, o.task.bounds)


def far(found: Fit, bounds: Mapping[str, float]) -> dict[str, float]:
    """The same of a fit with those bounds on small faults."""
    away = {
        u.name: abs(u.to_coordinate(v) - u.to_coordinate(u.prior)) / u.tolerance
        for u, v in zip(found.unknowns, found.values, strict=True)
        if np.isfinite(u.tolerance) and u.name not in bounds
    }
    return {
        name: tolerances
        for name, tolerances in away.items()
        if tolerances > settings.PRIOR.conflict
    }


def one_minimum(a: Fit, b: Fit, label: str) -> bool:
    """Whether two fits of an effect ended alike, or will."""
    own, other = (
        {name: v for name, v in found.numbers.items() if name.startswith(f'{label}.')}
        for found in (a, b)
    )
    near = a.normalised_error < settings.SCREENING.same * b.normalised_error
    alike = np.allclose(
        list(own.values()), [other.get(n, np.nan) for n in own], rtol=settings.SCREENING.alike
    )
    return near and bool(alike)


def shared_unknowns(found: Fit, bounds: Bounds) -> float:
    """How many of the values that all data sets share the records determine, less small faults.

    Not those of which they say nothing, as where across its plane an arm carries a load: they
    explain nothing. What numbers without a belief, as those of causes, make the others unsure of,
    these no longer tell: by so much they count less. A load and the link that carries it are known
    together only, and count together.
    """
    counted = np.array([u.name not in bounds for u in found.unknowns], bool)
    counted &= ~np.isinf(found.sigmas)
    believed = np.isfinite([u.tolerance for u in found.unknowns])
    free, told = counted & ~believed, counted & believed
    if not free.any() or not told.any() or not np.isfinite(found.covariance[counted]).all():
        return float(counted.sum())
    among, across = found.covariance[np.ix_(free, free)], found.covariance[np.ix_(told, free)]
    variance = np.diag(found.covariance)[told]
    less = np.einsum('ij,jk,ik->i', across, np.linalg.pinv(among, hermitian=True), across)
    # Of the belief's own: what data say of a number is what is missing from 1.
    belief = np.array([u.tolerance for u in found.unknowns])[told] ** 2
    unsure, were_they_known = (np.clip(v / belief, 0, 1) for v in (variance, variance - less))
    return float(counted.sum() - (unsure - were_they_known).sum())


def _effect_of(o: Outcome) -> Effect | None:
    """The effect that an outcome is of; None where it is of a model alone."""
    found = (e for e in o.model.effects if e.label == o.label and e.name in LIBRARY)
    return next(found, None)


def sizes_of(o: Outcome) -> tuple[Parameter, ...]:
    """The parameters that say how much there is of the effect that an outcome is of."""
    effect = _effect_of(o)
    return effect.sizes if effect else ()


def too_small(o: Outcome) -> list[str]:
    """An effect whose size is as good as none is not what helped."""
    said = []
    for size in sizes_of(o):
        if size.neutral is None or not np.isfinite(size.neutral) or size.each:
            return []
        value, sigma, unit = parameters_of(o, o.label).get(size.name, (np.inf, 0.0, ''))
        # Within their bounds small faults may take any part of it: that says nothing of its size.
        beside = _sigma_beside(o.train, f'{o.label}.{size.name}', o.task.bounds)
        if abs(value - size.neutral) > settings.SELECTION.too_small * min(sigma, beside):
            return []
        said.append(f'{size.name} = {measured(value, sigma, unit)}')
    return [f'{" and ".join(said)} is as good as none'] if said else []


def undetermined_size(o: Outcome) -> list[str]:
    """An effect of whose size not even the order is known is not what helped.

    A limit that was never reached, a stiffness that nothing bends: what acts is something else.
    """
    names = [size.name for size in sizes_of(o)]
    if not names or not all(f'{o.label}.{name}' in o.train.undetermined for name in names):
        return []
    said = [f'{name} = {measured(*parameters_of(o, o.label)[name])}' for name in names]
    return [f'{" and ".join(said)} is not determined']


def _sigma_beside(found: Fit, name: str, given: Collection[str]) -> float:
    """Standard deviation of a value, were the values of these names known."""
    names = [u.name for u in found.unknowns]
    if name not in names:
        return np.inf
    at, known = names.index(name), [names.index(n) for n in given if n in names]
    among, across = found.covariance[np.ix_(known, known)], found.covariance[at, known]
    if not known or not np.isfinite(among).all() or not np.isfinite(across).all():
        return float(found.sigmas[at])
    variance = found.covariance[at, at] - across @ np.linalg.pinv(among) @ across
    factor = abs(found.values[at]) if found.unknowns[at].logarithmic else 1.0
    return factor * float(np.sqrt(max(variance, 0.0)))


def at_edge(o: Outcome) -> list[str]:
    """That a parameter at the edge of its range says that the effect is not what is meant."""
    return edges_in_words(o.label, parameters_at_edge(o))


def edges_in_words(label: str, at_edge: Mapping[str, tuple[float, str]]) -> list[str]:
    """The same of parameters of an effect, name -> value and unit."""
    return [
        f'{label}.{name} = {measured(value, None, unit)} lies at the edge of its range'
        for name, (value, unit) in at_edge.items()
    ]


def parameters_at_edge(o: Outcome) -> dict[str, tuple[float, str]]:
    """Those of an outcome's effect, with value and unit; small faults have no such edge."""
    fitted, effect = zip(o.train.unknowns, o.train.values, strict=True), _effect_of(o)
    return edges(
        o.label,
        effect.parameters if effect else (),
        [(u, v) for u, v in fitted if u.name not in o.task.bounds],
    )


def edges(
    label: str, declared: Sequence[Parameter], fitted: Iterable[tuple[Unknown, float]]
) -> dict[str, tuple[float, str]]:
    """Parameters of an effect at the edge of their range, with value and unit.

    But for a part of an effect that may well be absent: the edge is where it vanishes; and where
    physics ends with the range. How near to nothing a size may be is for `too_small` to say: light
    machines rub little.
    """
    found = {}
    sizes = {f'{label}.{p.name}' for p in declared if p.neutral == p.lower}
    optional = {f'{label}.{p.name}' for p in declared[1:] if p.neutral == p.lower}
    ends = {f'{label}.{p.name}': p.ends for p in declared}
    for u, v in fitted:
        if not u.name.startswith(f'{label}.'):
            continue
        low, high, at = (
            u.to_coordinate(x) if not u.logarithmic or x > 0 else -np.inf
            for x in (u.lower, u.upper, v)
        )
        # Ranges suit machines of all sizes: a small value is not yet an edge.
        margin = 1e-3 * (high - low)
        if not u.logarithmic:
            margin = min(margin, 0.1 * u.scale)
        physical = ends.get(u.name, ())
        nearest = low if u.name in sizes else low + margin
        below = nearest if u.name not in optional and 'lower' not in physical else -np.inf
        above = high - margin if 'upper' not in physical else np.inf
        if not below < at < above:
            found[u.name.removeprefix(f'{label}.')] = float(v), u.unit
    return found
