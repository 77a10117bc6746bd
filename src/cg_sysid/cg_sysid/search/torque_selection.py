"""Which laws the torques of a robot lack: effects taken up while records held out gain by them.

    torque fit of the numbers -> score tests of all effects (torque_screening.py)
      -> torque fits of the best -> that which gains most is taken up, if records held out gain too
      -> friction and rotors at all other joints as well, if they gain by that
      -> again on top of these, until none does
      -> whole Stribeck curves where parts of one were taken up, if they gain by that
      -> again on top of these -> each asked whether the others do without it

A torque fit takes a second where one by simulation takes a minute, and does not mind which
controller kept the robot on its way. So an arm of six joints has an answer in a minute or two,
and a real one may have one at all. It is no diagnosis: smoothed torques know little of delays and
sensors, and what moves by itself, as a rotor behind a spring, is not asked. `diagnose` judges in
simulation what is found here.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import Effect
from cg_dynamics.model import Model
from cg_sysid.identification import torque_error
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.torque_error import TorqueFit
from cg_sysid.identification.unknowns import IdentificationError
from cg_sysid.parallel import CarryOut, one_by_one
from cg_sysid.search import settings
from cg_sysid.search.task import EffectAt, candidates_for
from cg_sysid.search.torque_judging import EVERY_JOINT, MATERIAL, Fitted, Judge, Law
from cg_sysid.search.torque_screening import scores

FITTED = 6  # effects that are fitted in a round, those that the scores promise most of
MOST = 32  # effects that are taken up
EVERY_DRIVE = *EVERY_JOINT, 'rotor_inertia'  # has some of these
CURVE = 'coulomb_friction', 'viscous_friction', 'stribeck_friction'  # of Stribeck, by its parts
RISES = 'quadratic_friction'
LOOK_LIKE_CURVES = 'coulomb_friction', RISES  # where parts of one are asked for alone


@dataclass(frozen=True)
class TorqueSelection:
    """What the torques say of a robot.

    Attributes:
        coordinates: Names of the robot's n coordinates.
        stated: Torque error of records held out over the torque that acted, by the file's numbers,
            shape (n,); NaN where nothing drives.
        identified: The same with the numbers that the torques say.
        extended: The same with the laws.
        laws: Effects that were taken up, in the order in which they were.
        turned_down: Others that were fitted on top of these and are not worth it, the best first.
        model: The model with them, and with the numbers that the torques of all records say.
    """

    coordinates: tuple[str, ...]
    stated: np.ndarray
    identified: np.ndarray
    extended: np.ndarray
    laws: tuple[Law, ...]
    turned_down: tuple[Law, ...]
    model: Model

    def shares(self, law: Law) -> dict[str, float]:
        """Coordinate -> share of its squared torque error that a law takes, if MATERIAL."""
        taken = zip(self.coordinates, law.taken, strict=True)
        return {name: float(share) for name, share in taken if share > MATERIAL}


def select(
    model: Model,
    train: Sequence[DataSet],
    held: Sequence[DataSet],
    names: Sequence[str] | None = None,
    carry_out: CarryOut = one_by_one,
) -> TorqueSelection:
    """Take up effects that the torques of a robot lack.

    Args:
        model: The nominal model, of a robot of a URDF.
        train: Whole records that are fitted.
        held: Whole records that judge.
        names: Effects, or labels of effects, that may be taken up; by default all of the library.
        carry_out: Who fits.

    Raises:
        IdentificationError: if the torques of these records say nothing of this model.
    """
    if not torque_error.can(model):
        raise IdentificationError(
            f'model {model.name!r}: torques are compared for a robot of a URDF with an encoder at '
            'every joint that moves, and without integral_control'
        )
    judge = Judge(train, held)
    search = _Search(judge, names, carry_out)
    plain = torque_error.without_states(model)
    bare = replace(plain, effects=())
    if names is not None and not search.candidates(bare):
        raise IdentificationError(
            f'torques alone cannot tell of {", ".join(names)}: they know little of sensors and '
            'delays, and nothing of pushes and of what moves by itself; use cg diagnose'
        )
    nominal = base = judge.fit(plain, {})
    laws: list[Law] = []
    while True:
        judged = search.on_top(base, laws)
        worth = [(law, there) for law, there in judged if not law.reason]
        if not worth or len(laws) >= MOST:
            curved = search.with_stribeck_curve(base, laws)
            if curved is None:
                break
            laws, base = curved
            continue
        least = worth[0][0].nats - settings.SELECTION.margin
        near = [(law, there) for law, there in worth if law.nats > least]
        # A drift that takes minutes is a constant: of what evidence cannot tell, the simplest.
        best, base = min(near, key=lambda pair: len(pair[0].parameters))
        rivals = tuple(law.label for law, _ in near if law is not best)
        more, base = search.at_other_joints(base)
        laws += [replace(best, rivals=rivals), *more]
    base, laws = search.doubted(base, laws)
    # Who judged has no more say: the numbers are those of all records.
    every = Judge([*train, *held], held)
    final = every.fit(base.model, base.said.values)
    taken_up = {law.label for law in laws}
    laws = [
        replace(
            law, parameters=every.sizes(final, law.label),
            rivals=tuple(label for label in law.rivals if label not in taken_up),
        )
        for law in laws
    ]  # fmt: skip
    stated, identified, extended = (
        _relative(m, held) for m in (plain, nominal.standing, base.standing)
    )
    return TorqueSelection(
        tuple(model.mechanism.coordinates), stated, identified, extended, tuple(laws),
        tuple(law for law, _ in judged if law.reason), final.standing,
    )  # fmt: skip


@dataclass(frozen=True)
class _Search:
    """Effects, sought on one split of the records."""

    judge: Judge
    names: Sequence[str] | None
    carry_out: CarryOut

    def candidates(self, model: Model) -> list[EffectAt]:
        """Effects that may be taken up on top of a model."""
        train, held = self.judge.train, self.judge.held
        setups = [data_set.setup for data_set in (*train, *held)]
        recorded = {name for data_set in train for name in data_set.input_names}
        return [
            candidate
            for candidate in candidates_for(model, setups, self.names, recorded)
            if _told_by_torques(model, candidate)
        ]

    def on_top(self, base: Fitted, laws: Sequence[Law]) -> list[tuple[Law, Fitted]]:
        """Effects on top of a base with these laws, fitted and judged, the best first."""
        title = f'what torques say on top of {len(laws)} laws' if laws else 'what torques say'
        found = scores(
            base.model, self.judge.train, self.candidates(base.model), {}, self.carry_out,
            numbers=base.said.values, followed=_followed, title=title,
        )  # fmt: skip
        pairs = list(found.extended.values()) if found else []
        if not pairs:
            return []
        # Each would have its own, and of two that leave the same one would be worth more.
        first = min(pairs, key=lambda pair: pair[1].deviance)
        independent = self.judge.with_errors(*first).independent()
        judged = self.carry_out(
            _judged, [(self.judge, base, *pair, independent) for pair in pairs], title
        )
        return sorted(judged, key=lambda pair: -pair[0].nats)

    def at_other_joints(self, base: Fitted) -> tuple[list[Law], Fitted]:
        """Friction or a rotor, the last effect of a base, at all other joints, if they gain by it.

        An arm of which nobody knows the friction lacks some at every joint. What all the others
        lack hides what one does, and each alone seems to gain little.
        """
        last = base.model.effects[-1]
        others = [
            (name, at) for name, at in self.candidates(base.model)
            if name == last.name and name in EVERY_DRIVE
        ]  # fmt: skip
        if not others:
            return [], base
        model, values = base.model, base.standing.values_of(last)
        for name, at in others:
            # A heavy joint may have what is out of range at a light one.
            own = {
                p.name: min(max(values[p.name], p.lower), p.upper)
                for p in LIBRARY[name](model.mechanism, at).parameters
            }
            model = model.with_effect(name, at, **own)
        there = self.judge.fit(model, base.said.values)
        labels = [effect.label for effect in model.effects[-len(others) :]]
        independent = there.independent()
        laws = [self.judge.law(base, there, label, independent) for label in labels]
        count = sum(len(law.parameters) for law in laws)
        gain = self.judge.gain(base, there, count, independent)
        if gain.nats < settings.SELECTION.earned or not gain.significant:
            return [], base
        return laws, there

    def with_stribeck_curve(
        self, base: Fitted, laws: Sequence[Law]
    ) -> tuple[list[Law], Fitted] | None:
        """A whole Stribeck curve at a joint, in place of what was taken up part by part.

        Dry friction that fades while viscous friction grows looks like dry friction that stays, or
        that rises by the square, and on top of either nothing fades that could be seen.

        Returns:
            The laws and the base with one curve more; None where none gains.
        """
        taken_up = [base.model.effect(law.label) for law in laws]
        for at in dict.fromkeys(e.at for e in taken_up if e.name in LOOK_LIKE_CURVES):
            curve = self._curve(base, laws, at)
            if curve is not None:
                return curve
        return None

    def _curve(
        self, base: Fitted, laws: Sequence[Law], at: str | None
    ) -> tuple[list[Law], Fitted] | None:
        """The same at one joint."""
        missing = [name for name in CURVE if not _has(base.model, name, at)]
        risen = [law for law in laws if _is(base.model.effect(law.label), RISES, at)]
        asked_for = self.candidates(base.model)
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
            self.judge.train,
            [(CURVE[-1], at)],
            {},
            self.carry_out,
            numbers=base.said.values,
            followed=_promising,
            title=f'a Stribeck curve at {at}',
        )
        if found is None or not found.extended:
            return None
        ((extended, said),) = found.extended.values()
        there = self.judge.with_errors(extended, said)
        independent = there.independent()
        more = [
            self.judge.law(base, there, effect.label, independent)
            for effect in extended.effects if effect.at == at and effect.name in missing
        ]  # fmt: skip
        count = sum(len(law.parameters) for law in more)
        count -= sum(len(law.parameters) for law in risen)
        gain = self.judge.gain(base, there, count, independent)
        if gain.nats < settings.SELECTION.earned or not gain.significant:
            return None
        gone = {law.label for law in risen}
        return [*(law for law in laws if law.label not in gone), *more], there

    def doubted(self, base: Fitted, laws: Sequence[Law]) -> tuple[Fitted, list[Law]]:
        """Without those laws that the others do without; what each gains beside the others."""
        laws = list(laws)
        while len(laws) > 1:
            models = [base.model.without_effect(law.label) for law in laws]
            title = 'each law beside the others'
            said = self.carry_out(
                torque_error.fit_by_torque,
                [(model, self.judge.train, None, None, base.said.values) for model in models],
                title,
            )
            lean = [self.judge.with_errors(m, fit) for m, fit in zip(models, said, strict=True)]
            independent = base.independent()
            judged = self.carry_out(
                Judge.law,
                [(self.judge, fit, base, law.label, independent)
                 for fit, law in zip(lean, laws, strict=True)],
                title,
            )  # fmt: skip
            idle = [k for k, law in enumerate(judged) if law.reason]
            if not idle:
                return base, [
                    replace(again, rivals=law.rivals)
                    for again, law in zip(judged, laws, strict=True)
                ]
            least = min(idle, key=lambda k: lean[k].said.deviance)
            base = lean[least]
            del laws[least]
        return base, laws


def _judged(
    judge: Judge,
    base: Fitted,
    model: Model,
    said: TorqueFit,
    independent: tuple[np.ndarray, np.ndarray],
) -> tuple[Law, Fitted]:
    """What the last effect of a model gains on top of a base."""
    there = judge.with_errors(model, said)
    return judge.law(base, there, model.effects[-1].label, independent), there


def _is(effect: Effect, name: str, at: str | None) -> bool:
    return (effect.name, effect.at) == (name, at)


def _has(model: Model, name: str, at: str | None) -> bool:
    return any(_is(effect, name, at) for effect in model.effects)


def _followed(gains: Mapping[EffectAt, float]) -> list[EffectAt]:
    """Those that are fitted: the best by score, and the simpler laws that these turn into."""
    best = sorted(gains, key=lambda c: -gains[c])[:FITTED]
    # What takes more numbers than the machine has gains as much, and its fit may end elsewhere.
    simpler = [(name, at) for kind, at in best for name in LIBRARY[kind].contains]
    return [c for c in dict.fromkeys([*best, *simpler]) if c in gains]


def _promising(gains: Mapping[EffectAt, float]) -> list[EffectAt]:
    return [candidate for candidate, nats in gains.items() if nats > settings.SELECTION.earned]


def _told_by_torques(model: Model, candidate: EffectAt) -> bool:
    """Whether smoothed torques can tell of an effect: it has no states, is no sensor, no event."""
    name, at = candidate
    effect = LIBRARY[name](model.mechanism, at)
    return not (
        effect.states or effect.place in ('sensor', 'timing')
        or any(p.each for p in effect.parameters)
    )  # fmt: skip


def _relative(model: Model, data_sets: Sequence[DataSet]) -> np.ndarray:
    """Torque error of a model as it is over the torque that acted, shape (n,)."""
    found = torque_error.fit_by_torque(model, data_sets, only=())
    assert found is not None  # its errors are known
    return found.relative
