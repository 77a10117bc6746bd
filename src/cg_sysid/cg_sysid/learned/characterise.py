"""What no effect of the library explains, characterised: where it acts, what it follows, how.

    short pieces of the records, linearised (response.py)
      -> learned terms compared on them (terms.py)
      -> the best few fitted by simulation, on windows of a few pieces, and judged like any effect
      -> the winner fitted to whole records: a function with its band (shape.py), and words for it

diagnosis.md says why.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np

from cg_dynamics.effects.effect import TIME
from cg_dynamics.effects.unmodelled import COSINES, LearnedEffect
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_sysid.errors import Failure
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.identify import fit, in_data_set, score
from cg_sysid.identification.unknowns import IdentificationError, without_events
from cg_sysid.learned.linear_response import cut, pieces_of, simulated_signals
from cg_sysid.learned.residual_terms import BEYOND, Sketches, Term
from cg_sysid.learned.shape import GRID, function_of, shape_of
from cg_sysid.learned.unmodelled import Unmodelled
from cg_sysid.search import settings
from cg_sysid.search.model_selection import Comparison, ModelSelection, share_explained
from cg_sysid.search.outcome import Outcome, chi2
from cg_sysid.search.task import Task
from cg_sysid.search.whole_fit import try_candidate

SKETCHES = 'learned terms on pieces of the records'
FINALISTS = 4
WORTH_FITTING = 8.0  # times the best sketch's error above the noise
WORTH_SKETCHING = 0.97  # share of the error of other records that a sketch may leave
OWN_PHASES = 0.7  # share of the best other error to which phases of records' own must bring it
WINDOW = 2.5  # pieces
LEARNING_S = 40.0  # windows to learn from, all together; what is beyond adds little
LONGEST_WINDOW = 1.25  # s
STOOD_IN = 0.5  # share of the error that causes or a term must take from what is without them
OF_USE = 0.3  # share of the fall of the log error that causes must have beside a term
NEGLIGIBLE = 0.05  # chi2 per sample above the noise; less is not compared
WORSE = 3.0  # times the error on windows that a fit of whole records may leave
OUT_OF_RANGE = 0.15  # share of the range of its variable by which a function may miss it

Run = Callable[[Callable, list[tuple], str], list]
Sides = tuple[Sequence[DataSet], Sequence[DataSet]]


def characterise(
    base: Outcome, train: Sequence[DataSet], held: Sequence[DataSet], run: Run
) -> Unmodelled | None:
    """The learned term that explains best what a model leaves; None if none is significant.

    Args:
        base: The model as far as it is known, fitted.
        train: Data sets to learn from.
        held: Data sets that judge.
        run: Calls a function with each tuple of arguments, in parallel perhaps, and tells people
            what for.
    """
    (sketched,) = run(sketch, [(_lasting(base), train, held)], SKETCHES)
    return _from_sketch(base, sketched, (train, held), run)


def _from_sketch(
    base: Outcome, sketched: tuple[float, Sequence[Term]], sides: Sides, run: Run
) -> Unmodelled | None:
    """The best of the terms that are worth a fit; None if none is significant."""
    lasting = _lasting(base)
    length, terms = sketched
    if not terms:
        return None
    shared = [term for term in terms if term.effect.kind != 'vibrating'][:FINALISTS]
    found = None
    if not shared or terms[0].error < OWN_PHASES * shared[0].error:
        found = _vibrating(base, terms[0], sides, run)
    if found is None and shared:
        found = _smooth_or_periodic(base, lasting, shared, WINDOW * length, sides, run)
    return found


def what_remains(
    nominal: Outcome,
    final: Outcome,
    causes: Collection[str],
    train: Sequence[DataSet],
    held: Sequence[DataSet],
    run: Run,
) -> tuple[Unmodelled | None, bool]:
    """What a model with causes leaves, as a learned term, and whether the causes stand.

    An effect that the library lacks makes others look like it. If one learned term without the
    causes is far better than the causes, and they are of no use beside it, they stood in for it;
    unless the term is the law of a cause in another shape, and the cause takes nearly all of it.

    Args:
        nominal: The model without causes, fitted.
        final: The model with them.
        causes: Their labels.
        train: Data sets to learn from.
        held: Data sets that judge.
        run: As in `characterise`.
    """
    bases = [final, nominal] if causes else [final]
    sketches = run(sketch, [(_lasting(base), train, held) for base in bases], SKETCHES)
    beside = _from_sketch(final, sketches[0], (train, held), run)
    alone = _from_sketch(nominal, sketches[1], (train, held), run) if causes else None
    if (
        alone is None
        or _of_one_family(nominal, final, causes, alone)
        or _causes_stand(final, alone, beside or alone, (train, held))
    ):
        return beside, True
    return replace(alone, nearest=tuple(sorted(causes))), False


def _of_one_family(
    nominal: Outcome, final: Outcome, causes: Collection[str], term: Unmodelled
) -> bool:
    """Whether a cause is what the term is, drawn by another law."""
    effects = [final.model.effect(label) for label in causes]
    site = term.effect.site.partition(':')[0]
    kin = any(e.family == term.effect.family and e.site in (site, 'all') for e in effects)
    return kin and share_explained(nominal.held, final.held) > settings.DOUBT.nearly_all


def _causes_stand(final: Outcome, alone: Unmodelled, beside: Unmodelled, sides: Sides) -> bool:
    """True if causes are of use beside a term, or better than it."""
    errors = [_above_noise(final, alone, beside, held, side) for held, side in enumerate(sides)]
    causes, term, both = errors[1]
    if term > STOOD_IN * causes:
        return True
    # A little that a cause adds to a term is what the term is too smooth for; what it adds on
    # records held out alone is what the term could not learn.
    added = min(np.log(term / both) for _, term, both in errors)
    return bool(added > max(OF_USE * np.log(causes / both), np.log(1 / STOOD_IN)))


def _above_noise(
    final: Outcome, alone: Unmodelled, beside: Unmodelled, held: int, data_sets: Sequence[DataSet]
) -> tuple[float, float, float]:
    """What causes, a term alone and both leave of training (0) or held-out data sets (1)."""
    if alone.window is None:
        whole = (final.train, final.held), (alone.fit, alone.held), (beside.fit, beside.held)
        fits = [pair[held] or pair[0] for pair in whole]
    else:
        length = min(u.window or LONGEST_WINDOW for u in (alone, beside))
        windows = [window for t in data_sets for window in cut(beside.fit.model, t, length)]
        models = (final.train.model, alone.fit.model, beside.fit.model)
        fits = [score(without_events(model), windows) for model in models]
    causes, term, both = (max(fit.normalised_error - 1, NEGLIGIBLE) for fit in fits)
    return causes, term, both


def sketch(
    task: Task, train: Sequence[DataSet], held: Sequence[DataSet]
) -> tuple[float, list[Term]]:
    """Length of a piece in s, and the terms that are worth a fit, best first."""
    pieces = pieces_of(task.model, train, held, task.bounds)
    if len({piece.held for piece in pieces.all}) < 2:
        return pieces.length, []
    sketches = Sketches(pieces, (*train, *held))
    found = [t for t in sketches.all() if t.error < WORTH_SKETCHING * sketches.nothing]
    if not found:
        return pieces.length, []
    most = 1 + WORTH_FITTING * max(found[0].error - 1, 0.05)
    return pieces.length, [term for term in found if term.error < most]


def _lasting(base: Outcome) -> Task:
    """The base without what happened once in single records: that says nothing about a law."""
    return Task(without_events(base.model), bounds=base.task.bounds)


# --- a function that all records share --------------------------------------------------------


def _smooth_or_periodic(
    base: Outcome, lasting: Task, terms: Sequence[Term], window: float, sides: Sides, run: Run
) -> Unmodelled | None:
    windows = tuple(
        [w for data_set in side for w in cut(lasting.model, data_set, window)] for side in sides
    )
    most = max(2, int(LEARNING_S / window))
    windows = tuple([w for w in side][:: max(1, -(-len(side) // most))] for side in windows)
    tasks = [lasting, *(replace(lasting, model=t.added_to(lasting.model)) for t in terms)]
    comparison = _compare(tasks, [term.label for term in terms], windows, run)
    if comparison is None or comparison.ranked[0][0].reason:
        return None
    label = comparison.ranked[0][0].label
    found = comparison.ranked[0][1]
    effect = _learned(found, label)
    variable = _variable(effect, found, windows)
    other_range = _over(variable, effect, found)
    if other_range is not None:
        again = _compare([tasks[0], other_range], [label], windows, run)
        if again is not None and chi2(again.ranked[0][1]) < chi2(found):
            found = again.ranked[0][1]
            variable = _variable(effect, found, windows)
    at = found.train.numbers
    task = replace(base.task, model=_extended(base.model, label, found.task.model))
    arguments = (task, at, base.events, *sides)
    (whole,) = run(whole_fit, [arguments], f'{label} on whole records')
    good = isinstance(whole, tuple) and _follows_on(whole, found, base)
    fits = whole if good else (found.train, None)
    return _unmodelled(comparison, found, base.held, fits, variable, window)


def _compare(tasks: Sequence[Task], labels: Sequence[str], sides, run: Run) -> Comparison | None:
    """Learned terms against the model without them, the first task; None if a fit fails."""
    reference, *outcomes = run(try_candidate, [(task, *sides) for task in tasks], 'learned terms')
    good = [
        _weighed(o, label)
        for o, label in zip(outcomes, labels, strict=True)
        if isinstance(o, Outcome)
    ]
    if not isinstance(reference, Outcome) or not good:
        return None
    comparison = ModelSelection(*sides).compare(reference, good)
    # Those that may be accepted first.
    ranked = sorted(comparison.ranked, key=lambda pair: bool(pair[0].reason))
    return replace(comparison, ranked=tuple(ranked))


def _weighed(o: Outcome, label: str) -> Outcome:
    """The outcome under the term's name, its coefficients counted by what data say about them."""
    own = [u.name.startswith(f'{label}.') for u in o.train.unknowns]
    by_prior = sum(own) - float(o.train.information[own].sum())
    return replace(o, label=label, unknowns=o.unknowns - round(by_prior))


def _learned(o: Outcome, label: str) -> LearnedEffect:
    effect = o.train.model.effect(label)
    assert isinstance(effect, LearnedEffect)
    return effect


def _variable(effect: LearnedEffect, found: Outcome, sides) -> np.ndarray:
    """Values that the variable of a term takes along the records, shape (n,)."""
    data_sets = [data_set for side in sides for data_set in side]
    if effect.variable == 'time':
        return np.concatenate([data_set.inputs_for((TIME,))[:, 0] for data_set in data_sets])
    motions = (*found.train.motions, *found.held.motions)
    return np.concatenate(
        [
            simulated_signals(model, data_set, motion)[effect.follows]
            for data_set, (model, motion) in zip(
                data_sets, (in_data_set(found.train.model, own) for own in motions), strict=True
            )
        ]
    )


def _over(variable: np.ndarray, effect: LearnedEffect, found: Outcome) -> Task | None:
    """The same function over the range that its variable takes after all, where that differs."""
    if effect.kind != 'smooth':
        return None
    values = found.train.model.values
    span = float(np.ptp(variable))
    low, high = variable.min() - BEYOND * span, variable.max() + BEYOND * span
    missed = (abs(values[f'{effect.label}.low'] - low), abs(values[f'{effect.label}.high'] - high))
    if max(missed) < OUT_OF_RANGE * span:
        return None
    s = np.linspace(low, high, 4 * GRID)
    g, _ = function_of(effect, found.train, s)
    waves = np.cos(np.pi * np.outer((s - low) / (high - low), np.arange(COSINES)))
    coefficients = np.linalg.lstsq(waves, g, rcond=1e-6)[0]
    new = {'low': low, 'high': high, **dict(zip(effect.coefficients, coefficients, strict=True))}
    model = found.task.model.with_values(
        {f'{effect.label}.{name}': float(value) for name, value in new.items()}
    )
    return replace(found.task, model=model)


def _extended(model: Model, label: str, believed: Model) -> Model:
    """A model with a term as another model believes in it."""
    effect = believed.effect(label)
    extended = model.with_effect(effect.name, effect.at)
    own = {n: q for n, q in believed.quantities.items() if n.startswith(f'{label}.')}
    return replace(extended, quantities={**extended.quantities, **own})


def whole_fit(
    task: Task,
    at: Mapping[str, float],
    own: Mapping[str, Mapping[str, float]],
    train: Sequence[DataSet],
    held: Sequence[DataSet],
) -> tuple[Fit, Fit] | Failure:
    """Fit of whole records from given values on, and score of those held out; or why not."""
    try:
        found = fit(task.model, train, at=at, own=own, bounds=task.bounds)
        return found, score(found.model, held, own=own)
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError) as error:
        return Failure(str(error))


def _follows_on(whole: tuple[Fit, Fit], found: Outcome, base: Outcome) -> bool:
    """True if the fit of whole records is about as good as that of windows, and worth anything."""
    return (
        whole[0].normalised_error < WORSE * found.train.normalised_error
        and whole[1].normalised_error < base.held.normalised_error
    )


def _unmodelled(
    comparison: Comparison,
    found: Outcome,
    before: Fit,
    fits: tuple[Fit, Fit | None],
    variable: np.ndarray,
    window: float | None,
) -> Unmodelled:
    """The answer, where whole records were scored as `before` without the term."""
    best = comparison.ranked[0][0]
    effect = _learned(found, best.label)
    return Unmodelled(
        effect=effect,
        shape=shape_of(effect, fits[0], variable),
        period=_period(effect, fits[0]),
        amplitudes={},
        evidence=best.evidence,
        significance=best.significance,
        explained=(
            share_explained(before, fits[1])
            if fits[1] is not None
            else share_explained(comparison.base.held, found.held)
        ),
        window=window,
        rivals=tuple(
            _learned(o, c.label)
            for c, o in comparison.ranked[1:]
            if not c.reason and c.evidence > best.evidence - comparison.margin
        ),
        fit=fits[0],
        held=fits[1],
    )


def _period(effect: LearnedEffect, found: Fit) -> tuple[float, float] | None:
    if effect.kind == 'smooth':
        return None
    index = [u.name for u in found.unknowns].index(f'{effect.label}.period')
    return float(found.values[index]), float(found.sigmas[index])


# --- a vibration with a phase of each record's own ----------------------------------------------


def _vibrating(base: Outcome, term: Term, sides: Sides, run: Run) -> Unmodelled | None:
    """Judged on whole records: a phase of each window's own would explain anything."""
    model = term.added_to(base.model)
    tasks = [
        replace(base.task, model=base.model, effect=None, events=base.events, warm_starts=()),
        replace(base.task, model=model, effect=None, events=base.events, warm_starts=()),
    ]
    comparison = _compare(tasks, [term.label], sides, run)
    if comparison is None or comparison.ranked[0][0].reason:
        return None
    found = comparison.ranked[0][1]
    effect = _learned(found, term.label)
    names = [f'{term.label}.{name}' for name in effect.coefficients]
    waves = {
        data_set: np.array([own[name] for name in names]) for data_set, own in found.events.items()
    }
    strongest = max(waves.values(), key=lambda own: float(np.hypot(own[0], own[1])))
    values = {n: float(v) for n, v in zip(names, strongest, strict=True)}
    time = np.concatenate([data_set.time for side in sides for data_set in side])
    shown = replace(found.train, model=found.train.model.with_values(values))
    made = _unmodelled(comparison, found, base.held, (shown, found.held), time, None)
    rms = float(np.sqrt(np.mean([own @ own / 2 for own in waves.values()])))
    return replace(
        made,
        shape=replace(made.shape, rms=rms),
        amplitudes={name: float(np.hypot(own[0], own[1])) for name, own in waves.items()},
        fit=found.train,
    )
