"""Thorough fits of what was found, and ties that they settle."""

from dataclasses import replace

from cg_sysid.diagnosis.doubt import without
from cg_sysid.diagnosis.small_faults import shown
from cg_sysid.diagnosis.workspace import Workspace, structure
from cg_sysid.errors import Failure
from cg_sysid.identification.identify import Fit
from cg_sysid.search import settings
from cg_sysid.search.candidates import Outcome, Task, chi2, fit_to_all, one_minimum
from cg_sysid.search.model_selection import Comparison, at_noise
from cg_sysid.search.ranking import contains
from cg_sysid.search.standings import title_of


def thorough(work: Workspace, o: Outcome) -> Outcome:
    """The last fit of what was found: its values are what people will use.

    Thorough fits are compared only among themselves, or they would have the advantage.
    """
    key = structure(o)
    if key not in work.thorough:
        work.thorough[key] = fitted_thoroughly(work, o)
    return replace(work.thorough[key], label=o.label)


def fitted_thoroughly(work: Workspace, o: Outcome) -> Outcome:
    """From where it stands, and from other minima of the same structure."""
    task = Task(o.model, events=o.events, bounds=o.task.bounds, thorough=True,
                iterations=settings.FITTING.thorough_iterations)  # fmt: skip
    tasks = [replace(task, warm_starts=(start.train,)) for start in (o, *other_minima(work, o))]
    title = f'thorough fits of {title_of(work.added(o))}'
    found = [fitted for fitted in work.halving.fit(tasks, title) if isinstance(fitted, Outcome)]
    return min([o, *found], key=chi2)


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


def tie(work: Workspace, comparison: Comparison, label: str) -> Comparison | None:
    """An effect and its rivals, fitted thoroughly: what is a tie then is one.

    One that has the effect within it fits as well by itself, and is no rival.
    """
    rivals = (c.label for c in comparison.close_to(label, settings.SELECTION.coarse_fidelity))
    close = [label, *(rival for rival in rivals if not contains(rival, label))]
    ties = [pair[1] for name in close if (pair := comparison.of(name)) and at_noise(pair[1])]
    if len(ties) < 2 or ties[0].label != label:
        return None
    outcomes = [thorough(work, o) for o in ties]
    return work.selection.compare(
        comparison.base, outcomes, [fitted_to_all(work, o) for o in outcomes]
    )


def fitted_to_all(work: Workspace, o: Outcome) -> Fit | Failure:
    """A thorough fit of an outcome's structure to all records, or why there is none."""
    key = structure(o)
    if key not in work.joint:
        title = f'{title_of(work.added(o))} on all records'
        found = work.carry_out(fit_to_all, [(o, (*work.train, *work.held))], title)[0]
        work.joint[key] = found
    return work.joint[key]


def ties_settled(work: Workspace, nominal: Outcome, final: Outcome) -> Outcome:
    """The structure with those effects that win over their rivals in thorough fits.

    Of several that do as well, the one that needs the fewest small faults beside it.
    """
    for label in sorted(work.added(final)):
        comparison = without(work, nominal, final, label)
        thoroughly = tie(work, comparison, label) if comparison else None
        own = thoroughly.of(label) if thoroughly else None
        winner = thoroughly.winner() if thoroughly else None
        if not (thoroughly and own and winner):
            continue
        level = [
            o
            for c, o in thoroughly.ranked
            if not c.reason and c.evidence > winner[0].evidence - thoroughly.margin
        ]
        best = min(level, key=lambda o: len(shown(o)))
        beaten = own[0].evidence < winner[0].evidence - thoroughly.margin
        if beaten or len(shown(best)) < len(shown(own[1])):
            final = best
    return final


def _further_up(other: Fit, found: Fit) -> bool:
    """Whether a fit lies in a valley of the data with another, where the file believes less.

    Fitted to its end it would come down along the valley to the other, slowly.
    """
    level = abs(other.squares - found.squares) < settings.DOUBT.level
    return level and other.belief >= found.belief
