"""Diagnosis: what a simulation gets wrong, the cause, and the gain of a model that has it.

    fit the nominal model -> is the residual more than noise?
      -> fit every effect of the library on top -> rank by evidence -> accept the best if it is
         earned on records held out -> again on top of that, until nothing more is earned
      -> look again at each accepted effect: could another take its place?

docs/diagnosis.md says how the decisions are taken and why.
"""

import itertools
import logging
from collections.abc import Callable, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import TIME
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.evidence import block_gain, evidence, independent_samples
from cg_sysid.identify import Fit, IdentificationError, fit, predict, score, unknowns_of
from cg_sysid.parallel import run_all
from cg_sysid.record import Record
from cg_sysid.trial import Trial, prepare

log = logging.getLogger(__name__)

MARGIN = 6.0  # nats: rivals closer than this are not told apart (odds of 400 to 1)
# No model is trusted to describe a machine better than this share of the noise power: rivals whose
# chi2/N differ by less are not told apart, however many samples say so.
FIDELITY = 2e-3
EARNED = 10.0  # nats an effect must gain over the model without it
MATERIAL = 1.0  # an effect must explain this much error, in standard deviations of the noise
AT_NOISE = 1.3  # chi2/N up to which a channel counts as explained down to noise
SIGNIFICANT = 2.5  # standard errors by which the held-out error must fall, block by block
MOST_ROUNDS = 4
SCREEN_ITERATIONS = 16
SCREEN_S = 2.0  # length of the first look at each start of a candidate
FEWEST_BLOCKS = 20  # short records are cut into shorter blocks, but not below
SHORTEST_BLOCK_S = 0.1
BLOCK_S = 0.5  # length of the blocks on which a held-out gain is tested
MOST_STARTS = 24
FOLLOWED = 3  # starts of a swept parameter that are worth a second look

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Gain:
    """Simulation error of one output before and after, on records held out.

    Attributes:
        channel: Output channel.
        unit: Its unit.
        before: RMS error of the nominal model, identified anew, in `unit`.
        after: RMS error of the extended model.
        noise: Noise floor of the sensor.
    """

    channel: str
    unit: str
    before: float
    after: float
    noise: float


@dataclass(frozen=True)
class Candidate:
    """One effect tried on top of a base model.

    Attributes:
        label: Effect label.
        model: Base model plus the effect, identified on the training records.
        train: Fit on the training records.
        held: Score on the held-out records.
        evidence: In nats against the base model: positive speaks for the effect.
        held_gain: Fall of the held-out squared error, relative.
        significance: The same in standard errors, by the ranks of blocks of time.
        explained: RMS error explained on held-out records, in noise standard deviations, of the
            output where it is largest.
        parameters: Own parameters: name -> (value, standard deviation, unit).
        reason: Why it was not accepted; empty if it could be.
    """

    label: str
    model: Model
    train: Fit
    held: Fit
    evidence: float
    held_gain: float
    significance: float
    explained: float
    parameters: dict[str, tuple[float, float, str]]
    reason: str = ''


@dataclass(frozen=True)
class Round:
    """All candidates tried on top of one base model, best first, and what was made of them."""

    base: str
    candidates: tuple[Candidate, ...]
    accepted: str
    independent: float


@dataclass(frozen=True)
class Cause:
    """A named cause: an accepted effect and what these data cannot rule out beside it.

    Attributes:
        label: Label of the effect.
        parameters: Own parameters: name -> (value, standard deviation, unit).
        evidence: In nats against the model without it.
        rivals: Other effects that explain the records as well.
        places: Labels of the same effect at other places that explain the records as well.
    """

    label: str
    parameters: dict[str, tuple[float, float, str]]
    evidence: float
    rivals: tuple[str, ...] = ()
    places: tuple[str, ...] = ()


@dataclass(frozen=True)
class Diagnosis:
    """The answer.

    Attributes:
        verdict: consistent, explained, ambiguous, unexplained or unusable.
        summary: One sentence for people.
        causes: Named causes, strongest first.
        gains: Simulation error before and after on held-out records.
        nominal: The model as it was given.
        baseline: The same, its parameters identified on the training records.
        extended: The model with the causes in it, identified on the training records.
        rounds: What was tried, in order.
        train: Trials used for fitting.
        held: Trials held out.
        remaining: chi2/N of each output that the extended model leaves on held-out records.
        findings: What a person should know: warnings of the fits, lumps out of tolerance.
    """

    verdict: str
    summary: str
    causes: tuple[Cause, ...]
    gains: tuple[Gain, ...]
    nominal: Model
    baseline: Candidate
    extended: Candidate
    rounds: tuple[Round, ...]
    train: tuple[Trial, ...]
    held: tuple[Trial, ...]
    remaining: dict[str, float]
    findings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Options:
    """How a diagnosis is done.

    Attributes:
        effects: Labels or names to try; by default the whole library.
        rounds: Most effects to add.
        workers: Local processes.
        held: Names of the records to hold out; by default every second one of each set-up.
    """

    effects: tuple[str, ...] | None = None
    rounds: int = MOST_ROUNDS
    workers: int | None = None
    held: tuple[str, ...] | None = None


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


def candidates_for(
    model: Model, setups: Sequence[Setup], names: Sequence[str] | None = None
) -> list[tuple[str, str | None]]:
    """(effect, at) of all that could show in these set-ups and that the model does not have."""
    present = {effect.label for effect in model.effects}
    found = []
    for name, effect in LIBRARY.items():
        if not effect.applies(setups):
            continue
        for at in effect.sites(model.mechanism):
            made = effect(model.mechanism, at)
            wanted = names is None or name in names or made.label in names
            if wanted and made.label not in present:
                found.append((name, made.at))
    if names is not None and not found:
        raise IdentificationError(
            f'none of the effects {", ".join(names)} can be tried; the library has: '
            f'{", ".join(LIBRARY)}'
        )
    return found


def starts_of(name: str) -> list[dict[str, float]]:
    """Values of an effect's parameters from which its identification sets out."""
    grids = [
        [(p.name, start) for start in p.starts] if p.free else [(p.name, p.default)]
        for p in LIBRARY[name].parameters
    ]
    return [dict(point) for point in itertools.islice(itertools.product(*grids), MOST_STARTS)]


@dataclass(frozen=True)
class Task:
    """One candidate to fit: an effect (or None for the base alone) on top of a model."""

    model: Model
    effect: tuple[str, str | None] | None = None


@dataclass(frozen=True)
class Outcome:
    """What fitting a task gave: fits on both sets and the residuals over noise."""

    task: Task
    label: str
    model: Model
    train: Fit
    held: Fit
    residuals: tuple[np.ndarray, ...] = field(repr=False)
    belief: float
    unknowns: int


def try_candidate(task: Task, train: Sequence[Trial], held: Sequence[Trial]) -> Outcome | str:
    """Fit one candidate on the training trials and score it on the held-out ones.

    Returns:
        The outcome, or a sentence saying why there is none.
    """
    try:
        best = _best_fit(task, train)
        held_score = score(best.model, held)
        model = believing(best.model, task.model)
        residuals = tuple(
            (predict(best.model, trial, motion) - trial.outputs) / trial.sigma
            for trial, motion in zip(
                (*train, *held), (*best.motions, *held_score.motions), strict=True
            )
        )
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError) as error:
        return str(error)
    belief = sum(
        ((u.to_coordinate(v) - u.to_coordinate(u.prior)) / u.tolerance) ** 2
        for u, v in zip(best.unknowns, best.values, strict=True)
        if np.isfinite(u.tolerance)
    )
    label = best.model.effects[-1].label if task.effect else task.model.name
    return Outcome(
        task, label, model, best, held_score, residuals, belief, len(best.unknowns)
    )


def _best_fit(task: Task, train: Sequence[Trial]) -> Fit:
    # A short horizon tells which start is worth going on from, on the way to the full one.
    models = list(_starting_models(task))
    if len(models) == 1:
        return fit(models[0], train)
    kept = _swept(models[0])
    # A few seconds do not show an instant that is still to come.
    horizon = np.inf if kept and TIME in models[0].effects[-1].extra_inputs else SCREEN_S
    looks = _looks(models, train, kept, horizon)
    if kept:
        # Let go of the frequency only where a fit at its start is promising.
        looks = _looks([model for _, model in looks[:FOLLOWED]], train, [], horizon)
    look, _ = looks[0]
    return fit(models[0], train, start=look)


def _swept(model: Model) -> list[str]:
    # Of the effect that is being tried: those before it stay about where they were found.
    own = model.effects[-1]
    return [f'{own.label}.{p.name}' for p in own.parameters if p.swept]


def _looks(
    models: Sequence[Model], train: Sequence[Trial], kept: Sequence[str], horizon: float
) -> list[tuple[Fit, Model]]:
    """Short fits from each model and where they lead, best first; `kept` stay as they are."""
    looks = []
    for model in models:
        only = [u.name for u in unknowns_of(model) if u.name not in kept] if kept else None
        try:
            look = fit(model, train, only, horizon=horizon, iterations=SCREEN_ITERATIONS)
            found = {u.name: v for u, v in zip(look.unknowns, look.values, strict=True)}
            looks.append((look, model.with_values(found)))
        except IdentificationError as error:
            failure = error
    if not looks:
        raise failure
    return sorted(looks, key=lambda pair: pair[0].normalised_error)


def _starting_models(task: Task):
    if task.effect is None:
        yield task.model
        return
    name, at = task.effect
    for start in starts_of(name):
        yield task.model.with_effect(name, at, **start)


def believing(fitted: Model, base: Model) -> Model:
    """The fitted structure with the base's numbers and beliefs; added effects keep their values.

    What a fit found is a start for the next one, not a belief.
    """
    added = {n: replace(q, tolerance=None) for n, q in fitted.quantities.items()
             if n not in base.quantities}
    return replace(base, effects=fitted.effects, quantities={**base.quantities, **added})


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

    def _round(self, base: Outcome) -> tuple[list[tuple[Candidate, Outcome]], float]:
        setups = [trial.setup for trial in (*self.train, *self.held)]
        effects = candidates_for(base.model, setups, self.options.effects)
        tasks = [Task(base.model, effect) for effect in effects]
        outcomes = self._fit(tasks, f'effects on top of {base.label}')
        for task, outcome in zip(tasks, outcomes, strict=True):
            if isinstance(outcome, str):
                log.info('%s: %s', task.effect, outcome)
        good = [o for o in outcomes if isinstance(o, Outcome)]
        return self._rank(base, good)

    def _rank(
        self, base: Outcome, outcomes: list[Outcome]
    ) -> tuple[list[tuple[Candidate, Outcome]], float]:
        if not outcomes:
            return [], 2.0
        leader = min([base, *outcomes], key=_chi2)
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
            if _name(pair[0].label) in LIBRARY[_name(leader.label)].contains
            and pair[0].evidence > leader.evidence - _margin(independent)
        ]
        return simpler[0] if simpler else able[0]

    def _evidence(self, o: Outcome, independent: float) -> float:
        samples = o.train.count.sum() + o.held.count.sum()
        return evidence(_chi2(o), samples, independent, o.unknowns, o.belief)

    def _judge(self, base: Outcome, o: Outcome, gained: float) -> Candidate:
        n = len(self.train)  # residuals: training trials first, then those held out
        significance = block_gain(base.residuals[n:], o.residuals[n:], self.rows_per_block)
        before = _per_output(base.held)
        after = _per_output(o.held)
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
        reasons += _at_edge(o)
        return Candidate(
            label=o.label,
            model=o.train.model,
            train=o.train,
            held=o.held,
            evidence=float(gained),
            held_gain=float(held_gain),
            significance=significance,
            explained=explained,
            parameters=_own_parameters(o),
            reason='; '.join(reasons),
        )

    def _at_noise(self, o: Outcome) -> bool:
        return bool(
            (_per_output(o.train) < AT_NOISE).all() and (_per_output(o.held) < AT_NOISE).all()
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
                causes.append(Cause(label, _parameters_of(final, label), np.inf))
                continue
            ranked, independent = self._round(lean)
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
        name = _name(label)
        return Cause(
            label,
            _parameters_of(final, label),
            own.evidence,
            rivals=tuple(
                c
                for c in close
                if _name(c) != name and name not in LIBRARY[_name(c)].contains
            ),
            places=tuple(c for c in close if _name(c) == name),
        )

    def _conclude(self, nominal: Outcome, final: Outcome, causes: list[Cause]) -> Diagnosis:
        remaining = dict(
            zip(self.nominal.mechanism.outputs, _per_output(final.held), strict=True)
        )
        left = {c: v for c, v in remaining.items() if v > (1 + MATERIAL) ** 2}
        if not causes:
            verdict = 'unexplained' if left else 'consistent'
        elif any(cause.rivals for cause in causes):
            verdict = 'ambiguous'
        else:
            verdict = 'explained'
        gains = _gains(self.nominal, self.held, nominal.held, final.held)
        reference = self._judge(nominal, nominal, 0.0)
        extended = self._judge(nominal, final, sum(c.evidence for c in causes))
        return Diagnosis(
            verdict=verdict,
            summary=_summary(verdict, causes, gains, left),
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


def _name(label: str) -> str:
    """Standard name of an effect, its place left out."""
    return label.partition('@')[0]


def _margin(independent: float) -> float:
    """Evidence in nats by which rivals are not told apart, for so many independent samples."""
    return max(MARGIN, FIDELITY * independent / 2)


def _chi2(o: Outcome) -> float:
    return float((o.train.mse * o.train.count).sum() + (o.held.mse * o.held.count).sum())


def _per_output(fit: Fit) -> np.ndarray:
    """chi2/N of each output over all trials; 0 for an output without samples."""
    return (fit.mse * fit.count).sum(axis=0) / np.maximum(fit.count.sum(axis=0), 1)


def _own_parameters(o: Outcome) -> dict[str, tuple[float, float, str]]:
    return _parameters_of(o, o.label)


def _parameters_of(o: Outcome, label: str) -> dict[str, tuple[float, float, str]]:
    prefix = f'{label}.'
    return {
        u.name.removeprefix(prefix): (float(v), float(s), u.unit)
        for u, v, s in zip(o.train.unknowns, o.train.values, o.train.sigmas, strict=True)
        if u.name.startswith(prefix)
    }


def _at_edge(o: Outcome) -> list[str]:
    """A parameter at the edge of its range says that the effect is not what is meant."""
    found = []
    for u, v in zip(o.train.unknowns, o.train.values, strict=True):
        if not u.name.startswith(f'{o.label}.'):
            continue
        low, high, at = (u.to_coordinate(x) if not u.logarithmic or x > 0 else -np.inf
                         for x in (u.lower, u.upper, v))
        # Ranges suit machines of all sizes: a small value is not yet an edge.
        margin = 1e-3 * (high - low)
        if not u.logarithmic:
            margin = min(margin, 0.1 * u.scale)
        if min(at - low, high - at) < margin:
            found.append(f'{u.name} = {v:.3g} {u.unit} lies at the edge of its range')
    return found


def _gains(
    model: Model, held: Sequence[Trial], before: Fit, after: Fit
) -> tuple[Gain, ...]:
    sigma = held[0].sigma
    return tuple(
        Gain(channel, unit, float(s * np.sqrt(b)), float(s * np.sqrt(a)), float(s))
        for channel, unit, s, b, a, n in zip(
            model.mechanism.outputs,
            model.mechanism.output_units,
            sigma,
            _per_output(before),
            _per_output(after),
            before.count.sum(axis=0),
            strict=True,
        )
        if n
    )


def _summary(
    verdict: str, causes: Sequence[Cause], gains: Sequence[Gain], left: dict[str, float]
) -> str:
    if verdict == 'consistent':
        return 'The model explains the records down to the noise of the sensors.'
    biggest = max(gains, key=lambda g: g.before / g.noise)
    if verdict == 'unexplained':
        return (
            f'Something is missing that no effect of the library explains: {biggest.channel} is '
            f'simulated with an error of {biggest.after:.3g} {biggest.unit}, its noise is '
            f'{biggest.noise:.2g}.'
        )
    named = ', '.join(
        f'{c.label} ({_described(c)})' + (f' or {" or ".join(c.rivals)}' if c.rivals else '')
        for c in causes
    )
    text = (
        f'The simulation lacks {named}; with it the held-out error of {biggest.channel} falls '
        f'from {biggest.before:.3g} to {biggest.after:.3g} {biggest.unit} '
        f'(noise {biggest.noise:.2g}).'
    )
    if left:
        text += f' An error above the noise remains in {", ".join(left)}.'
    return text


def _described(cause: Cause) -> str:
    return ', '.join(
        f'{name} = {value:.3g} +- {sigma:.1g} {unit}'
        for name, (value, sigma, unit) in cause.parameters.items()
    )
