"""Other laws in the place of those that were taken up one by one, where together they do better.

A search that takes up one law after the other goes wrong where two laws hide each other, and where
a law seems to be what it is only as long as others are missing (torque_selection.py).
"""

from collections.abc import Mapping, Sequence

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import Effect
from cg_dynamics.model import Model
from cg_sysid.identification import torque_error
from cg_sysid.search import settings
from cg_sysid.search.task import EffectAt
from cg_sysid.search.torque_judging import MATERIAL, Fitted, Law, at_every_joint
from cg_sysid.search.torque_screening import scores
from cg_sysid.search.torque_search import TorqueSearch, best_of

CURVE = 'coulomb_friction', 'viscous_friction', 'stribeck_friction'  # of Stribeck, by its parts
RISES = 'quadratic_friction'
LOOK_LIKE_CURVES = 'coulomb_friction', RISES  # where parts of one are asked for alone
LIKE = {
    'coulomb_friction': (('viscous_friction',),),
    'viscous_friction': (('coulomb_friction',),),
    RISES: (('viscous_friction',), ('coulomb_friction',)),
    'friction_drift': (('coulomb_friction',),),  # which one that takes minutes is
    # One way there would be none: it is as much both ways, beside a constant.
    'asymmetric_friction': (('coulomb_friction', 'torque_bias'),),
}  # friction -> what may be meant by it at the same joint


def with_stribeck_curve(
    search: TorqueSearch, base: Fitted, laws: Sequence[Law]
) -> tuple[list[Law], Fitted] | None:
    """A whole Stribeck curve at a joint, in place of what was taken up part by part.

    Dry friction that fades while viscous friction grows looks like dry friction that stays, or
    that rises by the square, and on top of either nothing fades that could be seen.

    Returns:
        The laws and the base with one curve more; None where none gains.
    """
    taken_up = [base.model.effect(law.label) for law in laws]
    for at in dict.fromkeys(e.at for e in taken_up if e.name in LOOK_LIKE_CURVES):
        curve = _curve(search, base, laws, at)
        if curve is not None:
            return curve
    return None


def _curve(
    search: TorqueSearch, base: Fitted, laws: Sequence[Law], at: str | None
) -> tuple[list[Law], Fitted] | None:
    """The same at one joint."""
    missing = [name for name in CURVE if not _has(base.model, name, at)]
    risen = [law for law in laws if _is(base.model.effect(law.label), RISES, at)]
    asked_for = search.candidates(base.model)
    if (
        CURVE[-1] not in missing
        or (len(missing) == 1 and not risen)  # that was asked for on top of the others
        or not all((name, at) in asked_for for name in missing)
    ):
        return None
    model = base.model
    for law in risen:
        model = model.without_effect(law.label)
    for name in missing[:-1]:
        model = model.with_effect(name, at)
    found = scores(
        model,
        search.judge.train,
        [(CURVE[-1], at)],
        {},
        search.carry_out,
        numbers=base.said.values,
        followed=_promising,
        title=f'a Stribeck curve at {at}',
    )
    if found is None or not found.extended:
        return None
    ((extended, said),) = found.extended.values()
    there = search.judge.with_errors(extended, said)
    independent = there.independent()
    more = [
        search.judge.law(base, there, effect.label, independent)
        for effect in extended.effects if effect.at == at and effect.name in missing
    ]  # fmt: skip
    count = sum(len(law.parameters) for law in more)
    count -= sum(len(law.parameters) for law in risen)
    gain = search.judge.gain(base, there, count, independent)
    if gain.nats < settings.SELECTION.earned or not gain.significant:
        return None
    gone = {law.label for law in risen}
    return [*(law for law in laws if law.label not in gone), *more], there


def with_two(
    search: TorqueSearch, base: Fitted, laws: Sequence[Law], judged: Sequence[tuple[Law, Fitted]]
) -> tuple[list[Law], Fitted] | None:
    """Two effects at once, where the best one is not worth it alone.

    Where two are missing, what either leaves is all of one piece, as the constant torque of a
    slope is. So few of its torques are independent that neither seems to say anything.

    Args:
        search: Who fits.
        base: Without them.
        laws: Those of the base.
        judged: Effects on top of the base, none of them worth it, the best first.

    Returns:
        The laws and the base with two more; None where not each gains beside the other.
    """
    able = [pair for pair in judged if pair[0].nats > 0 and np.nanmax(pair[0].taken) > MATERIAL]
    if not able:
        return None
    first, there = able[0]
    found = best_of(search.on_top(there, [*laws, first]))
    if found is None:
        return None
    second, both = found
    alone = search.judge.fit(both.model.without_effect(first.label), both.said.values)
    again = search.judge.law(alone, both, first.label, both.independent())
    return None if again.reason else ([*laws, again, second], both)


def with_likes(
    search: TorqueSearch, base: Fitted, laws: Sequence[Law]
) -> tuple[list[Law], Fitted] | None:
    """What is like a friction that was taken up, in its place, if that does better.

    What every joint lacks was taken up at all of them at once, and what came later may have
    hidden the law of one. What every joint has takes the place of what few have where the
    torques cannot tell. What is simpler takes the place of a law whose further numbers earn
    nothing.

    Returns:
        The laws and the base with another law; None where none does better.
    """
    trials = _alike(search, base, laws)
    if not trials:
        return None
    said = search.carry_out(
        torque_error.fit_by_torque,
        [(model, search.judge.train, None, None, base.said.values) for _, model, _ in trials],
        'laws that are like those',
    )
    best, most = None, 0.0
    for (law, model, count), fit in zip(trials, said, strict=True):
        there = search.judge.with_errors(model, fit)
        independent = min((base, there), key=lambda f: f.said.deviance).independent()
        nats = _advantage(search, base, there, law, independent)
        if nats > most:
            more = [
                search.judge.law(base, there, effect.label, independent)
                for effect in model.effects[-count:]
            ]
            rest = [other for other in laws if other is not law]
            best, most = ([*rest, *more], there), nats
    return best


def _advantage(
    search: TorqueSearch,
    base: Fitted,
    there: Fitted,
    law: Law,
    independent: tuple[np.ndarray, np.ndarray],
) -> float:
    """Nats that speak for what is like a law of the base; 0 where the law is to stay.

    What is simpler loses evidence, however little. It has the margin by which laws are told apart
    where the law's further numbers do not earn as much as any law has to.
    """
    rare = not at_every_joint(base.model.effect(law.label))
    spared = len(base.said.values) - len(there.said.values)
    if rare and spared > 0:
        surplus = search.judge.gain(there, base, spared, independent)
        earned = surplus.nats >= settings.SELECTION.earned and surplus.significant
        return 0.0 if earned else settings.SELECTION.margin
    # As many numbers, or what every joint has besides, which needs no evidence.
    gain = search.judge.gain(base, there, 0, independent)
    lost = gain.significance <= -settings.SELECTION.significant
    return 0.0 if lost else gain.nats + (settings.SELECTION.margin if rare else 0.0)


def _alike(
    search: TorqueSearch, base: Fitted, laws: Sequence[Law]
) -> list[tuple[Law, Model, int]]:
    """Laws, models with what is like each in its place, and of how many effects that is."""
    places = {}
    for candidate in search.candidates(base.model):
        effect = LIBRARY[candidate[0]](base.model.mechanism, candidate[1])
        places[effect.name, effect.site] = candidate
    found = []
    for law in laws:
        effect = base.model.effect(law.label)
        for names in LIKE.get(effect.name, ()):
            wanted = [(name, effect.site) for name in names]
            if not places.keys() >= set(wanted):
                continue
            model = base.model.without_effect(law.label)
            for place in wanted:
                model = model.with_effect(*places[place])
            found.append((law, model, len(names)))
    return found


def _is(effect: Effect, name: str, at: str | None) -> bool:
    return (effect.name, effect.at) == (name, at)


def _has(model: Model, name: str, at: str | None) -> bool:
    return any(_is(effect, name, at) for effect in model.effects)


def _promising(gains: Mapping[EffectAt, float]) -> list[EffectAt]:
    return [candidate for candidate, nats in gains.items() if nats > settings.SELECTION.earned]
