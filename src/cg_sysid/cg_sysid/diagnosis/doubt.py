"""Doubt: each accepted effect is taken out again, and the library competes for its place."""

import logging
from dataclasses import replace

from cg_sysid.diagnosis.comparing import compare, effects_on
from cg_sysid.diagnosis.small_faults import with_law
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.errors import Failure
from cg_sysid.search import settings
from cg_sysid.search.model_selection import Comparison
from cg_sysid.search.nuisance import with_nuisances
from cg_sysid.search.outcome import Outcome, chi2, too_small
from cg_sysid.search.ranking import contains
from cg_sysid.search.starts import started_from
from cg_sysid.search.successive_halving import Effects
from cg_sysid.search.task import Task

log = logging.getLogger(__name__)


def exchange(work: Workspace, nominal: Outcome, final: Outcome) -> Outcome | None:
    """A better structure: without an effect that is not earned, or with another instead.

    Beside the others an effect may turn out to have stood in for what came later.
    """
    for label in sorted(work.added(final)):
        comparison = without(work, nominal, final, label)
        if comparison is None:
            continue
        own = comparison.of(label)
        winner = comparison.winner()
        if winner is None or own is None:
            return comparison.base
        rival, outcome = winner
        better = rival.evidence > own[0].evidence + comparison.margin
        simpler = contains(label, rival.label)
        if rival.label != label and (own[0].reason or better or simpler):
            return outcome
    return None


def without(work: Workspace, nominal: Outcome, final: Outcome, label: str) -> Comparison | None:
    """The library in competition for the place of one of several effects."""
    others = work.added(final) - {label}
    key = others, bool(final.task.bounds)
    if key not in work.comparisons:
        task = _lean(work, final, label)
        known = not others and not task.bounds
        lean = nominal if known else work.halving.fit([task], f'model without {label}')[0]
        if isinstance(lean, Failure):
            log.info('without %s: %s', label, lean)
            return None
        # What later causes have left nothing of needs no rival: the search goes on without it.
        alone = work.selection.compare(lean, [replace(final, label=label)])
        if alone.ranked[0][0].evidence < settings.SELECTION.earned:
            return alone
        # Who would take the place has to come up to what is there.
        compare(work, lean, with_law(work, final), outrun(work, lean, label))
    comparison = work.comparisons[key]
    # The fit beside the others may have been better, or the only one that went through.
    ranked = comparison.of(label)
    if ranked is None or chi2(final) < chi2(ranked[1]):
        outcomes = [o for _, o in comparison.ranked if o.label != label]
        again = work.selection.compare(comparison.base, [*outcomes, replace(final, label=label)])
        comparison = work.comparisons[key] = replace(again, aside=comparison.aside)
    return comparison


def _lean(work: Workspace, final: Outcome, label: str) -> Task:
    """The model without one of its effects, as a task."""
    model, bounds = final.model.without_effect(label), final.task.bounds
    if bounds:
        model, missing = with_nuisances(model, work.setups())
        bounds = {**bounds, **missing}
    if too_small(replace(final, label=label)):
        # Without what is as good as none all other numbers stay where they are.
        known: Outcome | None = final
    else:
        known = work.faulty.get(work.added(final) - {label}) if bounds else None
    return Task(
        model, events=final.events, bounds=bounds,
        warm_starts=(started_from(known.train, model, bounds),) if known else (),
        # Without what is earned it cannot come near: no valley of it is walked to its end.
        reach=settings.HALVING.in_reach * max(final.train.normalised_error, 1.0),
    )  # fmt: skip


def outrun(work: Workspace, lean: Outcome, label: str) -> Effects:
    """What the race that this cause won without small faults left far behind.

    Small faults are small: they do not make up for ten times the error, nor for what
    torques ruled out.
    """
    raced = work.added(lean), False
    if not lean.task.bounds or raced not in work.comparisons:
        return ()
    behind = work.halving.far_behind(lean.task, label)
    effects, said = effects_on(work, lean), work.torques.get(raced)
    asked = effects if said is None else said.worth(effects)
    return [effect for effect in effects if effect in behind or effect not in asked]
