"""A first look at a candidate: short fits to an excerpt, from each of its starts.

On a robot torques lead the way: starts from which they come to one minimum are one, and of many
starts of what moves by itself only those go on that explain them best.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import TIME
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_sysid.errors import Failure
from cg_sysid.identification import along_motion, torque_error
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.identify import fit
from cg_sysid.identification.torque_error import TorqueFit
from cg_sysid.identification.unknowns import IdentificationError, unknowns_of
from cg_sysid.search import excerpt, settings
from cg_sysid.search.outcome import Outcome, one_minimum
from cg_sysid.search.starts import chosen, numbers_of_base, started_from, starting_models
from cg_sysid.search.task import Rival, Task, as_cause, effect_of, eventful, label_of

Start = tuple[Model, Fit | None]
Led = tuple[Start, Mapping[str, float] | None]  # a start, and what torques say of it


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


class RuledOut(Exception):
    """The torques speak clearly for a rival."""


def screen(task: Task, train: Sequence[DataSet]) -> Screening | Failure:
    """Fit one candidate to an excerpt of the training data sets, from each of its starts.

    Returns:
        The look, or a sentence saying why there is none.
    """
    label, task = label_of(task), as_cause(task)
    late = TIME in LIBRARY[label.partition('@')[0]].extra_inputs
    if eventful(task) or late or not excerpt.lengths(train):
        return Screening(label, task, np.nan)
    try:
        warm_starts = looks_from_starts(task, train)
        if (
            task.first is not None
            and warm_starts[0].normalised_error > task.first.normalised_error
        ):
            model = next(starting_models(task))
            beyond = _screened(
                task, model, train, start=started_from(task.first, model, task.bounds)
            )
            warm_starts = tuple(sorted([beyond, *warm_starts], key=lambda found: found.misfit))
            warm_starts = warm_starts[: settings.SCREENING.followed]
    except RuledOut:
        return Screening(label, task, np.inf)
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError) as error:
        return Failure(str(error))
    return Screening(
        label, replace(task, warm_starts=warm_starts), warm_starts[0].normalised_error
    )


def rival_of(found: Screening | Outcome) -> Rival:
    """What others have to come up to."""
    if isinstance(found, Outcome):
        return Rival(found.model, found.train.numbers, found.task.bounds)
    model = next(starting_models(found.task))
    return Rival(model, found.task.warm_starts[0].numbers, found.task.bounds)


def led_on(screening: Screening, task: Task) -> Screening:
    """The look for a task that has other small faults beside the same effect."""
    task = as_cause(task)
    model = next(starting_models(task))
    warm_starts = tuple(
        started_from(warm_start, model, task.bounds) for warm_start in screening.task.warm_starts
    )
    return replace(screening, task=replace(task, warm_starts=warm_starts))


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


def same_seconds(task: Task, train: Sequence[DataSet]) -> Fit | None:
    """Fit of a task's model to those seconds that another was looked at (`task.first`), if any."""
    try:
        return _screened(task, task.model, train)
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError):
        return None


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


def torque_fits(task: Task, train: Sequence[DataSet]) -> tuple[TorqueFit, ...]:
    """What the torques say of an effect whose states they move, from each of its starts.

    Returns:
        A fit by torque error of each start; none where there is no such effect, or no look.
    """
    task, tried = as_cause(task), effect_of(task)
    if tried is None or not along_motion.follows(tried) or not torque_error.can(task.model):
        return ()
    few = [train[i] for i in excerpt.few(train)]
    models = list(starting_models(task, train))
    try:
        return tuple(_fits_by_torque(task, models, few, None, np.inf))
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError):
        return ()


def looks_from_starts(task: Task, train: Sequence[DataSet]) -> tuple[Fit, ...]:
    """Fits to an excerpt from every start: the best, and others that differ from it.

    From the warm starts of the task, where it has some: screenings of the same effect beside
    other small faults.
    """
    models = list(starting_models(task, train))
    kept = _swept(models[0]) if not task.warm_starts else []
    if task.warm_starts:
        starts: list[Start] = [
            (chosen(models[0], warm_start), warm_start) for warm_start in task.warm_starts
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
            return [(found, model.with_values(found.numbers)) for found, model in ahead]
        led = [((model, heat), None) for heat, model in ahead]
    return [
        (found, model.with_values(found.numbers))
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
    return sorted(found, key=lambda pair: pair[0].misfit)


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
    at = numbers_of_base(task)
    led = [(start, {**at, **fitted.values}) for start, fitted in zip(starts, found, strict=True)]
    if tried is None or tried.place in ('sensor', 'timing'):
        return led
    if tried.states and not along_motion.follows(tried):
        return led
    own = f'{label_of(task)}.'
    told: list[int] = []
    for k in sorted(range(len(found)), key=lambda k: found[k].deviance):
        numbers = [v for n, v in found[k].values.items() if n.startswith(own)]
        others = ([v for n, v in found[i].values.items() if n.startswith(own)] for i in told)
        if not any(np.allclose(numbers, o, rtol=settings.SCREENING.alike) for o in others):
            told.append(k)
    # A look at a law without states is short: torques need not choose among a few starts of it.
    many = bool(tried.states) or any(p.swept for p in tried.parameters)
    return [led[k] for k in (told[: settings.SCREENING.followed] if many else told)]


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
        models, few, only, task.bounds, at=numbers_of_base(task), followed=followed, beaten=beaten
    )
