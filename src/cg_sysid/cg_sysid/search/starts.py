"""Where the fit of a candidate sets out: its own starts, and what another fit has found before."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from cg_dynamics.effects.effect import Effect
from cg_dynamics.mechanisms.mechanism import Mechanism
from cg_dynamics.model import Model
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.unknowns import own_unknowns, unknowns_of, unsettled_states
from cg_sysid.search import settings
from cg_sysid.search.nuisance import Bounds, turning
from cg_sysid.search.task import Task, effect_of


def starts_of(effect: Effect) -> list[dict[str, float]]:
    """Values of an effect's parameters from which its identification sets out."""
    grids = [
        [(p.name, start) for start in p.starts] if p.choice or (p.free and not p.each)
        else [(p.name, p.default if p.neutral is None else p.neutral)]
        for p in effect.parameters
    ]  # fmt: skip
    return [
        dict(point)
        for point in itertools.islice(itertools.product(*grids), settings.SCREENING.most_starts)
    ]


def starts_beside(
    effect: Effect, body: Mechanism, train: Sequence[DataSet]
) -> list[dict[str, float]]:
    """The same, from the torques in `train` where the effect's law is one of the torque."""
    drive = dict(zip(body.joints, body.inputs, strict=True)).get(effect.site)
    torques = [float(np.abs(t.inputs_for([drive])).max()) for t in train if drive is not None]
    bounds = {p.name: (p.lower, p.upper) for p in effect.parameters}
    found = [
        start
        for start in (effect.starts_beside(max(torques)) if any(torques) else [])
        if all(bounds[name][0] <= value <= bounds[name][1] for name, value in start.items())
    ]
    return found or starts_of(effect)


def starting_models(task: Task, train: Sequence[DataSet] = ()) -> Iterator[Model]:
    """The base with the effect, at each of its starts; some follow from the torques in `train`."""
    tried = effect_of(task)
    if task.effect is None or tried is None:
        yield task.model
        return
    name, at = task.effect
    small = any(effect.label == tried.label for effect in task.model.effects)
    base = task.model.without_effect(tried.label) if small else task.model
    for start in starts_beside(tried, task.model.mechanism, train):
        yield base.with_effect(name, at, **start | turning(base, name, at))


def started_from(
    found: Fit, model: Model, bounds: Bounds, only: Sequence[str] | None = None
) -> Fit:
    """A fit as a start for a model of other effects; what it has not is where the model says."""
    known = found.numbers
    unknowns = unknowns_of(model, only, bounds)
    own = own_unknowns(model)
    before = unsettled_states(found.model)
    motions = []
    for motion in found.motions:
        first = len(motion) - len(found.own)
        known_own = {u.name: v for u, v in zip(found.own, motion[first:], strict=True)}
        moving = first - len(before)
        away = dict(zip(before, motion[moving:first], strict=True))
        motions.append(
            np.array([
                *motion[:moving],
                *(away.get(state, 0.0) for state in unsettled_states(model)),
                *(known_own.get(u.name, u.prior) for u in own),
            ])
        )  # fmt: skip
    values = np.array([np.clip(known.get(u.name, u.prior), u.lower, u.upper) for u in unknowns])
    return replace(
        found, model=chosen(model, found), unknowns=unknowns, values=values, own=own,
        motions=tuple(motions),
    )  # fmt: skip


def chosen(model: Model, warm_start: Fit) -> Model:
    """The model with the choices that a warm start has made for the last of its effects."""
    stated = warm_start.model.values
    names = [f'{e.label}.{p.name}' for e in model.effects[-1:] for p in e.parameters if p.choice]
    return model.with_values({name: stated[name] for name in names if name in stated})


def numbers_of_base(task: Task) -> dict[str, float]:
    """Where the base stands: from there it is not far."""
    known = task.first or task.base
    return known.numbers if known else {}
