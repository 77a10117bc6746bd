"""Accepted effects as causes: their rivals, places, events and the experiments that would tell."""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cg_sysid.diagnosis.doubt import without
from cg_sysid.diagnosis.experiment_design import Proposal, propose
from cg_sysid.diagnosis.result import Cause
from cg_sysid.diagnosis.small_faults import shown
from cg_sysid.diagnosis.ties import fitted_to_all, tie
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.errors import Failure
from cg_sysid.identification.fit_result import Fit
from cg_sysid.search import settings
from cg_sysid.search.model_selection import Comparison
from cg_sysid.search.nuisance import nuisances
from cg_sysid.search.outcome import (
    Outcome,
    events_in,
    events_of,
    parameters_at_edge,
    parameters_of,
    shared_parameters,
)
from cg_sysid.search.ranking import contains, effect_name

log = logging.getLogger(__name__)


def named_causes(work: Workspace, nominal: Outcome, final: Outcome) -> list[Cause]:
    """What was added to the nominal model, each judged in its place, the strongest first."""
    causes = []
    for label in sorted(work.added(final)):
        comparison = without(work, nominal, final, label)
        if comparison is None:
            causes.append(Cause(label, parameters_of(final, label), float('inf')))
            continue
        if len(work.added(final)) > 1:
            work.note(comparison, label)
        cause = _cause(final, label, tie(work, comparison, label) or comparison)
        if label in work.doubted:
            cause = replace(cause, rivals=(*cause.rivals, *shown(work.doubted[label])))
        causes.append(replace(cause, proposals=proposals(work, final, cause, comparison)))
    return sorted(causes, key=lambda cause: -cause.evidence)


def proposals(
    work: Workspace, final: Outcome, cause: Cause, comparison: Comparison
) -> tuple[Proposal, ...]:
    """Experiments that would tell a cause from its rivals."""
    if not cause.rivals or not work.options.experiments:
        return ()
    found = (comparison.of(label) for label in cause.rivals)
    rivals = [replace(final, label=cause.label), *(pair[1] for pair in found if pair)]
    if cause.label in work.doubted:
        rivals.append(work.doubted[cause.label])
    if len(rivals) < 2:
        return ()
    return propose(
        rivals, work.train[0].sigma, work.options.experiments, work.options.workers,
        work.executor,
        lambda done, total: work.progress(
            'rehearsing experiments to tell causes apart', done, total, work.best(None)
        ),
    )[:settings.DOUBT.proposed]  # fmt: skip


def with_events(work: Workspace, final: Outcome, cause: Cause) -> Cause:
    """The cause with what every record has of its own by a fit to all records.

    A held-out record takes the shared numbers for certain, and its intervals are too narrow;
    and so are all if the law is taken for exact in its shape.
    """
    parameters = final.model.effect(cause.label).parameters
    if not any(p.each for p in parameters):
        return cause
    shapes = {f'{cause.label}.{p.name}': p.leeway for p in parameters if p.leeway}
    task = replace(final.task, bounds={**final.task.bounds, **shapes})
    (found,) = fitted_to_all(work, [replace(final, task=task)])
    if isinstance(found, Failure):
        log.info('%s on all records: %s', cause.label, found)
        return cause
    names = [name for side in final.data_sets for name in side]
    return replace(
        cause,
        events=events_in(found, names, cause.label),
        parameters=cause.parameters | shared_parameters(found, cause.label),
        undetermined=_undetermined(found, cause.label),
    )


def as_in(final: Outcome, cause: Cause) -> Cause:
    """The cause with the values of another fit."""
    return replace(
        cause,
        parameters=parameters_of(final, cause.label),
        events=events_of(final, cause.label),
        undetermined=_undetermined(final.train, cause.label),
        at_edge=tuple(parameters_at_edge(replace(final, label=cause.label))),
        replaces=tuple(e.label for e in final.model.effects if _idle(final, cause.label, e.label)),
    )  # fmt: skip


def _undetermined(found: Fit, label: str) -> tuple[str, ...]:
    """Parameters of an effect of which a fit does not even tell the order."""
    prefix = f'{label}.'
    return tuple(
        name.removeprefix(prefix) for name in found.undetermined if name.startswith(prefix)
    )


def _idle(o: Outcome, label: str, other: str) -> bool:
    """Whether an effect does the work of a simpler one that the nominal model has.

    The simpler one is nothing to within its uncertainty, and at the size that the file states the
    records would have shown it.
    """
    if other in nuisances(o.model, o.task.bounds) or not contains(label, other):
        return False
    name, (value, sigma, _) = next(iter(parameters_of(o, other).items()), ('', (np.inf, 0.0, '')))
    first = o.model.effect(other).parameters[0]
    stated = o.model.quantities.get(f'{other}.{name}')
    if name != first.name or first.neutral is None or stated is None:
        return False
    return (
        abs(value - first.neutral) <= settings.SELECTION.too_small * sigma
        and abs(stated.value - first.neutral) > settings.EVENTS.sure * sigma
    )


def cause_among(final: Outcome, label: str, comparisons: Sequence[Comparison]) -> Cause:
    """The cause, judged by the comparison that had the most beside it."""
    richer = {c.label for x in comparisons for c, _ in x.ranked if contains(c.label, label)}
    for name in (label, *sorted(richer)):  # one that has turned into it was judged (simpler.py)
        known = [c for c in comparisons if (own := c.of(name)) and not own[0].reason]
        if known:
            comparison = max(known, key=lambda c: len(c.base.model.effects))
            return as_in(final, _cause(final, label, comparison, name))
    return as_in(final, Cause(label, parameters_of(final, label), float('inf')))


def _cause(final: Outcome, label: str, comparison: Comparison, judged: str = '') -> Cause:
    judged = judged or label
    own = comparison.of(judged)
    assert own is not None
    name = effect_name(label)
    close = comparison.close_to(judged)
    return Cause(
        label,
        parameters_of(final, label),
        own[0].evidence,
        rivals=tuple(
            c.label for c in close if effect_name(c.label) != name and not contains(c.label, label)
        ),
        places=tuple(c.label for c in close if effect_name(c.label) == name),
        events=events_of(final, label),
    )
