"""Shapes of dry friction, let go: how it turns about rest, and how it fades.

Hard friction that is simulated by a soft law leaves hundreds of times the noise. Which of several
laws takes a little more of that says nothing: first each has to turn as the machine does.
"""

from dataclasses import replace

import numpy as np

from cg_dynamics.effects.effect import Effect
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.search import settings
from cg_sysid.search.candidates import Outcome, Task, chi2, started_from
from cg_sysid.search.model_selection import Comparison
from cg_sysid.search.nuisance import Bounds
from cg_sysid.search.standings import title_of


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
        if not candidate.reason and chi2(o) < limit and _is_kin(o.model.effect(o.label), law)
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


def _is_kin(effect: Effect, law: Effect) -> bool:
    return effect.friction == 'dry' and effect.site == law.site


def with_free_shapes(work: Workspace, outcomes: list[Outcome], title: str) -> list[Outcome]:
    """Each with the shapes of the dry friction at its joint let go."""
    tasks = []
    for o in outcomes:
        law = o.model.effect(o.label)
        bounds = {
            f'{effect.label}.{p.name}': p.leeway
            for effect in o.model.effects if _is_kin(effect, law)
            for p in effect.parameters if p.leeway
        }  # fmt: skip
        tasks.append(_again(o, bounds))
    return [
        with_hard_friction(work, replace(found, label=o.label))
        for o, found in zip(outcomes, work.halving.fit(tasks, title), strict=True)
        if isinstance(found, Outcome)
    ]


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
    title = f'{title_of(work.added(o))}, with hard friction'
    hard = work.halving.fit([_again(o, bounds)], title)[0]
    return (
        replace(hard, label=o.label) if isinstance(hard, Outcome) and chi2(hard) < chi2(o) else o
    )


def _again(o: Outcome, bounds: Bounds) -> Task:
    start = started_from(o.train, o.model, bounds)
    return Task(o.model, events=o.events, bounds=bounds, warm_starts=(start,))
