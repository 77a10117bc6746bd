"""Diagnosis: what a simulation gets wrong, the cause, and the gain of a model that has it.

    fit the nominal model -> is the residual more than noise?
      -> fit every effect of the library on top -> rank by evidence -> accept the best if it is
         earned on records held out -> again on top of that, until nothing more is earned
      -> doubt each accepted effect beside the others: is it still earned, would another do
         better in its place? If so, exchange it and go on from there
      -> with all of that in the model: how do the feet of a walking robot land?

diagnosis.md says how the decisions are taken and why.
"""

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from cg_dynamics.model import Model
from cg_dynamics.walking.contact import contact_law
from cg_sysid.deadline import Deadline, OutOfTime
from cg_sysid.diagnosis.conclude import conclude
from cg_sysid.diagnosis.doubt import exchange
from cg_sysid.diagnosis.early_end import answer_so_far
from cg_sysid.diagnosis.forward import extend
from cg_sysid.diagnosis.free_shapes import drawn_otherwise
from cg_sysid.diagnosis.landing_cause import with_landings
from cg_sysid.diagnosis.result import Diagnosis, Options
from cg_sysid.diagnosis.small_faults import less_small_faults
from cg_sysid.diagnosis.ties import ties_settled
from cg_sysid.diagnosis.workspace import Progress, Workspace
from cg_sysid.errors import Failure
from cg_sysid.identification.data_set import DataSet, led_in, prepare
from cg_sysid.identification.kept_fits import kept_in
from cg_sysid.identification.unknowns import IdentificationError
from cg_sysid.records.record import Record
from cg_sysid.search import settings
from cg_sysid.search.outcome import Outcome, chi2
from cg_sysid.search.standings import left_undone
from cg_sysid.search.task import Task
from cg_sysid.stances.held_foot import held_by_friction
from cg_sysid.stances.phases import Landing, cut_steps


def split(
    data_sets: Sequence[DataSet], chosen: Sequence[str] | None = None
) -> tuple[list[DataSet], list[DataSet]]:
    """Training and held-out data sets: within each set-up, every second recording is held out.

    Pieces of one recording share its mishaps and resting places and are poor judges of each
    other: they are split only where a set-up was recorded once.

    Args:
        data_sets: All of them.
        chosen: Names of those to hold out instead.

    Raises:
        IdentificationError: if there are fewer than two, or none is left on one side.
    """
    if len(data_sets) < 2:
        raise IdentificationError(
            f'{len(data_sets)} record: a diagnosis needs at least two, one to fit and one to '
            'judge; record another, or cut a long one into windows (--window SECONDS)'
        )
    if chosen is not None:
        held = [data_set for data_set in data_sets if data_set.name in chosen]
        train = [data_set for data_set in data_sets if data_set.name not in chosen]
        if not held or not train:
            raise IdentificationError(
                f'{len(held)} of {len(data_sets)} records held out; at least one is needed to fit '
                'and one to judge'
            )
        return train, held
    groups: dict[str, list[DataSet]] = {}
    for data_set in data_sets:
        groups.setdefault(repr(data_set.setup), []).append(data_set)
    train, held = [], []
    single = 0
    for group in groups.values():
        if len(group) == 1:
            # Set-ups recorded once go to training first, so that every set-up is fitted.
            (train if single % 2 == 0 else held).append(group[0])
            single += 1
            continue
        recordings = list(dict.fromkeys(data_set.recording for data_set in group))
        if len(recordings) > 1:
            train += [data_set for data_set in group if data_set.recording in recordings[0::2]]
            held += [data_set for data_set in group if data_set.recording in recordings[1::2]]
        else:
            train += group[0::2]
            held += group[1::2]
    if not held:
        held.append(train.pop())
    return train, held


def diagnose(
    model: Model,
    records: Sequence[Record],
    options: Options | None = None,
    progress: Progress | None = None,
    executor: Executor | None = None,
    landings: Sequence[Landing] | None = None,
    deadline: Deadline | None = None,
) -> Diagnosis:
    """Say what a model gets wrong about records of its machine.

    Args:
        model: The nominal model.
        records: At least two recordings that passed the check.
        options: How.
        progress: Called with (what, done, total, best candidate so far in words).
        executor: Where candidates are fitted; by default local processes.
        landings: What lies between records that are phases of walking ones (phases.cut_steps); by
            default the records are cut here.
        deadline: When to answer with the best so far (Diagnosis.unfinished); by default never.

    Raises:
        IdentificationError: if the records cannot be used with this model.
        OutOfTime: if the deadline passed before the nominal model was fitted.
    """
    options, progress = options or Options(), progress or (lambda *_: None)
    deadline = deadline or Deadline()
    if landings is None:
        cut = cut_steps(records, model)
        records, landings = cut.records, cut.landings
    prepared = [led_in(data_set) for data_set in prepare(model, [*records, *options.wholes])]
    data_sets = prepared[: len(records)]
    train, held = split(data_sets, options.held)
    held = judging_whole(held, train, prepared[len(records) :])

    def answer(train: Sequence[DataSet], held: Sequence[DataSet]) -> Diagnosis:
        work = Workspace(model, train, held, options, progress, executor, deadline)
        found = search(work)
        try:
            return with_landings(found, landings, work.carry_out, options.effects)
        except OutOfTime:
            return broken_off(found, deadline, 'the landings')

    with deadline.kept(), kept_in(options.kept):
        found = answer(train, held)
        if found.landings is None or 'foot_slip' not in found.landings.accepted:
            return found
        # Knowing the friction one knows better where the foot was held, and what that says.
        friction = contact_law(found.extended.model).friction
        slope = float(np.median([landing.touchdown.slope for landing in landings]))
        sides = [
            held_by_friction(found.extended.model, side, fit.motions, friction, slope)
            for side, fit in ((train, found.extended.train), (held, found.extended.held))
        ]
        same = all(len(a) == len(b) and all(x is y for x, y in zip(a, b, strict=True))
                   for a, b in zip(sides, (train, held), strict=True))  # fmt: skip
        if same or not all(sides):
            return found
        known_friction = 'the search again, with the friction of the ground known'
        try:
            again = answer(*sides)
        except OutOfTime:
            return broken_off(found, deadline, known_friction)
        if again.unfinished is not None:
            return broken_off(found, deadline, known_friction)
    before, after = found.landings, again.landings
    return again if after is not None and after.after.sum() < before.after.sum() else found


def broken_off(found: Diagnosis, deadline: Deadline, step: str) -> Diagnosis:
    """The diagnosis, marked as one that the deadline kept from one more step."""
    before = found.unfinished
    marked = (
        replace(before, steps=(*before.steps, step)) if before else left_undone(deadline, step)
    )
    summary = found.summary.removesuffix(f' {before.text}') if before else found.summary
    return replace(found, unfinished=marked, summary=f'{summary} {marked.text}')


def judging_whole(
    held: Sequence[DataSet], train: Sequence[DataSet], wholes: Sequence[DataSet]
) -> list[DataSet]:
    """Held-out data sets, whole recordings in place of their windows.

    Windows forgive a model that goes astray slowly: each begins anew. So a recording that can be
    followed whole judges whole, unless some of its windows are fitted.
    """
    fitted = {data_set.recording for data_set in train}
    judging = {w.recording: w for w in wholes if w.recording not in fitted}
    replaced = [judging.get(data_set.recording, data_set) for data_set in held]
    return list({data_set.name: data_set for data_set in replaced}.values())


def search(work: Workspace) -> Diagnosis:
    """All stages: fit the nominal model, extend it, doubt that, conclude.

    Raises:
        IdentificationError: if the nominal model cannot be fitted.
    """
    drawn = drawn_otherwise(work)
    models = [work.nominal] if drawn is None else [work.nominal, drawn]
    stated, *other = work.halving.fit([Task(m) for m in models], 'fitting the nominal model')
    if isinstance(stated, Failure):
        raise IdentificationError(stated.reason)
    base = stated
    if other and isinstance(other[0], Outcome) and chi2(other[0]) < chi2(stated):
        base = other[0]
    work.found = work.under_way = base
    try:
        final = extend(work, base)
        seen = {work.added(final)}
        for _ in range(settings.DOUBT.reviews):
            better = exchange(work, base, final)
            if better is None:
                break
            final = extend(work, better)
            if work.added(final) in seen:
                break
            seen.add(work.added(final))
        fewer = less_small_faults(work, final)
        lean = ties_settled(work, base, fewer)
        if lean is not fewer:  # else nothing has changed since they were asked
            lean = less_small_faults(work, lean)
        return conclude(work, stated, base, lean)
    except OutOfTime:
        return answer_so_far(work, stated)
