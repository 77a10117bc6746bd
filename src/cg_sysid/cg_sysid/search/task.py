"""One candidate as a task: which effect, where, on top of which model, and what is known of it."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import CLOCKS, Effect
from cg_dynamics.model import Model
from cg_dynamics.parameter import Parameter
from cg_dynamics.rig import Setup
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.torque_error import TorqueFit
from cg_sysid.identification.unknowns import IdentificationError
from cg_sysid.search import settings
from cg_sysid.search.nuisance import Bounds

EffectAt = tuple[str, str | None]  # name of an effect, and where it acts


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
        bounds: Small faults that the base may have (nuisance.py).
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
    effect: EffectAt | None = None
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


def candidates_for(
    model: Model,
    setups: Sequence[Setup],
    names: Sequence[str] | None = None,
    recorded: Collection[str] = (),
    small: Collection[str] = (),
) -> list[EffectAt]:
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


def effect_of(task: Task) -> Effect | None:
    """The effect that a task tries; None of a base alone."""
    if task.effect is None:
        return None
    name, at = task.effect
    return LIBRARY[name](task.model.mechanism, at)


def label_of(task: Task) -> str:
    """Label of the effect that a task tries; name of the model for a base alone."""
    effect = effect_of(task)
    return effect.label if effect else task.model.name


def _declared(task: Task) -> tuple[Parameter, ...]:
    """Parameters of the effect that is tried."""
    effect = effect_of(task)
    return effect.parameters if effect else ()


def eventful(task: Task) -> bool:
    """Whether the effect is one of which every record has its own."""
    if task.effect is None:
        return False
    return any(p.each == 'record' for p in _declared(task))


def as_cause(task: Task) -> Task:
    """What is tried as a cause is not bound to be small, as the same small fault would be.

    Only the shape of its law is bound, where small faults are allowed for.
    """
    if task.effect is None or not task.bounds:
        return task
    own = f'{label_of(task)}.'
    shapes = {f'{own}{p.name}': p.leeway for p in _declared(task) if p.leeway}
    others = {n: b for n, b in task.bounds.items() if not n.startswith(own)}
    return replace(task, bounds=others | shapes)
