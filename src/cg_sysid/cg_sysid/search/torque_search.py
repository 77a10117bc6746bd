"""Fits and judgements that a search for laws of torque is made of (torque_selection.py)."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid.identification import torque_error
from cg_sysid.identification.torque_error import TorqueFit
from cg_sysid.parallel import CarryOut
from cg_sysid.search import settings
from cg_sysid.search.task import EffectAt, candidates_for
from cg_sysid.search.torque_judging import EVERY_JOINT, Fitted, Judge, Law, at_every_joint
from cg_sysid.search.torque_screening import scores

FITTED = 6  # effects that are fitted in a round, those that the scores promise most of
EVERY_DRIVE = *EVERY_JOINT, 'rotor_inertia'  # has some of these


@dataclass(frozen=True)
class TorqueSearch:
    """Effects, sought on one split of the records.

    Attributes:
        judge: Of what is fitted to some records by others.
        names: Effects, or labels of effects, that may be taken up; None for the whole library.
        carry_out: Who fits.
    """

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


def best_of(judged: Sequence[tuple[Law, Fitted]]) -> tuple[Law, Fitted] | None:
    """Who is taken up of effects that were judged on top of one base, the best first.

    Of what evidence cannot tell that is the simplest, and of these what every joint has: a drift
    that takes minutes is a constant. The others are its rivals.
    """
    worth = [pair for pair in judged if not pair[0].reason]
    if not worth:
        return None
    least = worth[0][0].nats - settings.SELECTION.margin
    near = [pair for pair in worth if pair[0].nats > least]
    best, there = min(near, key=_rank)
    return replace(best, rivals=tuple(law.label for law, _ in near if law is not best)), there


def _rank(found: tuple[Law, Fitted]) -> tuple[int, bool]:
    law, there = found
    return len(law.parameters), not at_every_joint(there.model.effect(law.label))


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


def _followed(gains: Mapping[EffectAt, float]) -> list[EffectAt]:
    """Those that are fitted: the best by score, and the simpler laws that these turn into."""
    best = sorted(gains, key=lambda c: -gains[c])[:FITTED]
    # What takes more numbers than the machine has gains as much, and its fit may end elsewhere.
    simpler = [(name, at) for kind, at in best for name in LIBRARY[kind].contains]
    return [c for c in dict.fromkeys([*best, *simpler]) if c in gains]


def _told_by_torques(model: Model, candidate: EffectAt) -> bool:
    """Whether smoothed torques can tell of an effect: it has no states, is no sensor, no event."""
    name, at = candidate
    effect = LIBRARY[name](model.mechanism, at)
    return not (
        effect.states or effect.place in ('sensor', 'timing')
        or any(p.each for p in effect.parameters)
    )  # fmt: skip
