"""Diagnosis: what a simulation gets wrong, the cause, and the gain of a model that has it.

    fit the nominal model -> is the residual more than noise?
      -> fit every effect of the library on top -> rank by evidence -> accept the best if it is
         earned on records held out -> again on top of that, until nothing more is earned
      -> look again at each accepted effect: could another take its place?

docs/diagnosis.md says how the decisions are taken and why.
"""

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import replace

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid.candidates import (
    Outcome,
    Task,
    at_edge,
    candidates_for,
    chi2,
    own_parameters,
    parameters_of,
    try_candidate,
)
from cg_sysid.diagnosis import (
    Candidate,
    Cause,
    Diagnosis,
    Options,
    Round,
    effect_name,
    gains_of,
    per_output,
    summary_of,
)
from cg_sysid.evidence import block_gain, evidence, independent_samples
from cg_sysid.parallel import run_all
from cg_sysid.record import Record
from cg_sysid.trial import Trial, prepare
from cg_sysid.unknowns import IdentificationError

log = logging.getLogger(__name__)

MARGIN = 6.0  # nats: rivals closer than this are not told apart (odds of 400 to 1)
# No model is trusted to describe a machine better than this share of the noise power: rivals whose
# chi2/N differ by less are not told apart, however many samples say so.
FIDELITY = 2e-3
EARNED = 10.0  # nats an effect must gain over the model without it
MATERIAL = 1.0  # an effect must explain this much error, in standard deviations of the noise
AT_NOISE = 1.3  # chi2/N up to which a channel counts as explained down to noise
SIGNIFICANT = 2.5  # standard errors by which the held-out error must fall, block by block
FEWEST_BLOCKS = 20  # short records are cut into shorter blocks, but not below
SHORTEST_BLOCK_S = 0.1
BLOCK_S = 0.5  # length of the blocks on which a held-out gain is tested
Progress = Callable[[str, int, int], None]


def split(
    trials: Sequence[Trial], chosen: Sequence[str] | None = None
) -> tuple[list[Trial], list[Trial]]:
    """Training and held-out trials: within each set-up, every second one is held out.

    Args:
        trials: All of them.
        chosen: Names of those to hold out instead.

    Raises:
        IdentificationError: if there are fewer than two, or none is left on one side.
    """
    if len(trials) < 2:
        raise IdentificationError(
            f'{len(trials)} record: a diagnosis needs at least two, one to fit and one to judge; '
            'record another, or cut a long one into windows (--window SECONDS)'
        )
    if chosen is not None:
        held = [trial for trial in trials if trial.name in chosen]
        train = [trial for trial in trials if trial.name not in chosen]
        if not held or not train:
            raise IdentificationError(
                f'{len(held)} of {len(trials)} records held out; at least one is needed to fit '
                'and one to judge'
            )
        return train, held
    groups: dict[str, list[Trial]] = {}
    for trial in trials:
        groups.setdefault(repr(trial.setup), []).append(trial)
    train, held = [], []
    single = 0
    for group in groups.values():
        if len(group) == 1:
            # Set-ups recorded once go to training first, so that every set-up is fitted.
            (train if single % 2 == 0 else held).append(group[0])
            single += 1
            continue
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
) -> Diagnosis:
    """Say what a model gets wrong about records of its machine.

    Args:
        model: The nominal model.
        records: At least two recordings that passed the check.
        options: How.
        progress: Called with (what, done, total).
        executor: Where candidates are fitted; by default local processes.

    Raises:
        IdentificationError: if the records cannot be used with this model.
    """
    options = options or Options()
    train, held = split(prepare(model, records), options.held)
    search = _Search(model, train, held, options, progress or (lambda *_: None), executor)
    return search.run()


class _Search:
    """State of one diagnosis: the current base and what has been tried."""

    def __init__(self, model, train, held, options, progress, executor):
        self.nominal, self.options, self.progress = model, options, progress
        self.train, self.held, self.executor = train, held, executor
        self.rounds: list[Round] = []
        trials = (*train, *held)
        self.steps = [float(np.median(np.diff(trial.time))) for trial in trials]
        judged = sum(trial.duration for trial in held)
        block = min(BLOCK_S, max(judged / FEWEST_BLOCKS, SHORTEST_BLOCK_S))
        self.rows_per_block = max(1, int(block / np.median(self.steps)))

    def run(self) -> Diagnosis:
        base = self._fit([Task(self.nominal)], 'nominal model')[0]
        if isinstance(base, str):
            raise IdentificationError(base)
        nominal = base
        accepted: list[Outcome] = []
        while len(accepted) < self.options.rounds and not self._at_noise(base):
            ranked, independent = self._round(base)
            best = self._choose(ranked, independent)
            self.rounds.append(
                Round(
                    ' + '.join(['nominal', *(o.label for o in accepted)]),
                    tuple(c for c, _ in ranked),
                    best[0].label if best else '',
                    independent,
                )
            )
            if best is None:
                break
            accepted.append(best[1])
            base = best[1]
        causes, final = self._review(nominal, base, accepted)
        return self._conclude(nominal, final, causes)

    def _fit(self, tasks: list[Task], what: str) -> list[Outcome | str]:
        return run_all(
            try_candidate,
            [(task, self.train, self.held) for task in tasks],
            workers=self.options.workers,
            executor=self.executor,
            progress=lambda done, total: self.progress(what, done, total),
        )

    def _round(
        self, base: Outcome, accepted: Outcome | None = None
    ) -> tuple[list[tuple[Candidate, Outcome]], float]:
        setups = [trial.setup for trial in (*self.train, *self.held)]
        recorded = {name for trial in self.train for name in trial.input_names}
        effects = candidates_for(base.model, setups, self.options.effects, recorded)
        tasks = [Task(base.model, effect) for effect in effects]
        outcomes = self._fit(tasks, f'effects on top of {base.label}')
        for task, outcome in zip(tasks, outcomes, strict=True):
            if isinstance(outcome, str):
                log.info('%s: %s', task.effect, outcome)
        good = [o for o in outcomes if isinstance(o, Outcome)]
        if accepted is not None and all(o.label != accepted.label for o in good):
            good.append(accepted)
        return self._rank(base, good)

    def _rank(
        self, base: Outcome, outcomes: list[Outcome]
    ) -> tuple[list[tuple[Candidate, Outcome]], float]:
        if not outcomes:
            return [], 2.0
        leader = min([base, *outcomes], key=chi2)
        independent = independent_samples(leader.residuals, self.steps)
        reference = self._evidence(base, independent)
        ranked = [
            (self._judge(base, o, reference - self._evidence(o, independent)), o)
            for o in outcomes
        ]
        ranked.sort(key=lambda pair: -pair[0].evidence)
        return ranked, independent

    def _choose(
        self, ranked: list[tuple[Candidate, Outcome]], independent: float
    ) -> tuple[Candidate, Outcome] | None:
        """The best candidate that may be accepted, or a simpler one that it contains."""
        able = [pair for pair in ranked if not pair[0].reason]
        if not able:
            return None
        leader = able[0][0]
        simpler = [
            pair
            for pair in able
            if effect_name(pair[0].label) in LIBRARY[effect_name(leader.label)].contains
            and pair[0].evidence > leader.evidence - _margin(independent)
        ]
        return simpler[0] if simpler else able[0]

    def _evidence(self, o: Outcome, independent: float) -> float:
        samples = o.train.count.sum() + o.held.count.sum()
        return evidence(chi2(o), samples, independent, o.unknowns, o.belief)

    def _judge(self, base: Outcome, o: Outcome, gained: float) -> Candidate:
        n = len(self.train)  # residuals: training trials first, then those held out
        significance = block_gain(base.residuals[n:], o.residuals[n:], self.rows_per_block)
        before = per_output(base.held)
        after = per_output(o.held)
        explained = float(np.sqrt(np.clip(before - after, 0, None)).max())
        held_gain = 1 - o.held.normalised_error / base.held.normalised_error
        reasons = []
        if gained < EARNED:
            reasons.append(f'evidence {gained:.1f} nats, {EARNED:g} needed')
        if significance < SIGNIFICANT or held_gain <= 0:
            reasons.append('no significant gain on held-out records')
        if explained < MATERIAL:
            reasons.append(f'explains {explained:.2f} noise standard deviations, '
                           f'{MATERIAL:g} needed')
        reasons += at_edge(o)
        return Candidate(
            label=o.label,
            model=o.train.model,
            train=o.train,
            held=o.held,
            evidence=float(gained),
            held_gain=float(held_gain),
            significance=significance,
            explained=explained,
            parameters=own_parameters(o),
            reason='; '.join(reasons),
        )

    def _at_noise(self, o: Outcome) -> bool:
        return bool(
            (per_output(o.train) < AT_NOISE).all() and (per_output(o.held) < AT_NOISE).all()
        )

    def _review(
        self, nominal: Outcome, final: Outcome, accepted: list[Outcome]
    ) -> tuple[list[Cause], Outcome]:
        """For each accepted effect: what if it were another one, beside the rest?"""
        labels = [o.label for o in accepted]
        if len(accepted) == 1:
            # The first round has already asked.
            first = self.rounds[0]
            return [self._cause(final, labels[0], first.candidates, first.independent)], final
        causes = []
        for label in labels:
            without = final.model.without_effect(label)
            (lean,) = self._fit([Task(without)], f'model without {label}')
            if isinstance(lean, str):
                causes.append(Cause(label, parameters_of(final, label), np.inf))
                continue
            # Its fit on top of the others alone may fail; what was accepted then stands.
            ranked, independent = self._round(lean, accepted=replace(final, label=label))
            candidates = tuple(c for c, _ in ranked)
            base = ' + '.join(['nominal', *(x for x in labels if x != label)])
            self.rounds.append(Round(base, candidates, label, independent))
            causes.append(self._cause(final, label, candidates, independent))
        causes.sort(key=lambda cause: -cause.evidence)
        return causes, final

    def _cause(
        self, final: Outcome, label: str, candidates: Sequence[Candidate], independent: float
    ) -> Cause:
        own = next(c for c in candidates if c.label == label)
        margin = _margin(independent)
        close = [
            c.label
            for c in candidates
            if c.label != label and not c.reason and c.evidence > own.evidence - margin
        ]
        name = effect_name(label)
        return Cause(
            label,
            parameters_of(final, label),
            own.evidence,
            rivals=tuple(
                c
                for c in close
                if effect_name(c) != name and name not in LIBRARY[effect_name(c)].contains
            ),
            places=tuple(c for c in close if effect_name(c) == name),
        )

    def _conclude(self, nominal: Outcome, final: Outcome, causes: list[Cause]) -> Diagnosis:
        remaining = dict(
            zip(self.nominal.mechanism.outputs, per_output(final.held), strict=True)
        )
        left = {c: v for c, v in remaining.items() if v > (1 + MATERIAL) ** 2}
        if not causes:
            verdict = 'unexplained' if left else 'consistent'
        elif any(cause.rivals for cause in causes):
            verdict = 'ambiguous'
        else:
            verdict = 'explained'
        gains = gains_of(self.nominal, self.held, nominal.held, final.held)
        reference = self._judge(nominal, nominal, 0.0)
        extended = self._judge(nominal, final, sum(c.evidence for c in causes))
        return Diagnosis(
            verdict=verdict,
            summary=summary_of(verdict, causes, gains, left),
            causes=tuple(causes),
            gains=gains,
            nominal=self.nominal,
            baseline=replace(reference, reason=''),
            extended=replace(extended, reason=''),
            rounds=tuple(self.rounds),
            train=tuple(self.train),
            held=tuple(self.held),
            remaining={c: float(v) for c, v in remaining.items()},
            findings=tuple(final.train.warnings),
        )


def _margin(independent: float) -> float:
    """Evidence in nats by which rivals are not told apart, for so many independent samples."""
    return max(MARGIN, FIDELITY * independent / 2)
