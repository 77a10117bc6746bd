"""What is left, the verdict, and the answer."""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_interfaces.channels import interface
from cg_sysid.deadline import OutOfTime
from cg_sysid.diagnosis.between_recordings import Wandering
from cg_sysid.diagnosis.by_recording import what_wanders
from cg_sysid.diagnosis.causes import as_in, named_causes, with_events
from cg_sysid.diagnosis.doubt import without
from cg_sysid.diagnosis.free_shapes import with_shapes_of_causes
from cg_sysid.diagnosis.late_samples import late_samples
from cg_sysid.diagnosis.result import Cause, Diagnosis, Verdict, gains_of
from cg_sysid.diagnosis.small_faults import shapes, told_small_faults, with_law
from cg_sysid.diagnosis.summary import summary_of
from cg_sysid.diagnosis.thorough import thorough
from cg_sysid.diagnosis.ties import fitted_to_all
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.errors import Failure
from cg_sysid.identification.gain import Gain
from cg_sysid.identification.measured_start import MeasuredStart, judged
from cg_sysid.identification.unknowns import IdentificationError
from cg_sysid.learned.characterise import characterise, what_remains
from cg_sysid.learned.unmodelled import Unmodelled
from cg_sysid.search import settings
from cg_sysid.search.model_selection import above_noise, at_noise, share_explained
from cg_sysid.search.outcome import Outcome, chi2, prior_conflicts
from cg_sysid.search.standings import Unfinished, left_undone
from cg_sysid.search.starts import started_from
from cg_sysid.search.task import Task

log = logging.getLogger(__name__)

LAST_FIT = 'the last fit, to all records'
TURNS = 3  # periods that a term of a short stretch of an angle is tried with


def conclude(work: Workspace, stated: Outcome, nominal: Outcome, final: Outcome) -> Diagnosis:
    """The answer when nothing more is earned: look-alikes, causes, last fits, verdict.

    Args:
        work: What is known.
        stated: The nominal model as the file states it, against which the gain is told.
        nominal: The same with its laws as the machine draws them, on top of which causes stand.
        final: What stands.
    """
    unmodelled = None
    if work.left(with_law(work, final)):
        unmodelled, stand = what_remains(
            nominal, final, work.added(final), work.train, work.held, work.carry_out
        )
        final = final if stand else nominal
        kin = relative(work, nominal, unmodelled) if not work.added(final) else None
        if kin is not None:
            final = kin
            unmodelled = characterise(final, work.train, work.held, work.carry_out)
    final = less_mishaps(work, nominal, final)
    causes = named_causes(work, nominal, final)
    final = with_shapes_of_causes(work, thorough(work, with_law(work, final)))
    causes = [with_events(work, final, as_in(final, cause)) for cause in causes]
    left = work.left(final)
    wandering = wandering_number(work, final) if left else None
    if wandering and unmodelled and unmodelled.explained > wandering.explained:
        wandering = None  # the same for all records, and more
    share = share_explained(stated.held, final.held)
    verdict = verdict_of(causes, bool(left), share)
    late = ''
    if verdict == Verdict.UNEXPLAINED or not (causes or at_noise(final)):
        late = told_late_samples(work, gained(work, stated, final))
    if late:
        verdict = Verdict.UNEXPLAINED
    try:
        model, unfinished = from_all_records(work, final), None
    except OutOfTime:
        model, unfinished = None, left_undone(work.deadline, LAST_FIT)
    return answer(
        work, stated, final, causes, verdict, unmodelled, wandering, late, unfinished, model
    )


def from_all_records(work: Workspace, final: Outcome) -> Model | None:
    """What was found with numbers from all records, those held out among them; None without.

    Errors are told of a fit that has not seen what judges it. Whoever simulates the machine wants
    what all of its records say.
    """
    (fitted,) = fitted_to_all(work, [final], settings.FITTING.last_iterations)
    if isinstance(fitted, Failure):
        log.info('no fit to all records: %s', fitted.reason)
        return None
    return fitted.model


def relative(work: Workspace, nominal: Outcome, term: Unmodelled | None) -> Outcome | None:
    """An effect of the library with the period of a learned term, if it takes nearly all.

    How often a turn something repeats has many local minima; a learned term knows it.
    """
    if term is None:
        return None
    if term.period is not None:
        periods = [term.period[0]]
    elif term.effect.variable == 'angle' and not term.effect.slides(work.nominal.mechanism):
        periods = term.shape.turns(TURNS)
    else:
        return None
    size = float(np.ptp(term.shape.value) / 2)
    tasks = []
    for name, kind in LIBRARY.items():
        if kind.family != term.effect.family:
            continue
        at = kind(work.nominal.mechanism, term.effect.site).at
        for values in (v for period in periods for v in kind.repeating(period, size)):
            model = nominal.task.model.with_effect(name, at, **values)
            known = replace(term.fit, motions=nominal.train.motions, own=nominal.train.own)
            start = started_from(known, model, nominal.task.bounds)
            tasks.append(
                Task(
                    model,
                    bounds=nominal.task.bounds,
                    warm_starts=(start,),
                    iterations=settings.HALVING.rungs[0],
                )
            )
    title = f'{term.label}, as effects of the library'
    first = [o for o in work.halving.fit(tasks, title) if isinstance(o, Outcome)]
    if not first:
        return None
    best = min(first, key=chi2)
    task = replace(best.task, warm_starts=(best.train,), iterations=settings.FITTING.iterations)
    found = [o for o in work.halving.fit([task], title) if isinstance(o, Outcome)]
    best = min([best, *found], key=chi2)
    best = replace(best, label=best.model.effects[-1].label)
    comparison = work.selection.compare(nominal, [best])
    winner = comparison.winner()
    if winner is None or share_explained(nominal.held, winner[1].held) < settings.DOUBT.nearly_all:
        return None
    work.comparisons[frozenset(), bool(nominal.task.bounds)] = comparison
    work.note(comparison, winner[0].label)
    return winner[1]


def less_mishaps(work: Workspace, nominal: Outcome, final: Outcome) -> Outcome:
    """Without what happened in single records, if a number that differs explains more.

    A push in every record is many values, and takes the edge off whatever is wrong in each.
    """
    for label in sorted(work.added(final)):
        if all(p.each != 'record' for p in final.model.effect(label).parameters):
            continue
        comparison = without(work, nominal, final, label) if work.left(final) else None
        wandering = wandering_number(work, comparison.base) if comparison else None
        if comparison and wandering:
            unexplained = (1 - wandering.explained) * above_noise(comparison.base)
            final = comparison.base if unexplained < above_noise(final) else final
    return final


def wandering_number(work: Workspace, o: Outcome) -> Wandering | None:
    """The number that differs from recording to recording, if one explains what is left."""
    return what_wanders(o, (*work.train, *work.held), work.options.effects, work.carry_out)


def told_late_samples(work: Workspace, gains: Sequence[Gain]) -> str:
    """That instants of sampling are not where their stamps say, in words."""
    worst = max(gains, key=lambda g: g.before / g.noise)
    body = work.nominal.mechanism
    return late_samples(
        (*work.train, *work.held), interface(body), body.outputs, worst.channel, worst.unit
    )


def gained(work: Workspace, nominal: Outcome, final: Outcome) -> tuple[Gain, ...]:
    """Error of each output on held-out records, before and after."""
    return gains_of(work.nominal, work.held, nominal.held, final.held)


def from_measured_angles(
    work: Workspace, nominal: Outcome, final: Outcome
) -> MeasuredStart | None:
    """The gain where records start at measured angles; None where they carry nowhere."""
    try:
        return judged(work.nominal.mechanism, work.held, nominal.held, final.held)
    except (IdentificationError, DynamicsError, OutOfTime) as error:
        log.info('from measured angles: %s', error)
        return None


def own_judges(work: Workspace) -> list[str]:
    """That recordings were judged by pieces of themselves, in words."""
    fitted = {data_set.recording for data_set in work.train}
    judges = {data_set.recording for data_set in work.held}
    if judges - fitted:
        return []
    return [
        f'what was found in {", ".join(sorted(judges))} was judged on other pieces of the '
        'same recordings, which share their mishaps: record again before you believe it'
    ]


def answer(
    work: Workspace,
    nominal: Outcome,
    final: Outcome,
    causes: Sequence[Cause],
    verdict: Verdict,
    unmodelled: Unmodelled | None = None,
    wandering: Wandering | None = None,
    late: str = '',
    unfinished: Unfinished | None = None,
    model: Model | None = None,
) -> Diagnosis:
    """Put together what was found; without a `model` from all records, that of training stands."""
    gains = gained(work, nominal, final)
    reference = work.selection.judge(nominal, nominal, 0.0)
    extended = work.selection.judge(nominal, final, sum(c.evidence for c in causes))
    summary = summary_of(
        verdict, causes, gains, work.left(final), tuple(prior_conflicts(nominal)), unmodelled,
        work.options.effects, wandering, share_explained(nominal.held, final.held), late,
    )  # fmt: skip
    measured_start = from_measured_angles(work, nominal, final) if causes else None
    doubt = [measured_start.text] if measured_start and not measured_start.helps else []
    return Diagnosis(
        verdict=verdict,
        summary=f'{summary} {unfinished.text}' if unfinished else summary,
        causes=tuple(causes),
        gains=gains,
        nominal=work.nominal,
        baseline=replace(reference, reason=''),
        extended=replace(extended, reason=''),
        rounds=tuple(work.rounds),
        train=tuple(work.train),
        held=tuple(work.held),
        remaining=work.remaining(final),
        findings=(
            *told_small_faults(work, final), *shapes(final, work.nominal), *_outstanding(final),
            *doubt, *(own_judges(work) if causes else ()), *final.train.warnings,
        ),
        unmodelled=unmodelled,
        wandering=wandering,
        late=late,
        unfinished=unfinished,
        measured_start=measured_start,
        model=model or final.train.model,
        from_all=model is not None,
    )  # fmt: skip


def _outstanding(o: Outcome) -> list[str]:
    """Records that hold so much of what is left that every fit is mostly theirs, in words."""
    if at_noise(o):
        return []
    names = [name for side in o.data_sets for name in side]
    squared = np.array([
        np.nansum(mse * count) for fit in (o.train, o.held)
        for mse, count in zip(fit.mse, fit.count, strict=True)
    ])  # fmt: skip
    shares = squared / squared.sum()
    much = max(settings.DOUBT.outstanding, settings.DOUBT.outstanding_times / len(names))
    return [
        f'{name} holds {share:.0%} of the error that remains in {len(names)} records: look at '
        'what is different there before you believe what was found'
        for name, share in zip(names, shares, strict=True)
        if share > much
    ]


def verdict_of(causes: Sequence[Cause], left: bool, share: float) -> Verdict:
    """The verdict on records.

    Args:
        causes: Named causes.
        left: Whether they leave an error above the noise.
        share: Share of the squared error above the noise that they take.
    """
    if not causes:
        return Verdict.UNEXPLAINED if left else Verdict.CONSISTENT
    if left and share < settings.SELECTION.accounts:
        return Verdict.UNEXPLAINED
    rivals = any(cause.rivals for cause in causes)
    return Verdict.AMBIGUOUS if rivals else Verdict.EXPLAINED
