"""Thorough fits: to the very bottom, in finer steps of integration."""

import itertools
from collections.abc import Sequence
from dataclasses import replace

from cg_sysid.diagnosis.workspace import Workspace, structure
from cg_sysid.identification.fit_result import Fit
from cg_sysid.search import settings
from cg_sysid.search.model_selection import settled
from cg_sysid.search.outcome import Outcome, chi2, one_minimum
from cg_sysid.search.ranking import per_output
from cg_sysid.search.standings import title_of
from cg_sysid.search.starts import started_from
from cg_sysid.search.task import Task


def thorough(work: Workspace, o: Outcome) -> Outcome:
    """The last fit of what was found: its values are what people will use.

    Thorough fits are compared only among themselves, or they would have the advantage.
    """
    return all_thorough(work, [o])[0]


def all_thorough(work: Workspace, outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The same of several, side by side."""
    new = {structure(o): o for o in outcomes if structure(o) not in work.thorough}
    if new:
        work.thorough |= zip(new, fitted_thoroughly(work, list(new.values())), strict=True)
    return [replace(work.thorough[structure(o)], label=o.label) for o in outcomes]


def finished(work: Workspace, o: Outcome) -> bool:
    """Whether nothing is left to explain, if need be in finer steps of integration.

    Quick fits of stiff friction may end at twice the noise. Whatever is put on top would be a
    search for their errors. Where small faults are let go it is not asked, as they may only
    imitate the noise.
    """
    near = (per_output(side) < settings.NOISE.quick for side in (o.train, o.held))
    return not o.task.bounds and (
        settled(o) or (all(map(all, near)) and settled(thorough(work, o)))
    )


def fitted_thoroughly(work: Workspace, outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Each from where it stands, and from other minima of the same structure."""
    tasks = [_thorough_tasks(work, o) for o in outcomes]
    title = f'thorough fits of {", ".join(title_of(work.added(o)) for o in outcomes)}'
    fits = iter(work.halving.fit([task for own in tasks for task in own], title))
    best = []
    for o, own in zip(outcomes, tasks, strict=True):
        found = [f for f in itertools.islice(fits, len(own)) if isinstance(f, Outcome)]
        best.append(min([o, *found], key=chi2))
    return best


def _thorough_tasks(work: Workspace, o: Outcome) -> list[Task]:
    task = Task(o.model, events=o.events, bounds=o.task.bounds, thorough=True,
                iterations=settings.FITTING.thorough_iterations)  # fmt: skip
    # Another minimum may have been sought with shapes let go that are not here.
    starts = (started_from(s.train, o.model, task.bounds) for s in other_minima(work, o))
    return [replace(task, warm_starts=(start,)) for start in (o.train, *starts)]


def other_minima(work: Workspace, o: Outcome) -> list[Outcome]:
    """The same structure from other starts of its effects, where these may lead deeper.

    Near the noise no comparison asked for them.
    """
    effects = [o.model.effect(label) for label in sorted(work.added(o))]
    without = [
        Task(o.model.without_effect(e.label), (e.name, e.at), o.events, o.task.bounds)
        for e in effects
    ]
    title = f'other starts of {title_of(work.added(o))}'
    near = settings.SCREENING.same * o.train.normalised_error
    tasks = [
        replace(
            screening.task,
            warm_starts=(warm_start,),
            iterations=settings.HALVING.rungs[0],
            reach=near,
        )
        for screening in work.halving.screen_beside(without, title)
        for warm_start in screening.task.warm_starts
        if warm_start.normalised_error < settings.DOUBT.from_afar * screening.error
    ]
    found = work.halving.fit(tasks, title)
    return [
        other for other in found
        if isinstance(other, Outcome) and other.train.normalised_error < near
        and not one_minimum(other.train, o.train, other.label)
        and not _further_up(other.train, o.train)
    ]  # fmt: skip


def _further_up(other: Fit, found: Fit) -> bool:
    """Whether a fit lies in a valley of the data with another, where the file believes less.

    Fitted to its end it would come down along the valley to the other, slowly.
    """
    level = abs(other.squares - found.squares) < settings.DOUBT.level
    return level and other.belief >= found.belief
