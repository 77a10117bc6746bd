"""A candidate fitted to whole records, and judged on those held out."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_sysid.errors import Failure
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.identify import fit, predict, score
from cg_sysid.identification.unknowns import IdentificationError
from cg_sysid.search import excerpt, settings
from cg_sysid.search.events import event_names, seek_events, undisturbed
from cg_sysid.search.look import looks_from_starts
from cg_sysid.search.outcome import Outcome, far, shared_unknowns
from cg_sysid.search.starts import chosen, started_from, starting_models, starts_of
from cg_sysid.search.task import Task, as_cause, effect_of, eventful, label_of


def try_candidate(
    task: Task, train: Sequence[DataSet], held: Sequence[DataSet]
) -> Outcome | Failure:
    """Fit one candidate on the training data sets and score it on the held-out ones.

    Returns:
        The outcome, or a sentence saying why there is none.
    """
    label, task = label_of(task), as_cause(task)
    try:
        best = _best_fit(task, train)
        known: Mapping[str, Mapping[str, float]] = {
            t.name: task.events[t.name] for t in held if t.name in task.events
        }
        unseen = _unseen_shapes(best)
        judged = best.model
        if eventful(task):
            judged = _with_shapes_of(judged, next(starting_models(task)), unseen)
            known = seek_events(judged, held, label, known, _surest(best, label))
        held_score = score(
            judged, held, unseen, known, {n: b for n, b in task.bounds.items() if n in unseen},
            task.thorough, task.reach,
        )  # fmt: skip
        events = best.own_by_name(train) | held_score.own_by_name(held)
        model = with_priors_of(best.model, task.model, label)
        residuals = tuple(
            (predict(found.model, data_set, motion, best.refinement) - data_set.outputs)
            / data_set.sigma
            for found, data_sets in ((best, train), (held_score, held))
            for data_set, motion in zip(data_sets, found.motions, strict=True)
        )
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError) as error:
        return Failure(str(error))
    return Outcome(
        task, label, model, best, held_score, residuals,
        best.belief + best.starts + held_score.starts,
        # Small faults cost nothing: every robot has them.
        shared_unknowns(best, task.bounds) + _own_count(best, (*train, *held)), events,
        (tuple(t.name for t in train), tuple(t.name for t in held)),
    )  # fmt: skip


def fit_to_all(
    o: Outcome,
    data_sets: Sequence[DataSet],
    iterations: int = settings.FITTING.thorough_iterations,
) -> Fit | Failure:
    """A thorough fit of an outcome's structure to all records, those held out among them.

    Rivals that have earned their place on held-out records are told apart by this: values that
    were fitted to one half miss the other by chance, and by more than rivals may differ.

    Args:
        o: The outcome to go on from.
        data_sets: Those of its training, then those held out.
        iterations: At most.
    """
    both = replace(o.train, motions=(*o.train.motions, *o.held.motions))
    start = started_from(both, o.model, o.task.bounds)
    try:
        return fit(
            o.model,
            data_sets,
            start=start,
            own=o.events,
            bounds=o.task.bounds,
            thorough=True,
            iterations=iterations,
        )
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError) as error:
        return Failure(str(error))


def _surest(found: Fit, label: str) -> list[np.ndarray]:
    """An effect's own values in the data sets in which something surely happened."""
    names = [u.name for u in found.own]
    sizes, instant = event_names(found.model, label)
    place = [names.index(name) for name in (*sizes, instant)]
    own = [motion[len(motion) - len(names) :][place] for motion in found.motions]
    sure = [
        float(np.max((np.abs(values) / np.maximum(sigmas[place], 1e-300))[: len(sizes)]))
        for values, sigmas in zip(own, found.own_sigmas, strict=True)
    ]
    order = sorted(range(len(own)), key=lambda i: -sure[i])
    return [own[i] for i in order[: settings.SCREENING.followed] if sure[i] > settings.EVENTS.sure]


def _unseen_shapes(found: Fit) -> tuple[str, ...]:
    """Shapes of events of which no record of a fit had one: only other records can tell."""
    return tuple(
        u.name for effect in found.model.effects for u in found.unknowns
        if effect.name in LIBRARY and any(p.each == 'record' for p in effect.parameters)
        and u.name.startswith(f'{effect.label}.') and not _surest(found, effect.label)
    )  # fmt: skip


def _with_shapes_of(model: Model, other: Model, names: Sequence[str]) -> Model:
    """The model with shapes of another: of these the records fitted to tell nothing but noise."""
    return model.with_values({name: other.values[name] for name in names if name in other.values})


def _own_count(found: Fit, data_sets: Sequence[DataSet]) -> int:
    """Values that these data sets have of their own beyond their initial motions."""
    several = {
        'record': len(data_sets),
        'recording': len({data_set.recording for data_set in data_sets}),
    }
    return sum(several[u.each] for u in found.own)


def _best_fit(task: Task, train: Sequence[DataSet]) -> Fit:
    best = _event_fit(task, train) if eventful(task) else _own_fit(task, train)
    if task.base is None or best.misfit <= task.base.misfit:
        return best
    model = next(starting_models(task))
    start = started_from(task.base, model, task.bounds)
    again = _whole(task, model, train, start, task.iterations)
    return min(best, again, key=lambda found: found.misfit)


def _own_fit(task: Task, train: Sequence[DataSet]) -> Fit:
    model, warm_starts = next(starting_models(task)), task.warm_starts
    effect = effect_of(task)
    if not warm_starts and effect and len(starts_of(effect)) > 1:
        warm_starts = looks_from_starts(task, train)
    if not warm_starts:
        return _whole(task, model, train, None, task.iterations)
    # The first seconds may mislead where the error has many minima: a resonance that is not
    # excited yet, a gap that is passed once.
    best = _whole(
        task, chosen(model, warm_starts[0]), train, warm_starts[0], settings.SCREENING.following
    )
    for warm_start in warm_starts[1:]:
        # What comes to the noise with numbers that nobody believes has a rival in beliefs.
        done = best.normalised_error < settings.NOISE.settled and not far(best, task.bounds)
        # A look is a quick fit: near the noise it may still come there, whatever the reach.
        if done or warm_start.normalised_error > max(task.reach, settings.NOISE.quick):
            break
        other = _whole(
            task, chosen(model, warm_start), train, warm_start, settings.SCREENING.following
        )
        best = min(best, other, key=lambda found: found.misfit)
    left = task.iterations - settings.SCREENING.following
    if best.converged or left < 1:
        return best
    return _whole(task, chosen(model, best), train, best, left)


def _whole(
    task: Task, model: Model, train: Sequence[DataSet], start: Fit | None, iterations: int
) -> Fit:
    """Fit whole records, all of them."""
    start = excerpt.to_all(start, train) if start else None
    return fit(
        model, train, start=start, own=task.events, bounds=task.bounds, iterations=iterations,
        thorough=task.thorough, reach=task.reach,
    )  # fmt: skip


def _event_fit(task: Task, train: Sequence[DataSet]) -> Fit:
    """An effect of which every record has its own size and instant."""
    best = task.warm_starts[0] if task.warm_starts else None
    settled = best or fit(task.model, train, own=task.events, bounds=task.bounds)
    nothing = settled.normalised_error
    settled = best or undisturbed(task.model, train, task.bounds) or settled
    for _ in range(settings.EVENTS.seekings if best else 1):
        # What was a push is at first taken for other parameters: seek again when it is not.
        at = settled.numbers
        model = next(starting_models(task))
        events = seek_events(model.with_values(at), train, label_of(task), task.events)
        settled = fit(
            model, train, at=at, own=events, bounds=task.bounds, iterations=task.iterations
        )
        if best is None or settled.normalised_error < best.normalised_error:
            best = settled
        if best.normalised_error < settings.NOISE.settled:
            return fit(model, train, start=best, bounds=task.bounds)
    assert best is not None
    found = (
        bool(task.warm_starts) or best.normalised_error > settings.EVENTS.worth_seeking * nothing
    )
    return replace(best, converged=found)


def with_priors_of(fitted: Model, base: Model, label: str) -> Model:
    """The fitted structure with the base's numbers and beliefs; added effects keep their values.

    What a fit found is a start for the next one, not a belief.
    """
    added = {
        n: replace(q, tolerance=None)
        for n, q in fitted.quantities.items()
        if n not in base.quantities or n.startswith(f'{label}.')
    }
    return replace(base, effects=fitted.effects, quantities={**base.quantities, **added})
