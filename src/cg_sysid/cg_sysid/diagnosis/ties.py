"""Ties that thorough fits settle."""

from collections.abc import Sequence

from cg_sysid.diagnosis.doubt import without
from cg_sysid.diagnosis.small_faults import shown
from cg_sysid.diagnosis.thorough import all_thorough
from cg_sysid.diagnosis.workspace import Workspace, structure
from cg_sysid.errors import Failure
from cg_sysid.identification.fit_result import Fit
from cg_sysid.search import settings
from cg_sysid.search.model_selection import Comparison, at_noise
from cg_sysid.search.outcome import Outcome
from cg_sysid.search.ranking import contains
from cg_sysid.search.standings import title_of
from cg_sysid.search.whole_fit import fit_to_all


def tie(work: Workspace, comparison: Comparison, label: str) -> Comparison | None:
    """An effect and its rivals, fitted thoroughly: what is a tie then is one.

    One that has the effect within it fits as well by itself, and is no rival.
    """
    rivals = (c.label for c in comparison.close_to(label, settings.SELECTION.coarse_fidelity))
    close = [label, *(rival for rival in rivals if not contains(rival, label))]
    ties = [pair[1] for name in close if (pair := comparison.of(name)) and at_noise(pair[1])]
    if len(ties) < 2 or ties[0].label != label:
        return None
    outcomes = all_thorough(work, ties)
    return work.selection.compare(comparison.base, outcomes, fitted_to_all(work, outcomes))


def fitted_to_all(
    work: Workspace,
    outcomes: Sequence[Outcome],
    iterations: int = settings.FITTING.thorough_iterations,
) -> list[Fit | Failure]:
    """Thorough fits of the structures of outcomes to all records, or why there are none."""
    new = {structure(o): o for o in outcomes if structure(o) not in work.joint}
    if new:
        arguments = [(o, (*work.train, *work.held), iterations) for o in new.values()]
        title = f'{", ".join(title_of(work.added(o)) for o in new.values())} on all records'
        work.joint |= zip(new, work.carry_out(fit_to_all, arguments, title), strict=True)
    return [work.joint[structure(o)] for o in outcomes]


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
