"""Which number differs from recording to recording?

A joint greased in between, a supply that sags, a robot set down on another floor: within a
recording a number stands still, from one to the next it does not. No effect of the library says
so, and no function of one variable. So one number after the other gets a value of each recording's
own, with all else identified anew: that which takes most of the error away is where to look.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_sysid.diagnosis.between_recordings import Wandering
from cg_sysid.errors import Failure
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.identify import fit
from cg_sysid.identification.unknowns import IdentificationError, own_unknowns
from cg_sysid.search import settings
from cg_sysid.search.nuisance import turning
from cg_sysid.search.outcome import Outcome
from cg_sysid.search.starts import started_from
from cg_sysid.search.task import EffectAt, candidates_for

FEWEST_RECORDINGS = 3  # recordings: two always differ
MOST_RECORDINGS = 30  # recordings; of more, as the steps of a walk, none is a session
EXPLAINS = 0.7  # share of the error above the noise that a number must take away
CLEARLY = 0.5  # of what the next best number leaves, that the best may leave
ITERATIONS = 24
FIRST_ITERATIONS = 4  # of all numbers, before the best of them go on
FINALISTS = 3

Run = Callable[[Callable, list[tuple], str], list]


def what_wanders(
    o: Outcome, data_sets: Sequence[DataSet], names: Sequence[str] | None, run: Run
) -> Wandering | None:
    """The number that explains most if every recording has its own; None if none does much.

    Args:
        o: The model as far as it is known, fitted.
        data_sets: Those that it was fitted to, then those held out.
        names: Effects that may be tried; None for the whole library.
        run: Calls a function with each tuple of arguments, in parallel perhaps, and tells people
            what for.
    """
    recordings = list(dict.fromkeys(data_set.recording for data_set in data_sets))
    if not FEWEST_RECORDINGS <= len(recordings) <= MOST_RECORDINGS:
        return None
    start = replace(o.train, motions=(*o.train.motions, *o.held.motions))
    numbers = list(numbers_of(o.train.model, data_sets, names))
    nothing = (o, '', None, data_sets, start, np.inf, False)
    base = run(_fit_with_own, [nothing], 'all recordings as one')[0]
    if isinstance(base, Failure) or base.normalised_error < settings.NOISE.at_noise:
        return None
    # Who leaves more is neither named nor in the way of another.
    reach = 1 + (1 - EXPLAINS) / CLEARLY * (base.normalised_error - 1)
    arguments = [(o, *number, data_sets, start, reach, True) for number in numbers]
    first = run(_fit_with_own, arguments, 'recording by recording')
    leading = sorted(
        ((f, number) for f, number in zip(first, numbers, strict=True) if isinstance(f, Fit)),
        key=lambda pair: _above_noise(pair[0]),
    )[:FINALISTS]
    arguments = [(o, *number, data_sets, f, reach, False) for f, number in leading]
    found = run(_fit_with_own, arguments, 'the best of them to their end')
    fits = sorted((f for f in found if isinstance(f, Fit)), key=_above_noise)
    if not fits:
        return None
    best, *others = fits
    explained = 1 - _above_noise(best) / _above_noise(base)
    left = min(map(_above_noise, others), default=np.inf)
    if not explained > EXPLAINS or _above_noise(best) > CLEARLY * left:
        return None
    return _wandering(best, o.model, data_sets, explained)


def _above_noise(found: Fit) -> float:
    return float(found.squares - found.count.sum())


def _wandering(
    found: Fit, model: Model, data_sets: Sequence[DataSet], explained: float
) -> Wandering:
    known = {u.name for u in own_unknowns(model)}
    (place,) = (k for k, u in enumerate(found.own) if u.name not in known)
    number, first = found.own[place], len(found.own) - place
    values = {}
    for data_set, motion, sigmas in zip(data_sets, found.motions, found.own_sigmas, strict=True):
        values[data_set.recording] = float(motion[len(motion) - first]), float(sigmas[place])
    called = {recording: Path(recording).name for recording in values}
    if len(set(called.values())) < len(called):
        called = {recording: recording for recording in values}
    return Wandering(
        number.name, number.unit, {called[r]: values[r] for r in sorted(values)}, explained
    )


def numbers_of(
    model: Model, data_sets: Sequence[DataSet], names: Sequence[str] | None
) -> Iterator[EffectAt]:
    """(Effect, place) of those that have one number, their size; of the model or not."""
    stated = [(effect.name, effect.at) for effect in model.effects]
    lacking = candidates_for(model, [data_set.setup for data_set in data_sets], names)
    for name, at in (*stated, *lacking):
        if name not in LIBRARY:
            continue
        effect = LIBRARY[name](model.mechanism, at)
        parameters = effect.parameters
        own = any(p.each for p in parameters)
        plain = not (own or effect.states or effect.extra_inputs) and parameters[0].neutral == 0.0
        if plain and sum(p.free for p in parameters) == 1:
            yield name, at


def _fit_with_own(
    o: Outcome,
    name: str,
    at: str | None,
    data_sets: Sequence[DataSet],
    start: Fit,
    reach: float,
    first: bool,
) -> Fit | Failure:
    """A fit to all records where every recording has its own size of the effect that is named.

    At first a few iterations in company: to compile dozens of models would take longer.
    """
    model = with_own(o.model, name, at, o.train.model) if name else o.model
    bounds = o.task.bounds
    try:
        found = fit(
            model,
            data_sets,
            start=started_from(start, model, bounds),
            own=o.events,
            bounds=bounds,
            iterations=FIRST_ITERATIONS if first else ITERATIONS,
            reach=reach,
            sure=not first,
            company=first,
        )
        return replace(found, model=o.model)  # a class made here does not leave this process
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError) as error:
        return Failure(str(error))


def with_own(model: Model, name: str, at: str | None, fitted: Model) -> Model:
    """The model in which every recording has its own size of an effect.

    The effect is added if the model lacks it. The size that stands for recordings which nobody
    has seen is that of `fitted`.
    """
    kind = LIBRARY[name]
    label, (size, *others) = kind(model.mechanism, at).label, kind.parameters
    if all(effect.label != label for effect in model.effects):
        model = model.with_effect(name, at, **{size.name: size.scale}, **turning(model, name, at))
    else:
        model = model.with_values({f'{label}.{size.name}': fitted.values[f'{label}.{size.name}']})
    own = (replace(size, each='recording'), *others)
    marked = type(kind.__name__, (kind,), {'parameters': own})
    effects = (e if e.label != label else marked(model.mechanism, at) for e in model.effects)
    return replace(model, effects=tuple(effects))
