"""Diagnosis: what a simulation gets wrong, the cause, and the gain of a model that has it.

    fit the nominal model -> is the residual more than noise?
      -> fit every effect of the library on top -> rank by evidence -> accept the best if it is
         earned on records held out -> again on top of that, until nothing more is earned
      -> doubt each accepted effect beside the others: is it still earned, would another do
         better in its place? If so, exchange it and go on from there
      -> with all of that in the model: how do the feet of a walking robot land?

docs/diagnosis.md says how the decisions are taken and why.
"""

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from typing import Any

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.walking.contact import contact_law
from cg_sysid.deadline import Deadline, OutOfTime
from cg_sysid.diagnosis.between_recordings import Wandering
from cg_sysid.diagnosis.by_recording import what_wanders
from cg_sysid.diagnosis.experiment_design import Proposal, propose
from cg_sysid.diagnosis.landing_cause import with_landings
from cg_sysid.diagnosis.late_samples import late_samples
from cg_sysid.diagnosis.result import Cause, Diagnosis, Options, gains_of
from cg_sysid.diagnosis.summary import summary_of
from cg_sysid.identification.data_set import DataSet, prepare
from cg_sysid.identification.gain import Gain
from cg_sysid.identification.identify import Fit
from cg_sysid.identification.kept_fits import keeping, kept_in
from cg_sysid.identification.measured_start import MeasuredStart, judged
from cg_sysid.identification.unknowns import IdentificationError
from cg_sysid.learned.characterise import NEARLY_ALL, characterise, what_remains
from cg_sysid.learned.unmodelled import Unmodelled
from cg_sysid.parallel import run_all
from cg_sysid.records.record import Record
from cg_sysid.search.candidates import (
    SAME,
    SURE,
    THOROUGH_ITERATIONS,
    TOO_SMALL,
    Outcome,
    Task,
    candidates_for,
    chi2,
    events_in,
    events_of,
    first_seconds,
    fit_to_all,
    one_minimum,
    parameters_of,
    prior_conflicts,
    shared_parameters,
    started_from,
)
from cg_sysid.search.model_selection import (
    ACCOUNTS,
    COARSE_FIDELITY,
    EARNED,
    MATERIAL,
    Comparison,
    ModelSelection,
    above_noise,
    at_noise,
    explained_by,
    settled,
    share_explained,
)
from cg_sysid.search.nuisance import (
    as_sound_robots,
    faults_among,
    nuisances,
    with_nuisances,
)
from cg_sysid.search.ranking import Candidate, Round, contains, effect_name, per_output
from cg_sysid.search.standings import SoFar, Unfinished, title_of
from cg_sysid.search.successive_halving import RUNGS, Effects, SuccessiveHalving
from cg_sysid.stances.held_foot import held_by_friction
from cg_sysid.stances.phases import Landing, cut_steps
from cg_sysid.text import measured

log = logging.getLogger(__name__)

LEAD_IN_S = 0.1  # of each record, not judged
LEAD_IN_SHARE = 0.05  # of a short record
DEEPER = 3  # times that a base is asked for deeper minima
REVIEWS = 4  # passes of doubt over what was accepted
PROPOSED = 3  # experiments named for each cause with rivals
MOST_OF_IT = 0.7  # share of the error that may be left for small faults to be taken up
SHOWS = 3.0  # standard deviations from which a small fault is there at all
LEVEL = 1.0  # squared standard deviations within which two fits say the same of all data
FROM_AFAR = 2.0  # times the best start's error, from which a start leads nowhere else at the noise
OUTSTANDING = 0.2  # share of the squared error in one record that is worth a word
OUTSTANDING_TIMES = 4  # and as many times its even share
SMALL_FAULTS = 'small faults'
Progress = Callable[[str, int, int, str], None]
Structure = tuple[frozenset[str], frozenset[str]]  # labels of effects, names of small faults


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
        search = _Search(model, train, held, options, progress, executor, deadline)
        found = search.run()
        try:
            return with_landings(found, landings, search.carry_out, options.effects)
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
    before = found.unfinished or Unfinished(deadline.why, deadline.passed, (), (), (), ())
    marked = replace(before, steps=(*before.steps, step))
    summary = found.summary.removesuffix(f' {before.text}')
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


def led_in(data_set: DataSet) -> DataSet:
    """The data set less the outputs of its first moments.

    What went before a record is an assumption of every model with a memory, as a delay; it must
    not count for or against the model.
    """
    begun = data_set.time >= min(LEAD_IN_S, LEAD_IN_SHARE * data_set.duration)
    return replace(data_set, outputs=np.where(begun[:, None], data_set.outputs, np.nan))


def verdict_of(causes: Sequence[Cause], left: bool, share: float) -> str:
    """The verdict on records.

    Args:
        causes: Named causes.
        left: Whether they leave an error above the noise.
        share: Share of the squared error above the noise that they take.
    """
    if not causes:
        return 'unexplained' if left else 'consistent'
    if left and share < ACCOUNTS:
        return 'unexplained'
    return 'ambiguous' if any(cause.rivals for cause in causes) else 'explained'


class _Search:
    """State of one diagnosis: what was tried on top of what."""

    def __init__(self, model, train, held, options, progress, executor, deadline):
        self.deadline = deadline
        self.nominal, self.options, self.progress = model, options, progress
        self.train, self.held, self.executor = train, held, executor
        self.selection = ModelSelection(train, held)
        self.halving = SuccessiveHalving(train, held, self.carry_out)
        self.so_far = SoFar(frozenset(effect.label for effect in model.effects))
        # By the labels of what was added, and whether small faults are allowed for.
        self.comparisons: dict[tuple[frozenset[str], bool], Comparison] = {}
        self.thorough: dict[Structure, Outcome] = {}
        self.joint: dict[Structure, Fit | str] = {}  # to all records
        # For an answer before the end: what stands, and the base of the contest under way.
        self.found: Outcome
        self.under_way: Outcome
        self.rounds: list[Round] = []
        self.instead = ''  # of a small fault, if something else explains as much
        self.doubted: dict[str, Outcome] = {}  # cause -> small faults that explain as much

    def run(self) -> Diagnosis:
        base = self.halving.fit([Task(self.nominal)], 'fitting the nominal model')[0]
        if isinstance(base, str):
            raise IdentificationError(base)
        self.found = self.under_way = base
        try:
            return self._search(base)
        except OutOfTime:
            return self._broken_off(base)

    def _search(self, base: Outcome) -> Diagnosis:
        final = self._extend(base)
        seen = {self._added(final)}
        for _ in range(REVIEWS):
            better = self._exchange(base, final)
            if better is None:
                break
            final = self._extend(better)
            if self._added(final) in seen:
                break
            seen.add(self._added(final))
        final = self._ties_settled(base, self._less_small_faults(final))
        return self._conclude(base, self._less_small_faults(final))

    def _added(self, o: Outcome) -> frozenset[str]:
        """Labels of the effects that were put on top of the nominal model, less small faults."""
        return self._added_to(o.model) - nuisances(o.model, o.task.bounds)

    def _added_to(self, model: Model) -> frozenset[str]:
        stated = {effect.label for effect in self.nominal.effects}
        return frozenset(effect.label for effect in model.effects) - stated

    def _extend(self, o: Outcome) -> Outcome:
        """Accept one effect after the other, until nothing more is earned."""
        self.found = o
        while len(self._added(o)) < self.options.rounds:
            plain, o = o, self._with_small_faults(o)
            winner = None
            if not self._done(o):
                comparison = self._of_size(self._compare(o))
                o, winner = comparison.base, comparison.winner()
                self._note(comparison, winner[0].label if winner else '')
            if winner is not None:
                self.found = winner[1]
                o = self.found = self._refitted(winner[1])
                continue
            if plain is o and o.task.bounds and not settled(o):
                # They came in before the causes did, and another cause could do without them.
                plain = self._bare(o) or o
            cause = self._rather_one_cause(plain, o)
            if cause is None:
                break
            o = cause
        return o

    def _refitted(self, o: Outcome) -> Outcome:
        """The same structure from the file's numbers again, if that comes out better.

        What stands as the base of a round has to be as good as it can be, or the next effect is
        accepted for a better fit of this one. At the noise there is no next round.
        """
        if settled(o):
            return o
        task = Task(o.model, events=o.events, bounds=o.task.bounds)
        again = self.halving.fit([task], f'{o.label} again')
        better = [a for a in again if isinstance(a, Outcome) and chi2(a) < chi2(o)]
        return replace(better[0], label=o.label) if better else o

    def _thorough(self, o: Outcome) -> Outcome:
        """The last fit of what was found: its values are what people will use.

        Thorough fits stand in contests only among themselves, or they would have the advantage.
        """
        key = _structure(o)
        if key not in self.thorough:
            self.thorough[key] = self._fitted_thoroughly(o)
        return replace(self.thorough[key], label=o.label)

    def _fitted_thoroughly(self, o: Outcome) -> Outcome:
        task = Task(o.model, events=o.events, bounds=o.task.bounds, thorough=True,
                    iterations=THOROUGH_ITERATIONS)  # fmt: skip
        tasks = [
            replace(task, warm_starts=(start.train,)) for start in (o, *self._other_minima(o))
        ]
        title = f'thorough fits of {self._title(self._added(o))}'
        found = [
            fitted for fitted in self.halving.fit(tasks, title) if isinstance(fitted, Outcome)
        ]
        return min([o, *found], key=chi2)

    def _other_minima(self, o: Outcome) -> list[Outcome]:
        """The same structure from other starts of its effects, where these may lead deeper.

        Near the noise no contest asked for them.
        """
        effects = [o.model.effect(label) for label in sorted(self._added(o))]
        without = [
            Task(o.model.without_effect(e.label), (e.name, e.at), o.events, o.task.bounds)
            for e in effects
        ]
        title = f'other starts of {self._title(self._added(o))}'
        near = SAME * o.train.normalised_error
        tasks = [
            replace(screening.task, warm_starts=(warm_start,), iterations=RUNGS[0], reach=near)
            for screening in self.halving.screen_beside(without, title)
            for warm_start in screening.task.warm_starts
            if warm_start.normalised_error < FROM_AFAR * screening.error
        ]
        found = self.halving.fit(tasks, title)
        return [
            other for other in found
            if isinstance(other, Outcome) and other.train.normalised_error < near
            and not one_minimum(other.train, o.train, other.label)
            and not _further_up(other.train, o.train)
        ]  # fmt: skip

    def _tie(self, comparison: Comparison, label: str) -> Comparison | None:
        """An effect and its rivals, fitted thoroughly: what is a tie then is one.

        One that has the effect within it fits as well by itself, and is no rival.
        """
        rivals = (c.label for c in comparison.close_to(label, COARSE_FIDELITY))
        close = [label, *(rival for rival in rivals if not contains(rival, label))]
        ties = [pair[1] for name in close if (pair := comparison.of(name)) and at_noise(pair[1])]
        if len(ties) < 2 or ties[0].label != label:
            return None
        outcomes = [self._thorough(o) for o in ties]
        return self.selection.comparison(
            comparison.base, outcomes, [self._fit_to_all(o) for o in outcomes]
        )

    def _fit_to_all(self, o: Outcome) -> Fit | str:
        """A thorough fit of an outcome's structure to all records, or why there is none."""
        key = _structure(o)
        if key not in self.joint:
            title = f'{self._title(self._added(o))} on all records'
            found = self.carry_out(fit_to_all, [(o, (*self.train, *self.held))], title)[0]
            self.joint[key] = found
        return self.joint[key]

    def _ties_settled(self, nominal: Outcome, final: Outcome) -> Outcome:
        """The structure with those effects that win over their rivals in thorough fits.

        Of several that do as well, the one that needs the fewest small faults beside it.
        """
        for label in sorted(self._added(final)):
            comparison = self._without(nominal, final, label)
            tie = comparison and self._tie(comparison, label)
            own, winner = (tie.of(label), tie.winner()) if tie else (None, None)
            if not (tie and own and winner):
                continue
            level = [
                o
                for c, o in tie.ranked
                if not c.reason and c.evidence > winner[0].evidence - tie.margin
            ]
            best = min(level, key=lambda o: len(_shown(o)))
            beaten = own[0].evidence < winner[0].evidence - tie.margin
            if beaten or len(_shown(best)) < len(_shown(own[1])):
                final = best
        return final

    def _with_small_faults(self, o: Outcome) -> Outcome:
        """The same with what every robot has a little of, if that explains anything."""
        if settled(o) or o.task.bounds:
            return o
        model, bounds = with_nuisances(o.model, self._setups())
        title = f'{self._title(self._added(o))}, with small faults'
        found = self.halving.fit([Task(model, events=o.events, bounds=bounds)], title)[0]
        if isinstance(found, str):
            log.info('small faults: %s', found)
            return o
        if at_noise(o):
            return found if settled(found) else o  # only beliefs are at stake
        # Beside a large cause they would explain a little of it; then they can wait.
        return found if chi2(found) < MOST_OF_IT * chi2(o) else o

    def _rather_one_cause(self, plain: Outcome, faulty: Outcome) -> Outcome | None:
        """One effect that alone explains more than all small faults together, if there is one.

        Together they can imitate much, but hardly down to the last of it.
        """
        if faulty is plain or settled(plain):
            return None
        comparison = self._compare(plain, faulty.train.normalised_error)
        plain, winner = comparison.base, comparison.winner()
        if winner is None:
            return plain if settled(plain) else None
        least = winner[0].evidence - comparison.margin
        if any(as_sound_robots(c.label, c.parameters)
               for c, _ in comparison.ranked if c.evidence > least):  # fmt: skip
            return None  # it may be no more than that
        both = self.selection.comparison(plain, [winner[1], replace(faulty, label=SMALL_FAULTS)])
        (first, _), (second, _) = both.ranked
        label = winner[0].label
        if first.evidence < second.evidence + both.margin:
            if len(_shown(faulty)) < 2:
                self.instead = _instead(*winner)
                return None
            # One cause that looks like several small faults, or several that conspire.
            self.doubted[label] = replace(faulty, label=SMALL_FAULTS)
        elif first.label == SMALL_FAULTS:
            return None
        self._note(comparison, label)
        return self._refitted(winner[1])

    def _of_size(self, comparison: Comparison) -> Comparison:
        """Without winners that hide behind small faults, but are small themselves.

        What a cause explains is asked beside those small faults only that it does not make idle.
        """
        while self.selection.imitated(comparison.base) and (winner := comparison.winner()):
            label = winner[0].label
            lean = self._less_small_faults(winner[1])
            without = self._without_small_faults(lean, [label])
            explained = explained_by(without, lean) if without else 0.0
            if explained >= MATERIAL:
                break
            comparison = comparison.less(
                label, f'explains {explained:.2f} noise standard deviations where no small fault '
                f'does, {MATERIAL:g} needed'
            )  # fmt: skip
        return comparison

    def _less_small_faults(self, final: Outcome) -> Outcome:
        """Without those small faults that, beside the causes, explain nothing any more."""
        small = nuisances(final.model, final.task.bounds)
        idle = [label for label in sorted(small) if not _shows(final, label)]
        for gone in (sorted(small), idle):
            if not gone:
                continue
            lean = self._without_small_faults(final, gone)
            if lean is None:
                continue
            if self.selection.comparison(lean, [final]).ranked[0][0].evidence < EARNED:
                return lean
        return final

    def _bare(self, o: Outcome) -> Outcome | None:
        """The same without anything small that the nominal model does not state."""
        bare = replace(o, task=replace(o.task, bounds=faults_among(o.model, o.task.bounds)))
        return self._without_small_faults(bare, sorted(nuisances(o.model, o.task.bounds)))

    def _without_small_faults(self, o: Outcome, gone: Sequence[str]) -> Outcome | None:
        """The same without the small faults of these labels; None where that cannot be fitted."""
        model, bounds = o.model, dict(o.task.bounds)
        for label in gone:
            model = model.without_effect(label)
            bounds = {n: b for n, b in bounds.items() if not n.startswith(f'{label}.')}
        start = started_from(o.train, model, bounds)
        task = Task(model, events=o.events, bounds=bounds, warm_starts=(start,))
        lean = self.halving.fit([task], 'without small faults')[0]
        return None if isinstance(lean, str) else lean

    def _setups(self) -> list[Setup]:
        return [data_set.setup for data_set in (*self.train, *self.held)]

    def _exchange(self, nominal: Outcome, final: Outcome) -> Outcome | None:
        """A better structure: without an effect that is not earned, or with another instead.

        Beside the others an effect may turn out to have stood in for what came later.
        """
        for label in sorted(self._added(final)):
            comparison = self._without(nominal, final, label)
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

    def _without(self, nominal: Outcome, final: Outcome, label: str) -> Comparison | None:
        """The library in competition for the place of one of several effects."""
        others = self._added(final) - {label}
        key = others, bool(final.task.bounds)
        if key not in self.comparisons:
            model, bounds = final.model.without_effect(label), final.task.bounds
            if bounds:
                model, missing = with_nuisances(model, self._setups())
                bounds = {**bounds, **missing}
            task = Task(model, events=final.events, bounds=bounds)
            known = not others and not bounds
            lean = nominal if known else self.halving.fit([task], f'model without {label}')[0]
            if isinstance(lean, str):
                log.info('without %s: %s', label, lean)
                return None
            # Who would take the place has to come up to what is there.
            self._compare(lean, final.train.normalised_error)
        comparison = self.comparisons[key]
        # The fit beside the others may have been better, or the only one that went through.
        ranked = comparison.of(label)
        if ranked is None or chi2(final) < chi2(ranked[1]):
            outcomes = [o for _, o in comparison.ranked if o.label != label]
            again = self.selection.comparison(
                comparison.base, [*outcomes, replace(final, label=label)]
            )
            comparison = self.comparisons[key] = replace(again, aside=comparison.aside)
        return comparison

    def _compare(self, base: Outcome, beaten: float = np.inf) -> Comparison:
        """The library in competition on top of a base, and with what came to chi2/N `beaten`."""
        added = self._added(base)
        key = added, bool(base.task.bounds)
        if key not in self.comparisons:
            recorded = {name for data_set in self.train for name in data_set.input_names}
            bounds = base.task.bounds
            effects = candidates_for(
                base.model, self._setups(), self.options.effects, recorded,
                nuisances(base.model, bounds),
            )  # fmt: skip
            title = f'effects on top of {self._title(added)}'
            self.under_way = base
            base, alone = self._led_deeper(base, effects, title)
            self.under_way = base
            outcomes, aside = (
                ([], [])
                if self._done(base)
                else self.halving.run(
                    alone, effects, title, beaten, self.selection.to_be_earned(base)
                )
            )
            comparison = self.selection.comparison(base, outcomes)
            self.comparisons[key] = replace(comparison, aside=tuple(aside))
        return self.comparisons[key]

    def _led_deeper(self, base: Outcome, effects: Effects, title: str) -> tuple[Outcome, Task]:
        """A base, or the deeper minimum of it that effects on top of it showed; and its task."""
        alone = self._alone(base)
        for _ in range(DEEPER):
            warm_start = (
                None if self._done(base) else self.halving.lead_deeper(alone, effects, title)
            )
            if warm_start is None:
                break
            task = replace(alone, warm_starts=(warm_start,), base=None)
            deeper = self.halving.fit([task], f'{self._title(self._added(base))}, deeper')[0]
            if isinstance(deeper, str) or SAME * chi2(deeper) > chi2(base):
                break
            self.halving.forget(alone)
            base = replace(deeper, label=base.label)
            alone = self._alone(base)
        return base, alone

    def _done(self, o: Outcome) -> bool:
        """Whether there is nothing to look for on top of this."""
        return (settled(o) and not self.selection.imitated(o)) or self.selection.nothing_material(
            o
        )

    def _alone(self, base: Outcome) -> Task:
        """The task of a base by itself, with its fits."""
        task = Task(base.model, None, base.events, base.task.bounds, base=base.train)
        return replace(task, first=first_seconds(task, self.train))

    def carry_out(self, function: Callable, arguments: list[tuple], what: str) -> list:
        # Other machines have no such folder.
        kept = self.options.kept if self.executor is None else None
        return run_all(
            keeping, [(kept, function, *a) for a in arguments], self.options.workers,
            self.executor,
            lambda done, total, result: self.progress(what, done, total, self._best(result)),
        )  # fmt: skip

    def _best(self, result: Any) -> str:
        """The best candidate after one more result, in words."""
        self.so_far.note(result)
        return self.so_far.best

    def _title(self, added: frozenset[str]) -> str:
        return title_of(added)

    def _note(self, comparison: Comparison, accepted: str) -> None:
        candidates = tuple(c for c, _ in comparison.ranked)
        title = self._title(self._added(comparison.base))
        self.rounds.append(
            Round(title, candidates, accepted, comparison.independent, comparison.aside)
        )

    def _causes(self, nominal: Outcome, final: Outcome) -> list[Cause]:
        causes = []
        for label in self._added(final):
            comparison = self._without(nominal, final, label)
            if comparison is None:
                causes.append(Cause(label, parameters_of(final, label), float('inf')))
                continue
            if len(self._added(final)) > 1:
                self._note(comparison, label)
            cause = _cause(final, label, self._tie(comparison, label) or comparison)
            if label in self.doubted:
                cause = replace(cause, rivals=(*cause.rivals, *_shown(self.doubted[label])))
            causes.append(replace(cause, proposals=self._proposals(final, cause, comparison)))
        return sorted(causes, key=lambda cause: -cause.evidence)

    def _proposals(
        self, final: Outcome, cause: Cause, comparison: Comparison
    ) -> tuple[Proposal, ...]:
        """Experiments that would tell a cause from its rivals."""
        if not cause.rivals or not self.options.experiments:
            return ()
        found = (comparison.of(label) for label in cause.rivals)
        rivals = [replace(final, label=cause.label), *(pair[1] for pair in found if pair)]
        if cause.label in self.doubted:
            rivals.append(self.doubted[cause.label])
        if len(rivals) < 2:
            return ()
        return propose(
            rivals, self.train[0].sigma, self.options.experiments, self.options.workers,
            self.executor,
            lambda done, total: self.progress(
                'rehearsing experiments to tell causes apart', done, total, self._best(None)
            ),
        )[:PROPOSED]  # fmt: skip

    def _remaining(self, o: Outcome) -> dict[str, float]:
        """chi2/N of each output on held-out records."""
        names, errors = self.nominal.mechanism.outputs, per_output(o.held)
        return {name: float(error) for name, error in zip(names, errors, strict=True)}

    def _left(self, o: Outcome) -> dict[str, float]:
        """Those of them that are above the noise."""
        return {c: v for c, v in self._remaining(o).items() if v > (1 + MATERIAL) ** 2}

    def _own_judges(self) -> list[str]:
        """That recordings were judged by pieces of themselves, in words."""
        fitted = {data_set.recording for data_set in self.train}
        judges = {data_set.recording for data_set in self.held}
        if judges - fitted:
            return []
        return [
            f'what was found in {", ".join(sorted(judges))} was judged on other pieces of the '
            'same recordings, which share their mishaps: record again before you believe it'
        ]

    def _small_faults(self, final: Outcome) -> list[str]:
        """What is there of small faults and what else would explain them, in words."""
        found = _small_faults(final)
        if self.selection.imitated(final):
            found.append(
                f'what these leave is {1 + above_noise(final):.3f} times the noise and follows '
                'something: a small cause may hide behind them'
            )
        return [*found, self.instead] if found and self.instead else found

    def _wandering(self, o: Outcome) -> Wandering | None:
        """The number that differs from recording to recording, if one explains what is left."""
        return what_wanders(o, (*self.train, *self.held), self.options.effects, self.carry_out)

    def _late_samples(self, gains: Sequence[Gain]) -> str:
        """That instants of sampling are not where their stamps say, in words."""
        worst = max(gains, key=lambda g: g.before / g.noise)
        body = self.nominal.mechanism
        return late_samples(
            (*self.train, *self.held), body.name, body.outputs, worst.channel, worst.unit
        )

    def _less_mishaps(self, nominal: Outcome, final: Outcome) -> Outcome:
        """Without what happened in single records, if a number that differs explains more.

        A push in every record is many values, and takes the edge off whatever is wrong in each.
        """
        for label in sorted(self._added(final)):
            if all(p.each != 'record' for p in final.model.effect(label).parameters):
                continue
            comparison = self._without(nominal, final, label) if self._left(final) else None
            wandering = self._wandering(comparison.base) if comparison else None
            if comparison and wandering:
                unexplained = (1 - wandering.explained) * above_noise(comparison.base)
                final = comparison.base if unexplained < above_noise(final) else final
        return final

    def _conclude(self, nominal: Outcome, final: Outcome) -> Diagnosis:
        unmodelled = None
        if self._left(final):
            unmodelled, stand = what_remains(
                nominal, final, self._added(final), self.train, self.held, self.carry_out
            )
            final = final if stand else nominal
            relative = None
            if not self._added(final):
                relative = self._relative(nominal, unmodelled)
            if relative is not None:
                final = relative
                unmodelled = characterise(final, self.train, self.held, self.carry_out)
        final = self._less_mishaps(nominal, final)
        causes = self._causes(nominal, final)
        final = self._thorough(final)
        causes = [self._with_events(final, _as_in(final, cause)) for cause in causes]
        left = self._left(final)
        wandering = self._wandering(final) if left else None
        if wandering and unmodelled and unmodelled.explained > wandering.explained:
            wandering = None  # the same for all records, and more
        share = share_explained(nominal.held, final.held)
        verdict = verdict_of(causes, bool(left), share)
        late = self._late_samples(self._gains(nominal, final)) if verdict == 'unexplained' else ''
        return self._answer(nominal, final, causes, verdict, unmodelled, wandering, late)

    def _relative(self, nominal: Outcome, term: Unmodelled | None) -> Outcome | None:
        """An effect of the library with the period of a learned term, if it takes nearly all.

        How often a turn something repeats has many local minima; a learned term knows it.
        """
        if term is None or term.period is None:
            return None
        period, size = term.period[0], float(np.ptp(term.shape.value) / 2)
        tasks = []
        for name, kind in LIBRARY.items():
            if kind.family != term.effect.family:
                continue
            at = kind(self.nominal.mechanism, term.effect.site).at
            for values in kind.repeating(period, size):
                model = nominal.task.model.with_effect(name, at, **values)
                known = replace(term.fit, motions=nominal.train.motions, own=nominal.train.own)
                start = started_from(known, model, nominal.task.bounds)
                tasks.append(Task(model, bounds=nominal.task.bounds, warm_starts=(start,)))
        found = self.halving.fit(tasks, f'{term.label}, as effects of the library')
        outcomes = [
            replace(o, label=o.model.effects[-1].label) for o in found if isinstance(o, Outcome)
        ]
        if not outcomes:
            return None
        comparison = self.selection.comparison(nominal, [min(outcomes, key=chi2)])
        winner = comparison.winner()
        if winner is None or share_explained(nominal.held, winner[1].held) < NEARLY_ALL:
            return None
        self.comparisons[frozenset(), bool(nominal.task.bounds)] = comparison
        self._note(comparison, winner[0].label)
        return winner[1]

    def _with_events(self, final: Outcome, cause: Cause) -> Cause:
        """The cause with what every record has of its own by a fit to all records.

        A held-out record takes the shared numbers for certain, and its intervals are too narrow;
        and so are all if the law is taken for exact in its shape.
        """
        parameters = final.model.effect(cause.label).parameters
        if not any(p.each for p in parameters):
            return cause
        shapes = {f'{cause.label}.{p.name}': p.leeway for p in parameters if p.leeway}
        task = replace(final.task, bounds={**final.task.bounds, **shapes})
        found = self._fit_to_all(replace(final, task=task))
        if isinstance(found, str):
            log.info('%s on all records: %s', cause.label, found)
            return cause
        names = [name for side in final.data_sets for name in side]
        return replace(
            cause,
            events=events_in(found, names, cause.label),
            parameters=cause.parameters | shared_parameters(found, cause.label),
            undetermined=_undetermined(found, cause.label),
        )

    def _broken_off(self, nominal: Outcome) -> Diagnosis:
        """The best answer before the end, without any fit more."""
        final, comparison = self.found, None
        if self._added(self.under_way) >= self._added(final):
            final = self.under_way
            comparison = self.selection.comparison(final, self.so_far.fitted(final.task))
            winner = None if self._done(final) else comparison.winner()
            self._note(comparison, winner[0].label if winner else '')
            final = winner[1] if winner else final
        comparisons = [*self.comparisons.values(), *([comparison] if comparison else [])]
        causes = [_cause_among(final, label, comparisons) for label in sorted(self._added(final))]
        left = bool(self._left(final))
        verdict = verdict_of(causes, left, share_explained(nominal.held, final.held))
        verdict = 'unfinished' if verdict == 'unexplained' else verdict
        return self._answer(
            nominal, final, sorted(causes, key=lambda cause: -cause.evidence), verdict,
            unfinished=self._unfinished(final, left),
        )  # fmt: skip

    def _unfinished(self, final: Outcome, left: bool) -> Unfinished:
        """What was not come to."""
        base = self.under_way.task
        fitted = {o.label for o in self.so_far.fitted(base)}
        looked = {screening.label for screening in self.so_far.screened(base)} - fitted
        recorded = {name for data_set in self.train for name in data_set.input_names}
        possible = candidates_for(base.model, self._setups(), self.options.effects, recorded,
                                  nuisances(base.model, base.bounds))  # fmt: skip
        labels = {LIBRARY[name](base.model.mechanism, at).label for name, at in possible}
        ruled_out = {label for r in self.rounds for label in r.aside}
        ranking = [s for s in self.so_far.ranking(base) if s.label not in self._added(final)]
        steps = ['further causes'] if left else []
        if self._added(final):
            steps += ['doubt about each cause beside the others', 'thorough fits of the answer']
        return Unfinished(
            self.deadline.why, self.deadline.passed, tuple(ranking),
            tuple(sorted(looked - ruled_out)),
            tuple(sorted(labels - looked - fitted - self._added(final))), tuple(steps),
        )  # fmt: skip

    def _gains(self, nominal: Outcome, final: Outcome) -> tuple[Gain, ...]:
        return gains_of(self.nominal, self.held, nominal.held, final.held)

    def _from_measured_angles(self, nominal: Outcome, final: Outcome) -> MeasuredStart | None:
        try:
            return judged(self.nominal.mechanism, self.held, nominal.held, final.held)
        except (IdentificationError, DynamicsError, OutOfTime) as error:
            log.info('from measured angles: %s', error)
            return None

    def _answer(
        self,
        nominal: Outcome,
        final: Outcome,
        causes: Sequence[Cause],
        verdict: str,
        unmodelled: Unmodelled | None = None,
        wandering: Wandering | None = None,
        late: str = '',
        unfinished: Unfinished | None = None,
    ) -> Diagnosis:
        gains = self._gains(nominal, final)
        reference = self.selection.judge(nominal, nominal, 0.0)
        extended = self.selection.judge(nominal, final, sum(c.evidence for c in causes))
        summary = summary_of(
            verdict, causes, gains, self._left(final), tuple(prior_conflicts(nominal)), unmodelled,
            self.options.effects, wandering, share_explained(nominal.held, final.held), late,
        )  # fmt: skip
        measured_start = self._from_measured_angles(nominal, final) if causes else None
        doubt = [measured_start.text] if measured_start and not measured_start.helps else []
        return Diagnosis(
            verdict=verdict,
            summary=f'{summary} {unfinished.text}' if unfinished else summary,
            causes=tuple(causes),
            gains=gains,
            nominal=self.nominal,
            baseline=replace(reference, reason=''),
            extended=replace(extended, reason=''),
            rounds=tuple(self.rounds),
            train=tuple(self.train),
            held=tuple(self.held),
            remaining=self._remaining(final),
            findings=(
                *self._small_faults(final), *_shapes(final), *_outstanding(final),
                *doubt, *(self._own_judges() if causes else ()), *final.train.warnings,
            ),
            unmodelled=unmodelled,
            wandering=wandering,
            late=late,
            unfinished=unfinished,
            measured_start=measured_start,
        )  # fmt: skip


def _further_up(other: Fit, found: Fit) -> bool:
    """Whether a fit lies in a valley of the data with another, where the file believes less.

    Fitted to its end it would come down along the valley to the other, slowly.
    """
    level = abs(other.squares - found.squares) < LEVEL
    return level and other.belief >= found.belief


def _structure(o: Outcome) -> Structure:
    return frozenset(e.label for e in o.model.effects), frozenset(o.task.bounds)


def _shown(o: Outcome) -> tuple[str, ...]:
    """Small faults that are there."""
    small = sorted(nuisances(o.model, o.task.bounds))
    return tuple(label for label in small if _shows(o, label))


def _shows(o: Outcome, label: str) -> bool:
    """True if a small fault is larger than its uncertainty."""
    value, sigma, _ = next(iter(parameters_of(o, label).values()))
    return abs(value) > SHOWS * sigma


def _small_faults(o: Outcome) -> list[str]:
    """What is there of small faults, in words."""
    found = []
    for label in sorted(nuisances(o.model, o.task.bounds)):
        for name, (value, sigma, unit) in parameters_of(o, label).items():
            if abs(value) > SHOWS * sigma:
                found.append(
                    f'{label}.{name} = {measured(value, sigma, unit)}: as sound robots have it'
                )
    return found


def _shapes(o: Outcome) -> list[str]:
    """Laws that have another shape than the model states, in words."""
    found = []
    for u, v, s in zip(o.train.unknowns, o.train.values, o.train.sigmas, strict=True):
        if u.name not in o.task.bounds or not o.model.declarations[u.name].leeway:
            continue
        off = abs(u.to_coordinate(v) - u.to_coordinate(u.prior))
        if off > SHOWS * (s / v if u.logarithmic else s):
            found.append(
                f'{u.name} = {measured(v, s, u.unit)} and not {measured(u.prior, None, u.unit)}: '
                'the shape of a law, which texts and machines draw differently'
            )
    return found


def _instead(candidate: Candidate, o: Outcome) -> str:
    """That one effect explains as much as a small fault, in words."""
    numbers = ', '.join(
        f'{name} = {measured(value, sigma, unit)}'
        for name, (value, sigma, unit) in parameters_of(o, candidate.label).items()
    )
    return (
        f'{candidate.label} ({numbers}) alone would explain as much as this small fault does: '
        'records in other set-ups would tell'
    )


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
    much = max(OUTSTANDING, OUTSTANDING_TIMES / len(names))
    return [
        f'{name} holds {share:.0%} of the error that remains in {len(names)} records: look at '
        'what is different there before you believe what was found'
        for name, share in zip(names, shares, strict=True)
        if share > much
    ]


def _as_in(final: Outcome, cause: Cause) -> Cause:
    """The cause with the values of another fit."""
    return replace(
        cause,
        parameters=parameters_of(final, cause.label),
        events=events_of(final, cause.label),
        undetermined=_undetermined(final.train, cause.label),
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
        abs(value - first.neutral) <= TOO_SMALL * sigma
        and abs(stated.value - first.neutral) > SURE * sigma
    )


def _cause_among(final: Outcome, label: str, comparisons: Sequence[Comparison]) -> Cause:
    """The cause, judged by the contest that had the most beside it."""
    known = [c for c in comparisons if (own := c.of(label)) and not own[0].reason]
    if not known:
        return _as_in(final, Cause(label, parameters_of(final, label), float('inf')))
    comparison = max(known, key=lambda c: len(c.base.model.effects))
    return _as_in(final, _cause(final, label, comparison))


def _cause(final: Outcome, label: str, comparison: Comparison) -> Cause:
    own = comparison.of(label)
    assert own is not None
    name = effect_name(label)
    close = comparison.close_to(label)
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
