"""What every robot has a little of: let go within bounds, taken back where it explains nothing."""

import logging
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid.diagnosis.comparing import alone, compare, effects_on, refitted, worth_a_look
from cg_sysid.diagnosis.free_shapes import (
    explained_by_own_shapes,
    with_hard_friction,
    with_mixed_friction,
)
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.errors import Failure
from cg_sysid.identification import torque_error
from cg_sysid.search import settings
from cg_sysid.search.model_selection import (
    Comparison,
    above_noise,
    at_noise,
    explained_by,
    settled,
)
from cg_sysid.search.nuisance import (
    SOUND_LAWS,
    as_sound_robots,
    faults_among,
    nuisances,
    with_nuisances,
)
from cg_sysid.search.outcome import Outcome, chi2, parameters_of
from cg_sysid.search.ranking import Candidate, effect_name
from cg_sysid.search.standings import title_of
from cg_sysid.search.starts import started_from
from cg_sysid.search.successive_halving import Effects
from cg_sysid.search.task import Task
from cg_sysid.text import measured

log = logging.getLogger(__name__)

SMALL_FAULTS = 'small faults'


def with_small_faults(work: Workspace, o: Outcome) -> Outcome:
    """The same with what every robot has a little of, if that explains anything."""
    if settled(o) or o.task.bounds:
        return o
    model, bounds = with_nuisances(o.model, work.setups())
    title = f'{title_of(work.added(o))}, with small faults'
    task = Task(model, events=o.events, bounds=bounds, base=o.train)
    if not at_noise(o):
        task = replace(task, reach=settings.DOUBT.most_of_it * o.train.normalised_error)
    if torque_error.can(model):
        # Torques lead to the same minimum with small faults and without: it is not far from there.
        task = replace(task, warm_starts=(started_from(o.train, model, bounds),))
    found = work.halving.fit([task], title)[0]
    if isinstance(found, Failure):
        log.info('small faults: %s', found)
        return o
    if at_noise(o):
        return found if settled(found) else o  # only beliefs are at stake
    found = work.faulty[work.added(o)] = with_hard_friction(work, found)
    # Beside a large cause they would explain a little of it; then they can wait.
    if chi2(found) >= settings.DOUBT.most_of_it * chi2(o):
        return o
    work.faulty[work.added(o)] = with_mixed_friction(work, found)
    return work.faulty[work.added(o)]


def law_at_once(work: Workspace, o: Outcome) -> Outcome | None:
    """The base with a law that sound machines follow, where that alone comes to the noise.

    Then the library is not tried at all. Who imitates such a law leaves what is far from white.
    """
    if not o.task.bounds:
        return None
    dry = {effect.at for effect in o.model.effects if effect.friction == 'dry'}
    laws = [(name, at) for name, at in worth_a_look(work, o) if name in SOUND_LAWS and at in dry]
    if not laws:
        return None
    task = replace(alone(work, o), reach=settings.NOISE.quick)
    title = f'laws of sound machines on top of {title_of(work.added(o))}'
    looks = work.halving.screen([replace(task, effect=law) for law in laws], title)
    near = [look.task for look in looks if look.error < settings.NOISE.quick]
    found = [fit for fit in work.halving.fit(near, title) if isinstance(fit, Outcome)]
    comparison = work.selection.compare(o, found)
    law = sound_law(comparison)
    if (
        law is None
        or not at_noise(law)
        or work.selection.whiteness(law) < settings.NOISE.half_white
    ):
        return None
    work.note(comparison, '')
    return law


def sound_law(comparison: Comparison) -> Outcome | None:
    """The base with a law that sound machines follow, if that takes nearly all that is left.

    It is no cause, and too dear to be let go in every fit. But what it takes is none's to explain,
    so that the search ends there; it must come near the noise, or something else is wrong too.
    Where a cause is earned it must be better than that, and come to the noise.
    """
    base, winner = comparison.base, comparison.winner()
    most = min((1 - settings.DOUBT.nearly_all) * above_noise(base), settings.NOISE.quick - 1)
    for candidate, o in comparison.ranked:
        if winner and not (
            candidate.evidence > winner[0].evidence + comparison.margin and at_noise(o)
        ):
            continue
        law, label = SOUND_LAWS.get(effect_name(candidate.label)), candidate.label
        sound = as_sound_robots(label, candidate.parameters)
        if law and sound and candidate.reason == sound[0] and above_noise(o) < most:
            name = f'{label}.{law[0]}'
            bounds = {**o.task.bounds, name: settings.DOUBT.as_found}
            model = o.model.with_values({name: o.train.model.values[name]})
            task = replace(o.task, model=model, effect=None, bounds=bounds)
            return replace(o, task=task, model=model, label=base.label)
    return None


def with_law(work: Workspace, final: Outcome) -> Outcome:
    """What stands, with the law that takes what is left of it, if there is one."""
    if work.law is None or work.added(work.law) != work.added(final):
        return final
    return work.law


def rather_one_cause(work: Workspace, plain: Outcome, faulty: Outcome) -> Outcome | None:
    """One effect that alone explains more than all small faults together, if there is one.

    Together they can imitate much, but hardly down to the last of it. What the causes explain by
    themselves, with laws of another shape, asks for no other effect.
    """
    if faulty is plain or settled(plain) or explained_by_own_shapes(work, plain):
        return None
    comparison = compare(work, plain, faulty, beside_one_joint(work, plain, faulty))
    plain, winner = comparison.base, comparison.winner()
    if winner is None:
        return plain if settled(plain) else None
    least = winner[0].evidence - comparison.margin
    if any(as_sound_robots(c.label, c.parameters)
           for c, _ in comparison.ranked if c.evidence > least):  # fmt: skip
        return None  # it may be no more than that
    both = work.selection.compare(plain, [winner[1], replace(faulty, label=SMALL_FAULTS)])
    (first, _), (second, _) = both.ranked
    label = winner[0].label
    if first.evidence < second.evidence + both.margin:
        if len(shown(faulty)) < 2:
            work.instead = instead_of(*winner)
            return None
        # One cause that looks like several small faults, or several that conspire.
        work.doubted[label] = replace(faulty, label=SMALL_FAULTS)
    elif first.label == SMALL_FAULTS:
        return None
    work.note(comparison, label)
    return refitted(work, winner[1])


def beside_one_joint(work: Workspace, plain: Outcome, faulty: Outcome) -> Effects:
    """What moves beside one joint, and cannot take the place of small faults at another.

    A rotor, a bristle or a lag changes what its own joint gets. Where small faults come to the
    noise, those at other joints would have to stay.
    """
    if not at_noise(faulty):
        return []
    off = {name.rpartition('.')[0] for name in shapes_off(faulty, plain.model)}
    places = {effect.at for effect in faulty.model.effects if effect.label in off}
    return [
        (name, at) for name, at in effects_on(work, plain)
        if LIBRARY[name](plain.model.mechanism, at).states and places - {at, None}
    ]  # fmt: skip


def of_size(work: Workspace, comparison: Comparison) -> Comparison:
    """Without winners that hide behind small faults, but are small themselves.

    What a cause explains is asked beside those small faults only that it does not make idle.
    """
    while work.selection.imitated(comparison.base) and (winner := comparison.winner()):
        label = winner[0].label
        lean = less_small_faults(work, winner[1])
        without = without_small_faults(work, lean, [label])
        explained = explained_by(without, lean) if without else 0.0
        if explained >= settings.SELECTION.material:
            break
        comparison = comparison.less(
            label, f'explains {explained:.2f} noise standard deviations where no small fault '
            f'does, {settings.SELECTION.material:g} needed'
        )  # fmt: skip
    return comparison


def less_small_faults(work: Workspace, final: Outcome) -> Outcome:
    """Without those small faults that, beside the causes, explain nothing any more."""
    small = sorted(nuisances(final.model, final.task.bounds))
    idle = [label for label in small if not shows(final, label)]
    clear = any(shows(final, label, settings.DOUBT.clear) for label in small)
    reach = settings.HALVING.as_good * final.train.normalised_error
    for gone in ([] if clear else small, idle):
        if not gone:
            continue
        lean = without_small_faults(work, final, gone, reach)
        if lean is None:
            continue
        if work.selection.compare(lean, [final]).ranked[0][0].evidence < settings.SELECTION.earned:
            return lean
    return final


def bare(work: Workspace, o: Outcome) -> Outcome | None:
    """The same without anything small that the nominal model does not state."""
    large = replace(o, task=replace(o.task, bounds=faults_among(o.model, o.task.bounds)))
    return without_small_faults(work, large, sorted(nuisances(o.model, o.task.bounds)))


def without_small_faults(
    work: Workspace, o: Outcome, gone: Sequence[str], reach: float = np.inf
) -> Outcome | None:
    """The same without the small faults of these labels; None where that cannot be fitted.

    What lies beyond a reach (chi2/N) and gains little is not fitted to its end.
    """
    model, bounds = o.model, dict(o.task.bounds)
    for label in gone:
        model = model.without_effect(label)
        bounds = {n: b for n, b in bounds.items() if not n.startswith(f'{label}.')}
    start = started_from(o.train, model, bounds)
    task = Task(model, events=o.events, bounds=bounds, warm_starts=(start,), reach=reach)
    lean = work.halving.fit([task], 'without small faults')[0]
    return None if isinstance(lean, Failure) else lean


def told_small_faults(work: Workspace, final: Outcome) -> list[str]:
    """What is there of small faults and what else would explain them, in words."""
    found = small_faults_of(final)
    if work.selection.imitated(final):
        found.append(
            f'what these leave is {1 + above_noise(final):.3f} times the noise and follows '
            'something: a small cause may hide behind them'
        )
    return [*found, work.instead] if found and work.instead else found


def shown(o: Outcome) -> tuple[str, ...]:
    """Small faults that are there."""
    small = sorted(nuisances(o.model, o.task.bounds))
    return tuple(label for label in small if shows(o, label))


def shows(o: Outcome, label: str, times: float = settings.DOUBT.shows) -> bool:
    """True if a small fault is so many times larger than its uncertainty."""
    value, sigma, _ = next(iter(parameters_of(o, label).values()))
    return abs(value) > times * sigma


def small_faults_of(o: Outcome) -> list[str]:
    """What is there of small faults, in words."""
    found = []
    for label in sorted(nuisances(o.model, o.task.bounds)):
        for name, (value, sigma, unit) in parameters_of(o, label).items():
            bound = f'{label}.{name}' in o.task.bounds
            if bound and abs(value) > settings.DOUBT.shows * sigma:
                found.append(
                    f'{label}.{name} = {measured(value, sigma, unit)}: as sound robots have it'
                )
    return found


def shapes(o: Outcome, stated: Model) -> list[str]:
    """Laws that have another shape than a model states, in words."""
    return [
        f'{name} = {measured(value, sigma, unit)} and not {measured(said, None, unit)}: '
        'the shape of a law, which texts and machines draw differently'
        for name, (value, sigma, said, unit) in shapes_off(o, stated).items()
    ]


def shapes_off(o: Outcome, stated: Model) -> dict[str, tuple[float, float | None, float, str]]:
    """The same: full name -> (value, standard deviation if fitted, what is stated, unit)."""
    said = stated.values
    found: dict[str, tuple[float, float | None, float, str]] = {}
    for name, declared in o.model.declarations.items():
        value = o.model.values[name]
        if declared.leeway and name not in o.task.bounds and value != said.get(name, value):
            found[name] = value, None, said[name], declared.unit
    for u, v, s in zip(o.train.unknowns, o.train.values, o.train.sigmas, strict=True):
        if u.name not in o.task.bounds or not o.model.declarations[u.name].leeway:
            continue
        usual = said.get(u.name, u.prior)
        off = abs(u.to_coordinate(v) - u.to_coordinate(usual))
        if off > settings.DOUBT.shows * (s / v if u.logarithmic else s):
            found[u.name] = float(v), float(s), usual, u.unit
    return found


def instead_of(candidate: Candidate, o: Outcome) -> str:
    """That one effect explains as much as a small fault, in words."""
    numbers = ', '.join(
        f'{name} = {measured(value, sigma, unit)}'
        for name, (value, sigma, unit) in parameters_of(o, candidate.label).items()
    )
    return (
        f'{candidate.label} ({numbers}) alone would explain as much as this small fault does: '
        'records in other set-ups would tell'
    )
