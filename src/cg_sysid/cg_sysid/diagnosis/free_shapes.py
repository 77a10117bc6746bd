"""Shapes of laws, let go: how dry friction turns about rest, how teeth begin to touch.

Hard friction that is simulated by a soft law leaves hundreds of times the noise. Which of several
laws takes a little more of that says nothing: first each has to turn as the machine does. And the
numbers of a cause lean on the shape of its law: teeth that begin to touch too early are told soft.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cg_dynamics.effects.effect import Effect
from cg_dynamics.model import Model
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.identification import torque_error
from cg_sysid.search import settings
from cg_sysid.search.look import first_seconds, same_seconds
from cg_sysid.search.model_selection import Comparison, above_noise, at_noise, settled
from cg_sysid.search.nuisance import Bounds
from cg_sysid.search.outcome import Outcome, chi2
from cg_sysid.search.standings import title_of
from cg_sysid.search.starts import started_from
from cg_sysid.search.task import Task

PURE = 1e-3  # share of its range that a mixture may lie off an end of it, and count as pure


def drawn_otherwise(work: Workspace) -> Model | None:
    """The nominal model with its laws as the machine draws them, if that is not as stated.

    Where friction turns otherwise than its law says, all that is tried leaves as much, and no race
    is decided. Shapes that may be anything follow whatever is missing; so few do not. All joints
    are drawn alike, as bearings of one kind are. On a robot only, where looks led by torques are
    as cheap as they are near.
    """
    nominal = work.nominal
    if not torque_error.can(nominal):
        return None
    kinds = {effect.name: effect for effect in nominal.effects if effect.drawings}
    models = []
    for name, kind in kinds.items():
        alike = [effect for effect in nominal.effects if effect.name == name]
        for drawing in kind.drawings:
            values = {f'{e.label}.{p}': value for e in alike for p, value in drawing.items()}
            if any(nominal.values[full] != value for full, value in values.items()):
                models.append(nominal.with_values(values))
    if not models:
        return None
    what = 'how the machine draws laws'
    (stated,) = work.carry_out(first_seconds, [(Task(nominal), work.train)], what)
    if stated is None or stated.normalised_error < settings.NOISE.settled:
        return None
    tasks = [(Task(model, first=stated), work.train) for model in models]
    looks = zip(work.carry_out(same_seconds, tasks, what), models, strict=True)
    found = [(look.normalised_error, model) for look, model in looks if look is not None]
    error, drawn = min(found, key=lambda pair: pair[0], default=(np.inf, nominal))
    return drawn if settings.SCREENING.drawn * error < stated.normalised_error else None


def compared_with_free_shapes(work: Workspace, comparison: Comparison) -> Comparison:
    """The comparison without laws of a friction that lose once all of them may turn as they like.

    Only where the winner is such a law, others of the same joint are in reach, and none is near
    the noise.
    """
    winner = comparison.winner()
    if winner is None or comparison.base.task.bounds:
        return comparison
    best = winner[1]
    law = best.model.effect(best.label)
    if law.friction != 'dry' or best.train.normalised_error < settings.NOISE.quick:
        return comparison
    limit = settings.HALVING.in_reach * chi2(best)
    kin = [
        o for candidate, o in comparison.ranked
        if not candidate.reason and chi2(o) < limit and _dry_at(o.model.effect(o.label), law.site)
    ]  # fmt: skip
    if len(kin) < 2:
        return comparison
    title = f'laws of friction on top of {title_of(work.added(comparison.base))}'
    free = with_free_shapes(work, kin, title)
    again = work.selection.compare(comparison.base, free)
    first = again.winner()
    if first is None:
        return comparison
    for candidate, _ in again.ranked:
        if candidate.evidence < first[0].evidence - again.margin:
            comparison = comparison.less(
                candidate.label,
                f'explains less than {first[0].label} once each may turn about rest as it likes',
            )
    return comparison


def _dry_at(effect: Effect, site: str) -> bool:
    return effect.friction == 'dry' and effect.site == site


def with_free_shapes(work: Workspace, outcomes: list[Outcome], title: str) -> list[Outcome]:
    """Each with the shapes of its law, and of dry friction at the same joint, let go."""
    tasks = [_again(o, _shapes_at(o, [o.label])) for o in outcomes]
    return [
        with_mixed_friction(work, with_hard_friction(work, replace(found, label=o.label)))
        for o, found in zip(outcomes, work.halving.fit(tasks, title), strict=True)
        if isinstance(found, Outcome)
    ]


def with_shapes_of_causes(work: Workspace, o: Outcome) -> Outcome:
    """What stands, with the shapes of its causes' laws let go where that is earned.

    Near the noise small faults are not let go any more, and the shapes of laws with them.
    """
    bounds = _shapes_at(o, sorted(work.added(o)))
    if o.task.bounds or not bounds or above_noise(o) < settings.NOISE.nothing_left - 1:
        return o
    title = f'{title_of(work.added(o))}, its laws in other shapes'
    task = replace(
        _again(o, bounds), thorough=True, iterations=settings.FITTING.thorough_iterations
    )
    found = work.halving.fit([task], title)[0]
    if not isinstance(found, Outcome):
        return o
    found = with_mixed_friction(work, with_hard_friction(work, replace(found, label=o.label)))
    ((judged, found),) = work.selection.compare(o, [found]).ranked
    earned = judged.evidence > settings.SELECTION.earned and judged.held_gain > 0
    return found if earned else o


def explained_by_own_shapes(work: Workspace, o: Outcome) -> bool:
    """Whether causes explain all once their own laws are drawn as the machine has them."""
    prefixes = tuple(f'{label}.' for label in work.added(o))
    bounds = {
        name: declared.leeway for name, declared in o.model.declarations.items()
        if declared.leeway and name.startswith(prefixes)
    }  # fmt: skip
    if o.task.bounds or not bounds:
        return False
    title = f'{title_of(work.added(o))}, its laws in other shapes'
    found = work.halving.fit([_again(o, bounds)], title)[0]
    return isinstance(found, Outcome) and settled(found)


def _shapes_at(o: Outcome, labels: Sequence[str]) -> Bounds:
    """Shapes of these laws and of dry friction at the same joints, and how far each may go."""
    laws = [effect for effect in o.model.effects if effect.label in labels]
    return {
        f'{effect.label}.{p.name}': p.leeway
        for effect in o.model.effects
        if any(effect is law or _dry_at(effect, law.site) for law in laws)
        for p in effect.parameters if p.leeway
    }  # fmt: skip


def with_mixed_friction(work: Workspace, o: Outcome) -> Outcome:
    """The same from the middle of mixtures that ended pure, if that comes out better.

    Where a share is none or all the numbers of what is not there show nothing: a descent that
    gets there early stays there.
    """
    declared, values = o.model.declarations, o.train.values.copy()
    for i, u in enumerate(o.train.unknowns):
        pure = min(values[i] - u.lower, u.upper - values[i]) < PURE * (u.upper - u.lower)
        if u.name in o.task.bounds and set(declared[u.name].ends) == {'lower', 'upper'} and pure:
            values[i] = (u.lower + u.upper) / 2
    if at_noise(o) or np.array_equal(values, o.train.values):
        return o
    mixed = replace(o, train=replace(o.train, values=values))
    return _if_better(work, o, _again(mixed, o.task.bounds), 'with mixed friction')


def with_hard_friction(work: Workspace, o: Outcome) -> Outcome:
    """The same with dry friction that turns as fast as it likes, where it does so as it may.

    Not from the start: the harder friction is, the rougher is the way to the minimum.
    """
    bounds, declared = dict(o.task.bounds), o.model.declarations
    for u, value in zip(o.train.unknowns, o.train.values, strict=True):
        if (
            u.name in bounds
            and declared[u.name].smoothing
            and value < settings.DOUBT.hard * u.lower
        ):
            bounds[u.name] = float(np.log(u.prior / declared[u.name].lower))
    if bounds == o.task.bounds:
        return o
    return _if_better(work, o, _again(o, bounds), 'with hard friction')


def _if_better(work: Workspace, o: Outcome, task: Task, how: str) -> Outcome:
    """What a task comes to, as thorough as the outcome is, if that leaves less than it."""
    reach = o.train.normalised_error
    task = replace(task, thorough=o.task.thorough, iterations=o.task.iterations, reach=reach)
    found = work.halving.fit([task], f'{title_of(work.added(o))}, {how}')[0]
    if not isinstance(found, Outcome) or chi2(found) >= chi2(o):
        return o
    return replace(found, label=o.label)


def _again(o: Outcome, bounds: Bounds) -> Task:
    start = started_from(o.train, o.model, bounds)
    return Task(o.model, events=o.events, bounds=bounds, warm_starts=(start,))
