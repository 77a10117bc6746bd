"""One effect on top of a model: where it can act, where its fit sets out, and how well it does."""

import itertools
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import CLOCKS, TIME, Effect
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.parameter import Parameter
from cg_dynamics.rig import Setup
from cg_sysid.errors import Failure
from cg_sysid.identification import along_motion, torque_error
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.identify import Fit, fit, predict, score, unknowns_of
from cg_sysid.identification.torque_error import TorqueFit
from cg_sysid.identification.unknowns import IdentificationError, own_unknowns, unsettled_states
from cg_sysid.search import excerpt as excerpt
from cg_sysid.search import settings
from cg_sysid.search.events import event_names, seek_events, undisturbed
from cg_sysid.search.nuisance import Bounds, turning
from cg_sysid.text import measured

Start = tuple[Model, Fit | None]
Led = tuple[Start, Mapping[str, float] | None]  # a start, and what torques say of it


@dataclass(frozen=True, eq=False)
class Rival:
    """What left little: what explains the torques far worse than this is not simulated.

    Attributes:
        model: With what the file believes.
        at: Full name -> value, as fitted.
        bounds: Of its small faults.
    """

    model: Model
    at: Mapping[str, float]
    bounds: Bounds


@dataclass(frozen=True, eq=False)
class Task:
    """One candidate to fit: an effect (or None for the base alone) on top of a model.

    Attributes:
        model: The base.
        effect: Effect and place.
        events: What each data set has of its own, as far as the base knows it: its name ->
            full name -> value (unknowns.own_unknowns).
        bounds: Small faults that the base may have (imperfections.py).
        warm_starts: Go on from the best of these fits, the most promising first; without any from
            the effect's own starts.
        iterations: Limit for whole records.
        thorough: Fit whole records down to the very bottom (identify.fit).
        base: Fit of the base. With an effect more it can only be better; where a fit from the
            file's numbers is not, it goes on from there.
        first: Fit of the base to an excerpt of the records, for looks in the same way.
        reach: chi2/N that matters: fits that lie beyond and gain little are broken off.
        rival: What has states and has to come up to this.
        torques: What the torques say of the effect from each of its starts (`torque_fits`).
    """

    model: Model
    effect: tuple[str, str | None] | None = None
    events: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    bounds: Bounds = field(default_factory=dict)
    warm_starts: tuple[Fit, ...] = ()
    iterations: int = settings.FITTING.iterations
    thorough: bool = False
    base: Fit | None = None
    first: Fit | None = None
    reach: float = np.inf
    rival: Rival | None = None
    torques: tuple[TorqueFit, ...] = ()


@dataclass(frozen=True)
class Screening:
    """A fit to an excerpt of the records: is a candidate worth a whole one?

    Attributes:
        label: Label of the effect.
        task: What to go on with.
        error: chi2/N of these seconds; NaN where they cannot tell, infinite where torques do.
    """

    label: str
    task: Task
    error: float


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
    unknowns: float
    events: Mapping[str, Mapping[str, float]]
    data_sets: tuple[tuple[str, ...], tuple[str, ...]]  # names of those trained on and held out


def candidates_for(
    model: Model,
    setups: Sequence[Setup],
    names: Sequence[str] | None = None,
    recorded: Collection[str] = (),
    small: Collection[str] = (),
) -> list[tuple[str, str | None]]:
    """(effect, at) of all that could show in these set-ups and that the model does not have.

    What the model has as a small fault (labels in `small`) can still be a cause, as a large one.
    An effect that needs a switch (`drive_enabled`) is tried only where that was recorded: with
    the switch always on it would be another name for a simpler effect.
    """
    known = {*model.mechanism.inputs, *CLOCKS, *recorded}
    present = {effect.label for effect in model.effects}.difference(small)
    found, asked = [], False
    for name, effect in LIBRARY.items():
        if not effect.applies(setups) or not known.issuperset(effect.extra_inputs):
            continue
        for at in effect.sites(model.mechanism):
            made = effect(model.mechanism, at)
            wanted = names is None or name in names or made.label in names
            asked |= wanted
            # Landings are judged by themselves, when all else is settled (landings.py).
            if wanted and made.label not in present and effect.place != 'impact':
                found.append((name, made.at))
    if names is not None and not asked:
        raise IdentificationError(
            f'none of the effects {", ".join(names)} can be tried; the library has: '
            f'{", ".join(LIBRARY)}'
        )
    return found


def starts_of(effect: Effect) -> list[dict[str, float]]:
    """Values of an effect's parameters from which its identification sets out."""
    grids = [
        [(p.name, start) for start in p.starts] if p.choice or (p.free and not p.each)
        else [(p.name, p.default if p.neutral is None else p.neutral)]
        for p in effect.parameters
    ]  # fmt: skip
    return [
        dict(point)
        for point in itertools.islice(itertools.product(*grids), settings.SCREENING.most_starts)
    ]


def screen(task: Task, train: Sequence[DataSet]) -> Screening | Failure:
    """Fit one candidate to an excerpt of the training data sets, from each of its starts.

    Returns:
        The look, or a sentence saying why there is none.
    """
    label, task = _label(task), _as_cause(task)
    late = TIME in LIBRARY[label.partition('@')[0]].extra_inputs
    if eventful(task) or late or not excerpt.lengths(train):
        return Screening(label, task, np.nan)
    try:
        warm_starts = _first_seconds(task, train)
        if (
            task.first is not None
            and warm_starts[0].normalised_error > task.first.normalised_error
        ):
            model = next(_starting_models(task))
            beyond = _screened(
                task, model, train, start=started_from(task.first, model, task.bounds)
            )
            warm_starts = tuple(sorted([beyond, *warm_starts], key=cost))
            warm_starts = warm_starts[: settings.SCREENING.followed]
    except RuledOut:
        return Screening(label, task, np.inf)
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError) as error:
        return Failure(str(error))
    return Screening(
        label, replace(task, warm_starts=warm_starts), warm_starts[0].normalised_error
    )


class RuledOut(Exception):
    """The torques speak clearly for a rival."""


def rival_of(found: Screening | Outcome) -> Rival:
    """What others have to come up to."""
    if isinstance(found, Outcome):
        return Rival(found.model, _numbers(found.train), found.task.bounds)
    model = next(_starting_models(found.task))
    return Rival(model, _numbers(found.task.warm_starts[0]), found.task.bounds)


def led_on(screening: Screening, task: Task) -> Screening:
    """The look for a task that has other small faults beside the same effect."""
    task = _as_cause(task)
    model = next(_starting_models(task))
    warm_starts = tuple(
        started_from(warm_start, model, task.bounds) for warm_start in screening.task.warm_starts
    )
    return replace(screening, task=replace(task, warm_starts=warm_starts))


def _as_cause(task: Task) -> Task:
    """What is tried as a cause is not bound to be small, as the same small fault would be.

    Only the shape of its law is bound, where small faults are allowed for.
    """
    if task.effect is None or not task.bounds:
        return task
    own = f'{_label(task)}.'
    shapes = {f'{own}{p.name}': p.leeway for p in _declared(task) if p.leeway}
    others = {n: b for n, b in task.bounds.items() if not n.startswith(own)}
    return replace(task, bounds=others | shapes)


def try_candidate(
    task: Task, train: Sequence[DataSet], held: Sequence[DataSet]
) -> Outcome | Failure:
    """Fit one candidate on the training data sets and score it on the held-out ones.

    Returns:
        The outcome, or a sentence saying why there is none.
    """
    label, task = _label(task), _as_cause(task)
    try:
        best = _best_fit(task, train)
        known: Mapping[str, Mapping[str, float]] = {
            t.name: task.events[t.name] for t in held if t.name in task.events
        }
        if eventful(task):
            known = seek_events(best.model, held, label, known, _surest(best, label))
        unseen = _unseen_shapes(best)
        held_score = score(
            best.model, held, unseen, known, {n: b for n, b in task.bounds.items() if n in unseen},
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


def fit_to_all(o: Outcome, data_sets: Sequence[DataSet]) -> Fit | Failure:
    """A thorough fit of an outcome's structure to all records, those held out among them.

    Rivals that have earned their place on held-out records are told apart by this: values that
    were fitted to one half miss the other by chance, and by more than rivals may differ.

    Args:
        o: The outcome to go on from.
        data_sets: Those of its training, then those held out.
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
            iterations=settings.FITTING.thorough_iterations,
        )
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError) as error:
        return Failure(str(error))


def shared_unknowns(found: Fit, bounds: Bounds) -> float:
    """How many of the values that all data sets share the records determine, less small faults.

    Not those of which they say nothing, as where across its plane an arm carries a load: they
    explain nothing. What numbers without a belief, as those of causes, make the others unsure of,
    these no longer tell: by so much they count less. A load and the link that carries it are known
    together only, and count together.
    """
    counted = np.array([u.name not in bounds for u in found.unknowns], bool)
    counted &= ~np.isinf(found.sigmas)
    believed = np.isfinite([u.tolerance for u in found.unknowns])
    free, told = counted & ~believed, counted & believed
    if not free.any() or not told.any() or not np.isfinite(found.covariance[counted]).all():
        return float(counted.sum())
    among, across = found.covariance[np.ix_(free, free)], found.covariance[np.ix_(told, free)]
    variance = np.diag(found.covariance)[told]
    less = np.einsum('ij,jk,ik->i', across, np.linalg.pinv(among, hermitian=True), across)
    # Of the belief's own: what data say of a number is what is missing from 1.
    belief = np.array([u.tolerance for u in found.unknowns])[told] ** 2
    unsure, were_they_known = (np.clip(v / belief, 0, 1) for v in (variance, variance - less))
    return float(counted.sum() - (unsure - were_they_known).sum())


def _own_count(found: Fit, data_sets: Sequence[DataSet]) -> int:
    """Values that these data sets have of their own beyond their initial motions."""
    several = {
        'record': len(data_sets),
        'recording': len({data_set.recording for data_set in data_sets}),
    }
    return sum(several[u.each] for u in found.own)


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


def cost_of(task: Task) -> int:
    """Candidates of higher rank take longer to fit: more starts, states, records of their own."""
    effect = effect_of(task)
    assert effect is not None
    swept = any(p.swept for p in effect.parameters)
    return 100 * eventful(task) + 10 * bool(effect.states) + 10 * swept + len(starts_of(effect))


def _best_fit(task: Task, train: Sequence[DataSet]) -> Fit:
    if eventful(task):
        return _event_fit(task, train)
    best = _own_fit(task, train)
    if task.base is None or cost(best) <= cost(task.base):
        return best
    model = next(_starting_models(task))
    start = started_from(task.base, model, task.bounds)
    again = _whole(task, model, train, start, task.iterations)
    return min(best, again, key=cost)


def started_from(
    found: Fit, model: Model, bounds: Bounds, only: Sequence[str] | None = None
) -> Fit:
    """A fit as a start for a model of other effects; what it has not is where the model says."""
    known = {u.name: v for u, v in zip(found.unknowns, found.values, strict=True)}
    unknowns = unknowns_of(model, only, bounds)
    own = own_unknowns(model)
    before = unsettled_states(found.model)
    motions = []
    for motion in found.motions:
        first = len(motion) - len(found.own)
        known_own = {u.name: v for u, v in zip(found.own, motion[first:], strict=True)}
        moving = first - len(before)
        away = dict(zip(before, motion[moving:first], strict=True))
        motions.append(
            np.array([
                *motion[:moving],
                *(away.get(state, 0.0) for state in unsettled_states(model)),
                *(known_own.get(u.name, u.prior) for u in own),
            ])
        )  # fmt: skip
    values = np.array([np.clip(known.get(u.name, u.prior), u.lower, u.upper) for u in unknowns])
    return replace(
        found, model=_chosen(model, found), unknowns=unknowns, values=values, own=own,
        motions=tuple(motions),
    )  # fmt: skip


def _own_fit(task: Task, train: Sequence[DataSet]) -> Fit:
    model, warm_starts = next(_starting_models(task)), task.warm_starts
    effect = effect_of(task)
    if not warm_starts and effect and len(starts_of(effect)) > 1:
        warm_starts = _first_seconds(task, train)
    if not warm_starts:
        return _whole(task, model, train, None, task.iterations)
    # The first seconds may mislead where the error has many minima: a resonance that is not
    # excited yet, a gap that is passed once.
    best = _whole(
        task, _chosen(model, warm_starts[0]), train, warm_starts[0], settings.SCREENING.following
    )
    for warm_start in warm_starts[1:]:
        # What comes to the noise with numbers that nobody believes has a rival in beliefs.
        done = best.normalised_error < settings.NOISE.settled and not far(best, task.bounds)
        # A look is a quick fit: near the noise it may still come there, whatever the reach.
        if done or warm_start.normalised_error > max(task.reach, settings.NOISE.quick):
            break
        other = _whole(
            task, _chosen(model, warm_start), train, warm_start, settings.SCREENING.following
        )
        best = min(best, other, key=cost)
    left = task.iterations - settings.SCREENING.following
    if best.converged or left < 1:
        return best
    return _whole(task, _chosen(model, best), train, best, left)


def _chosen(model: Model, warm_start: Fit) -> Model:
    """The model with the choices that a warm start has made for the last of its effects."""
    stated = warm_start.model.values
    names = [f'{e.label}.{p.name}' for e in model.effects[-1:] for p in e.parameters if p.choice]
    return model.with_values({name: stated[name] for name in names if name in stated})


def _whole(
    task: Task, model: Model, train: Sequence[DataSet], start: Fit | None, iterations: int
) -> Fit:
    """Fit whole records, all of them."""
    start = excerpt.to_all(start, train) if start else None
    return fit(
        model, train, start=start, own=task.events, bounds=task.bounds, iterations=iterations,
        thorough=task.thorough, reach=task.reach,
    )  # fmt: skip


def effect_of(task: Task) -> Effect | None:
    """The effect that a task tries; None of a base alone."""
    if task.effect is None:
        return None
    name, at = task.effect
    return LIBRARY[name](task.model.mechanism, at)


def _declared(task: Task) -> tuple[Parameter, ...]:
    """Parameters of the effect that is tried."""
    effect = effect_of(task)
    return effect.parameters if effect else ()


def eventful(task: Task) -> bool:
    """Whether the effect is one of which every record has its own."""
    if task.effect is None:
        return False
    return any(p.each == 'record' for p in _declared(task))


def _first_seconds(task: Task, train: Sequence[DataSet]) -> tuple[Fit, ...]:
    """Fits to an excerpt from every start: the best, and others that differ from it.

    From the warm starts of the task, where it has some: screenings of the same effect beside
    other small faults.
    """
    models = list(_starting_models(task, train))
    kept = _swept(models[0]) if not task.warm_starts else []
    if task.warm_starts:
        starts: list[Start] = [
            (_chosen(models[0], warm_start), warm_start) for warm_start in task.warm_starts
        ]
    else:
        starts = [(model, _beside_base(task, model, kept)) for model in models]
    # At a given frequency a few steps from where the base stands tell what may come of it.
    near = bool(kept) and starts[0][1] is not None
    iterations = settings.SCREENING.heat if near else settings.SCREENING.iterations
    screenings = _all_screened(task, starts, train, kept, iterations)
    if kept:
        # Let go of the frequency only where a fit at its start is promising.
        screenings = _all_screened(
            task,
            [(model, None) for _, model in screenings[: settings.SCREENING.followed]],
            train,
            [],
        )
    warm_starts: list[Fit] = []
    for screening, model in screenings:
        if not any(
            one_minimum(screening, warm_start, model.effects[-1].label)
            for warm_start in warm_starts
        ):
            warm_starts.append(screening)
    return tuple(warm_starts[: settings.SCREENING.followed])


def _beside_base(task: Task, model: Model, kept: Sequence[str]) -> Fit | None:
    """Where the base stands, as a start for a look; None where the file's numbers are better.

    A law without states changes little, and the base's numbers are near. A rotor takes over what
    those have made up for, and finds no way back from them. On a robot torques lead the way.
    """
    tried = effect_of(task)
    if task.first is None or tried is None or tried.states or torque_error.can(task.model):
        return None
    moved = [u.name for u in unknowns_of(model, bounds=task.bounds) if u.name not in kept]
    return started_from(task.first, model, task.bounds, moved)


def one_minimum(a: Fit, b: Fit, label: str) -> bool:
    """Whether two fits of an effect ended alike, or will."""
    own, other = (
        {u.name: v for u, v in zip(found.unknowns, found.values, strict=True)
         if u.name.startswith(f'{label}.')}
        for found in (a, b)
    )  # fmt: skip
    near = a.normalised_error < settings.SCREENING.same * b.normalised_error
    alike = np.allclose(
        list(own.values()), [other.get(n, np.nan) for n in own], rtol=settings.SCREENING.alike
    )
    return near and bool(alike)


def _event_fit(task: Task, train: Sequence[DataSet]) -> Fit:
    """An effect of which every record has its own size and instant."""
    best = task.warm_starts[0] if task.warm_starts else None
    settled = best or fit(task.model, train, own=task.events, bounds=task.bounds)
    nothing = settled.normalised_error
    settled = best or undisturbed(task.model, train, task.bounds) or settled
    for _ in range(settings.EVENTS.seekings if best else 1):
        # What was a push is at first taken for other parameters: seek again when it is not.
        at = {u.name: float(v) for u, v in zip(settled.unknowns, settled.values, strict=True)}
        model = next(_starting_models(task))
        events = seek_events(model.with_values(at), train, _label(task), task.events)
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


def _screened(
    task: Task,
    model: Model,
    train: Sequence[DataSet],
    only: Sequence[str] | None = None,
    start: Fit | None = None,
    at: Mapping[str, float] | None = None,
    iterations: int = settings.SCREENING.iterations,
    horizon: float | None = None,
) -> Fit:
    """A fit to an excerpt of the records: as long as the base's own look, if there is one."""
    few = [train[i] for i in excerpt.few(train)]
    usual = task.first.horizon if task.first else settings.SCREENING.lengths_s[0]
    return fit(
        model, few, only, horizon=horizon or usual,
        iterations=iterations, start=start, at=at,
        own=task.events, bounds=task.bounds, reach=task.reach, sure=False, company=True,
    )  # fmt: skip


def first_seconds(task: Task, train: Sequence[DataSet]) -> Fit | None:
    """Fit of a task's base to an excerpt, from its fit to whole records; None without.

    To so many seconds that something is wrong there: where nothing is, nothing can help.
    """
    found = None
    start = excerpt.to_few(task.base, train) if task.base else None
    for length in excerpt.lengths(train):
        try:
            found = _screened(task, task.model, train, start=start, horizon=length)
        except (IdentificationError, DynamicsError, np.linalg.LinAlgError):
            break
        if found.normalised_error > settings.NOISE.settled:
            break
    return found


def deeper(task: Task, warm_start: Fit, train: Sequence[DataSet]) -> Fit | None:
    """Fit of a task's base to an excerpt from where an effect more has led its numbers.

    Returns:
        The fit, if it lies clearly deeper than the base's own; None otherwise.
    """
    assert task.first is not None
    start = started_from(warm_start, task.model, task.bounds)
    try:
        found = _screened(task, task.model, train, start=start)
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError):
        return None
    return (
        found
        if settings.SCREENING.same * found.normalised_error < task.first.normalised_error
        else None
    )


def _swept(model: Model) -> list[str]:
    # Of the effect that is being tried: those before it stay about where they were found.
    own = model.effects[-1]
    return [f'{own.label}.{p.name}' for p in own.parameters if p.swept]


def _all_screened(
    task: Task,
    starts: Sequence[Start],
    train: Sequence[DataSet],
    kept: Sequence[str],
    iterations: int = settings.SCREENING.iterations,
) -> list[tuple[Fit, Model]]:
    """Short fits from each start and where they lead, best first; `kept` stay as they are.

    Of many starts of what takes long, all go a few steps, the best of them the rest of the way.
    """
    moved = (u.name for u in unknowns_of(starts[0][0], bounds=task.bounds))
    only = [name for name in moved if name not in kept] if kept else None
    led = _by_torque(task, starts, train, only)
    if task.first is not None and task.first.normalised_error < settings.NOISE.at_noise:
        led = led[: 1 if led[0][1] is not None else None]  # little is left: it is not far
    tried = effect_of(task)
    slow = torque_error.can(task.model) or (tried is not None and bool(tried.states))
    if len(led) > settings.SCREENING.followed and slow:
        heats = _short_fits(task, led, train, only, settings.SCREENING.heat)
        ahead = heats[: settings.SCREENING.followed]
        if ahead[0][0].normalised_error > settings.SCREENING.hopeless * task.reach:
            return [(found, model.with_values(_numbers(found))) for found, model in ahead]
        led = [((model, heat), None) for heat, model in ahead]
    return [
        (found, model.with_values(_numbers(found)))
        for found, model in _short_fits(task, led, train, only, iterations)
    ]


def _short_fits(
    task: Task,
    starts: Sequence[Led],
    train: Sequence[DataSet],
    only: Sequence[str] | None,
    iterations: int,
) -> list[tuple[Fit, Model]]:
    """Fits to an excerpt, with the models they set out from, best first.

    Args:
        task: What is looked at.
        starts: From where.
        train: Prepared records.
        only: As of `identify.fit`.
        iterations: Of each fit.

    Raises:
        IdentificationError: none of them can be simulated.
    """
    found = []
    for (model, start), at in starts:
        try:
            screened = _screened(task, model, train, only, start, at=at, iterations=iterations)
            found.append((screened, model))
        except IdentificationError as error:
            failure = error
    if not found:
        raise failure
    return sorted(found, key=lambda pair: cost(pair[0]))


def cost(found: Fit) -> float:
    """chi2 and beliefs: fits that leave the same error may differ in what nobody believes."""
    return found.normalised_error * float(found.count.sum()) + found.belief


def _numbers(found: Fit) -> dict[str, float]:
    return {u.name: float(v) for u, v in zip(found.unknowns, found.values, strict=True)}


def _by_torque(
    task: Task, starts: Sequence[Start], train: Sequence[DataSet], only: Sequence[str] | None
) -> list[Led]:
    """Those of the starts that are worth a simulation, and what the torques say of each.

    Starts from which torque fits come to one minimum are one; of a sensor, of time, or of states
    that something else moves than a joint, the torques know too little to tell starts apart.
    """
    models = [model for model, _ in starts]
    led: list[Led] = [(start, None) for start in starts]
    if any(start is not None for _, start in starts) or not torque_error.can(models[0]):
        return led
    few = [train[i] for i in excerpt.few(train)]
    tried = effect_of(task)
    beaten, rival = np.inf, task.rival
    if rival is not None and tried is not None and along_motion.follows(tried):
        by_torque = torque_error.fits_by_torque(
            [rival.model], few, None, rival.bounds, at=rival.at, quick=True
        )
        beaten = min((f.deviance for f in by_torque), default=np.inf) + settings.SCREENING.clearly
    found = task.torques or _fits_by_torque(task, models, few, only, beaten)
    if not found:
        return led
    if min(f.deviance for f in found) > beaten:
        raise RuledOut
    at = _numbers_of_base(task)
    led = [(start, {**at, **fitted.values}) for start, fitted in zip(starts, found, strict=True)]
    if tried is None or tried.place in ('sensor', 'timing'):
        return led
    if tried.states and not along_motion.follows(tried):
        return led
    own = f'{_label(task)}.'
    told: list[int] = []
    for k in sorted(range(len(found)), key=lambda k: found[k].deviance):
        numbers = [v for n, v in found[k].values.items() if n.startswith(own)]
        others = ([v for n, v in found[i].values.items() if n.startswith(own)] for i in told)
        if not any(np.allclose(numbers, o, rtol=settings.SCREENING.alike) for o in others):
            told.append(k)
    # A look at a law without states is short: torques need not choose among a few starts of it.
    many = bool(tried.states) or any(p.swept for p in tried.parameters)
    return [led[k] for k in (told[: settings.SCREENING.followed] if many else told)]


def torque_fits(task: Task, train: Sequence[DataSet]) -> tuple[TorqueFit, ...]:
    """What the torques say of an effect whose states they move, from each of its starts.

    Returns:
        A fit by torque error of each start; none where there is no such effect, or no look.
    """
    task, tried = _as_cause(task), effect_of(task)
    if tried is None or not along_motion.follows(tried) or not torque_error.can(task.model):
        return ()
    few = [train[i] for i in excerpt.few(train)]
    models = list(_starting_models(task, train))
    try:
        return tuple(_fits_by_torque(task, models, few, None, np.inf))
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError):
        return ()


def _fits_by_torque(
    task: Task,
    models: Sequence[Model],
    few: Sequence[DataSet],
    only: Sequence[str] | None,
    beaten: float,
) -> list[TorqueFit]:
    """What the torques say of each start; of many with states only the best go on.

    Along a motion a simulation goes with each step.
    """
    tried = effect_of(task)
    followed = 2 * settings.SCREENING.followed if tried and tried.states else None
    # What moves by itself in the base is simulated once: its numbers stay.
    settled = tuple(
        f'{e.label}.' for e in task.model.effects
        if along_motion.follows(e) and (tried is None or e.label != tried.label)
    )  # fmt: skip
    if settled:
        unknowns = unknowns_of(models[0], only, task.bounds)
        only = [u.name for u in unknowns if not u.name.startswith(settled)]
    return torque_error.fits_by_torque(
        models, few, only, task.bounds, at=_numbers_of_base(task), followed=followed, beaten=beaten
    )


def _numbers_of_base(task: Task) -> dict[str, float]:
    """Where the base stands: from there it is not far."""
    known = task.first or task.base
    return _numbers(known) if known else {}


def _starting_models(task: Task, train: Sequence[DataSet] = ()) -> Iterator[Model]:
    """The base with the effect, at each of its starts; some follow from the torques in `train`."""
    tried = effect_of(task)
    if task.effect is None or tried is None:
        yield task.model
        return
    name, at = task.effect
    small = any(effect.label == tried.label for effect in task.model.effects)
    base = task.model.without_effect(tried.label) if small else task.model
    body = task.model.mechanism
    drive = dict(zip(body.joints, body.inputs, strict=True)).get(tried.site)
    torques = [float(np.abs(t.inputs_for([drive])).max()) for t in train if drive is not None]
    starts = tried.starts_beside(max(torques)) if any(torques) else []
    for start in starts or starts_of(tried):
        yield base.with_effect(name, at, **start | turning(base, name, at))


def _label(task: Task) -> str:
    effect = effect_of(task)
    return effect.label if effect else task.model.name


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


def chi2(o: Outcome) -> float:
    """Squared error over noise variance, training and held-out data sets together."""
    return o.train.squares + o.held.squares


def parameters_of(o: Outcome, label: str) -> dict[str, tuple[float, float, str]]:
    """Identified parameters of one effect: name -> (value, standard deviation, unit).

    And a choice, where it is not the usual one, as something known for certain.

    Of what every record has of its own, that of the record where it is surest: of those that were
    fitted, if it happened in one, as held-out records take the model's own numbers for certain.
    """
    prefix = f'{label}.'
    shared = shared_parameters(o.train, label)
    own = next((e.parameters for e in o.model.effects if e.label == label), ())
    for p in own:
        chosen = o.model.values[f'{prefix}{p.name}']
        if p.choice and p.name not in shared and chosen != p.starts[0]:
            shared[p.name] = chosen, 0.0, p.unit
    events = events_of(o, label)
    fitted = [events[name] for name in o.data_sets[0] if name in events]
    sizes = _sizes(o.model, label)
    surest = max(fitted or events.values(), key=lambda e: _sureness(e, sizes), default={})
    return {**surest, **shared}


def shared_parameters(found: Fit, label: str) -> dict[str, tuple[float, float, str]]:
    """Those parameters of an effect that all records share: name -> (value, sigma, unit)."""
    prefix = f'{label}.'
    return {
        u.name.removeprefix(prefix): (float(v), float(s), u.unit)
        for u, v, s in zip(found.unknowns, found.values, found.sigmas, strict=True)
        if u.name.startswith(prefix)
    }


def events_of(o: Outcome, label: str) -> dict[str, dict[str, tuple[float, float, str]]]:
    """What surely happened in single records: record -> own parameter -> (value, sigma, unit).

    The intervals of held-out records take the shared numbers for certain; `events_in` of a fit to
    all records (fit_to_all) does not.
    """
    train, held = o.data_sets
    return {**events_in(o.train, train, label), **events_in(o.held, held, label)}


def events_in(
    found: Fit, names: Sequence[str], label: str
) -> dict[str, dict[str, tuple[float, float, str]]]:
    """What surely happened, by one fit to the records of these names; as `events_of`."""
    events, sizes = {}, _sizes(found.model, label)
    for name, motion, sigmas in zip(names, found.motions, found.own_sigmas, strict=True):
        values = motion[len(motion) - len(found.own) :]
        row = {
            u.name.removeprefix(f'{label}.'): (float(v), float(s), u.unit)
            for u, v, s in zip(found.own, values, sigmas, strict=True)
            if u.name.startswith(f'{label}.')
        }
        if row and _sureness(row, sizes) > settings.EVENTS.sure:
            events[name] = row
    return events


def _sizes(model: Model, label: str) -> tuple[str, ...]:
    """Those of an effect's own values in a record that are 0 where nothing happens."""
    own = next((e.parameters for e in model.effects if e.label == label), ())
    return tuple(p.name for p in own if p.each and p.neutral is not None)


def _sureness(event: Mapping[str, tuple[float, float, str]], sizes: Sequence[str]) -> float:
    """Standard deviations by which the surest size of an event differs from 0."""
    return max(abs(event[name][0]) / max(event[name][1], 1e-300) for name in sizes)


def own_parameters(o: Outcome) -> dict[str, tuple[float, float, str]]:
    """Parameters of the effect tried: name -> (value, standard deviation, unit)."""
    return parameters_of(o, o.label)


def prior_conflicts(o: Outcome) -> dict[str, float]:
    """Parameters that the fit puts far from what the file believes: tolerances away."""
    return far(o.train, o.task.bounds)


def far(found: Fit, bounds: Mapping[str, float]) -> dict[str, float]:
    """The same of a fit with those bounds on small faults."""
    away = {
        u.name: abs(u.to_coordinate(v) - u.to_coordinate(u.prior)) / u.tolerance
        for u, v in zip(found.unknowns, found.values, strict=True)
        if np.isfinite(u.tolerance) and u.name not in bounds
    }
    return {
        name: tolerances
        for name, tolerances in away.items()
        if tolerances > settings.PRIOR.conflict
    }


def _declared_by(o: Outcome) -> tuple[Parameter, ...]:
    """Parameters of the effect that an outcome is of; none where it is of a model alone."""
    found = (e.parameters for e in o.model.effects if e.label == o.label and e.name in LIBRARY)
    return next(found, ())


def too_small(o: Outcome) -> list[str]:
    """An effect whose size is as good as none is not what helped."""
    first = next(iter(_declared_by(o)), None)
    if first is None or first.neutral is None or not np.isfinite(first.neutral) or first.each:
        return []
    value, sigma, unit = parameters_of(o, o.label).get(first.name, (np.inf, 0.0, ''))
    # Within their bounds small faults may take any part of it: that says nothing of its size.
    beside = _sigma_beside(o.train, f'{o.label}.{first.name}', o.task.bounds)
    if abs(value - first.neutral) > settings.SELECTION.too_small * min(sigma, beside):
        return []
    return [f'{first.name} = {measured(value, sigma, unit)} is as good as none']


def undetermined_size(o: Outcome) -> list[str]:
    """An effect of whose size not even the order is known is not what helped.

    A limit that was never reached, a stiffness that nothing bends: what acts is something else.
    """
    name = next((p.name for p in _declared_by(o)), '')
    if f'{o.label}.{name}' not in o.train.undetermined:
        return []
    return [f'{name} = {measured(*parameters_of(o, o.label)[name])} is not determined']


def _sigma_beside(found: Fit, name: str, given: Collection[str]) -> float:
    """Standard deviation of a value, were the values of these names known."""
    names = [u.name for u in found.unknowns]
    if name not in names:
        return np.inf
    at, known = names.index(name), [names.index(n) for n in given if n in names]
    among, across = found.covariance[np.ix_(known, known)], found.covariance[at, known]
    if not known or not np.isfinite(among).all() or not np.isfinite(across).all():
        return float(found.sigmas[at])
    variance = found.covariance[at, at] - across @ np.linalg.pinv(among) @ across
    factor = abs(found.values[at]) if found.unknowns[at].logarithmic else 1.0
    return factor * float(np.sqrt(max(variance, 0.0)))


def at_edge(o: Outcome) -> list[str]:
    """That a parameter at the edge of its range says that the effect is not what is meant."""
    return [
        f'{o.label}.{name} = {measured(value, None, unit)} lies at the edge of its range'
        for name, (value, unit) in parameters_at_edge(o).items()
    ]


def parameters_at_edge(o: Outcome) -> dict[str, tuple[float, str]]:
    """Those of an outcome's effect, with value and unit.

    But for a part of an effect that may well be absent: the edge is where it vanishes; and where
    physics ends with the range.
    """
    found = {}
    declared = _declared_by(o)
    optional = {f'{o.label}.{p.name}' for p in declared[1:] if p.neutral == p.lower}
    ends = {f'{o.label}.{p.name}': p.ends for p in declared}
    for u, v in zip(o.train.unknowns, o.train.values, strict=True):
        if u.name in o.task.bounds or not u.name.startswith(f'{o.label}.'):
            continue
        low, high, at = (
            u.to_coordinate(x) if not u.logarithmic or x > 0 else -np.inf
            for x in (u.lower, u.upper, v)
        )
        # Ranges suit machines of all sizes: a small value is not yet an edge.
        margin = 1e-3 * (high - low)
        if not u.logarithmic:
            margin = min(margin, 0.1 * u.scale)
        physical = ends.get(u.name, ())
        below = low + margin if u.name not in optional and 'lower' not in physical else -np.inf
        above = high - margin if 'upper' not in physical else np.inf
        if not below < at < above:
            found[u.name.removeprefix(f'{o.label}.')] = float(v), u.unit
    return found
