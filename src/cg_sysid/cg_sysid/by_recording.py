"""Which number differs from recording to recording?

Grease that warms over a session, a supply that sags, a robot set down on another floor: within a
recording a number stands still, from one to the next it does not. No effect of the library says
so, and no function of one variable. So each number is fitted to each recording by itself, one at a
time and all else as it is: that which takes most of the error away is where to look.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_sysid.candidates import Outcome, candidates_for, chi2
from cg_sysid.identify import fit
from cg_sysid.jury import samples
from cg_sysid.trial import Trial
from cg_sysid.unknowns import IdentificationError, unknowns_of
from cg_sysid.wandering import Wandering

FEWEST = 3  # recordings: two always differ
MOST = 30  # recordings; of more, as the steps of a walk, none is a session
# Share of the error above the noise that a number must take away. All else stays where it was
# fitted without that, so that even the right one does not take all.
EXPLAINS = 0.5
CLEARLY = 0.7  # of what the next best number leaves, that the best may leave
ITERATIONS = 16

Run = Callable[[Callable, list[tuple], str], list]


def what_wanders(
    o: Outcome, trials: Sequence[Trial], names: Sequence[str] | None, run: Run
) -> Wandering | None:
    """The number that explains most if every recording has its own; None if none does much.

    Args:
        o: The model as far as it is known, fitted.
        trials: All of them.
        names: Effects that may be tried; None for the whole library.
        run: Calls a function with each tuple of arguments, in parallel perhaps, and tells people
            what for.
    """
    recordings = sorted({trial.recording for trial in trials})
    total = chi2(o) - samples(o)
    if not FEWEST <= len(recordings) <= MOST or not total > 0:
        return None
    called = [Path(recording).name for recording in recordings]
    if len(set(called)) < len(called):
        called = recordings
    groups = [[t for t in trials if t.recording == recording] for recording in recordings]
    numbers = list(numbers_of(o, trials, names))
    arguments = [(model, name, group, o.events) for model, name in numbers for group in groups]
    found = run(_of_recording, arguments, 'recording by recording')
    wandering = []
    for k, (model, name) in enumerate(numbers):
        own = found[k * len(groups) : (k + 1) * len(groups)]
        if any(isinstance(part, str) for part in own):
            continue
        explained = 1 - (sum(squares for *_, squares in own) - samples(o)) / total
        values = {r: (value, sigma) for r, (value, sigma, _) in zip(called, own, strict=True)}
        wandering.append(Wandering(name, model.declarations[name].unit, values, explained))
    if not wandering:
        return None
    best, *others = sorted(wandering, key=lambda w: -w.explained)
    left = min((1 - other.explained for other in others), default=1.0)
    clear = best.explained > EXPLAINS and 1 - best.explained < CLEARLY * left
    return best if clear else None


def numbers_of(o: Outcome, trials: Sequence[Trial], names: Sequence[str] | None):
    """Models and the number to be fitted in each: those of the model, and sizes of effects."""
    fitted = o.train.model
    for unknown in unknowns_of(fitted):
        yield _unbelieved(fitted, unknown.name), unknown.name
    for name, at in candidates_for(fitted, [trial.setup for trial in trials], names):
        kind = LIBRARY[name]
        size = kind.parameters[0]
        own = any(p.each for p in kind.parameters)
        plain = not (own or kind.states or kind.extra_inputs) and size.neutral == 0.0
        if plain and sum(p.free for p in kind.parameters) == 1:
            model = fitted.with_effect(name, at, **{size.name: size.scale})
            yield model, f'{model.effects[-1].label}.{size.name}'


def _unbelieved(model: Model, name: str) -> Model:
    """The model with no belief in one of its numbers but that of its file."""
    freed = replace(model.quantities[name], tolerance=None, fixed=False)
    return replace(model, quantities={**model.quantities, name: freed})


def _of_recording(model, name, trials, events) -> tuple[float, float, float] | str:
    """Value, standard deviation and squared error of one number on one recording."""
    try:
        found = fit(model, trials, only=[name], own=events, iterations=ITERATIONS)
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError) as error:
        return str(error)
    return float(found.values[0]), float(found.sigmas[0]), found.squares
