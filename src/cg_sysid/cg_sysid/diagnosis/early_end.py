"""The answer of a search that was broken off."""

from cg_dynamics.effects import LIBRARY
from cg_sysid.diagnosis.causes import cause_among
from cg_sysid.diagnosis.comparing import done
from cg_sysid.diagnosis.conclude import answer, verdict_of
from cg_sysid.diagnosis.result import Diagnosis, Verdict
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.search.model_selection import share_explained
from cg_sysid.search.nuisance import nuisances
from cg_sysid.search.outcome import Outcome, chi2
from cg_sysid.search.standings import Unfinished
from cg_sysid.search.task import EffectAt, candidates_for


def answer_so_far(work: Workspace, nominal: Outcome) -> Diagnosis:
    """The best answer before the end, without any fit more."""
    final, comparison = work.found, None
    if work.added(work.under_way) >= work.added(final):
        comparison = work.selection.compare(
            work.under_way, work.so_far.fitted(work.under_way.task)
        )
        winner = None if done(work, work.under_way) else comparison.winner()
        reached = winner[1] if winner else work.under_way
        # The same causes may be on trial without the small faults that they are found among.
        if chi2(reached) <= chi2(final):
            work.note(comparison, winner[0].label if winner else '')
            final = reached
    comparisons = [*work.comparisons.values(), *([comparison] if comparison else [])]
    causes = [cause_among(final, label, comparisons) for label in sorted(work.added(final))]
    left = bool(work.left(final))
    verdict = verdict_of(causes, left, share_explained(nominal.held, final.held))
    if verdict == Verdict.UNEXPLAINED:
        verdict = Verdict.UNFINISHED
    return answer(work,
        nominal, final, sorted(causes, key=lambda cause: -cause.evidence), verdict,
        unfinished=unfinished(work, final, left),
    )  # fmt: skip


def unfinished(work: Workspace, final: Outcome, left: bool) -> Unfinished:
    """What was not come to."""
    base = work.under_way.task
    fitted = {o.label for o in work.so_far.fitted(base)}
    looked = {screening.label for screening in work.so_far.screened(base)} - fitted
    recorded = {name for data_set in work.train for name in data_set.input_names}
    possible = candidates_for(base.model, work.setups(), work.options.effects, recorded,
                              nuisances(base.model, base.bounds))  # fmt: skip
    said = work.torques.get((work.added(work.under_way), bool(base.bounds)))
    by_torques = () if said is None else tuple(
        (label, nats) for c, nats in said.best()
        if (label := _label(work, c)) not in looked | fitted | work.added(final)
    )  # fmt: skip
    labels = {_label(work, c) for c in (said.worth(possible) if said else possible)}
    ruled_out = {label for r in work.rounds for label in r.aside}
    ranking = [s for s in work.so_far.ranking(base) if s.label not in work.added(final)]
    steps = ['further causes'] if left else []
    if work.added(final):
        steps += ['doubt about each cause beside the others', 'thorough fits of the answer']
    return Unfinished(
        work.deadline.why, work.deadline.passed, tuple(ranking),
        tuple(sorted(looked - ruled_out)),
        tuple(sorted(labels - looked - fitted - work.added(final))), tuple(steps), by_torques,
    )  # fmt: skip


def _label(work: Workspace, candidate: EffectAt) -> str:
    name, at = candidate
    return LIBRARY[name](work.nominal.mechanism, at).label
