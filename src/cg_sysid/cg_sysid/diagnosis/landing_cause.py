"""What the landings add to a diagnosis: causes, numbers, words."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cg_dynamics.model import Model
from cg_sysid.diagnosis.result import Cause, Diagnosis, Verdict
from cg_sysid.diagnosis.summary import described
from cg_sysid.identification.gain import Gain
from cg_sysid.landings.result import Landings
from cg_sysid.landings.selection import Run, judge_landings
from cg_sysid.stances.phases import Landing

UNEXPLAINED = 3.0  # noise standard deviations that landings may leave before it is worth a word


def with_landings(
    answer: Diagnosis,
    landings: Sequence[Landing],
    run: Run,
    effects: Sequence[str] | None = None,
) -> Diagnosis:
    """The diagnosis of the phases, and what the landings between them say beside it.

    Args:
        answer: The diagnosis of the phases.
        landings: The landings; without any, the answer is as it was.
        run: Runs a function on tuples of arguments.
        effects: Names of the effects to try; by default all.
    """
    if not landings:
        return answer
    sigma = answer.held[0].sigma
    found = judge_landings(answer.extended.train.model, landings, sigma, run, effects)
    if found is None:
        few = f'{len(landings)} touchdowns: too few landings to judge them'
        return replace(answer, findings=(*answer.findings, few))
    causes = (*answer.causes, *_causes(found))
    verdict = answer.verdict
    if found.accepted:
        rivals = any(cause.rivals for cause in causes)
        verdict = Verdict.AMBIGUOUS if rivals else Verdict.EXPLAINED
    extended = answer.extended
    model = _with_law(extended.train.model, found)
    return replace(
        answer,
        verdict=verdict,
        summary=f'{answer.summary} {words(answer, found)}',
        causes=tuple(sorted(causes, key=lambda cause: -cause.evidence)),
        extended=replace(extended, model=model, train=replace(extended.train, model=model)),
        model=_with_law(answer.model, found),
        landings=found,
    )


def _causes(found: Landings) -> list[Cause]:
    best = found.best
    if best is None:
        return []
    causes = []
    for name in best.effects:
        others = [t for t in found.tried if t.effects == tuple(set(best.effects) - {name})]
        less = others[0].evidence if others else 0.0
        causes.append(
            Cause(name, best.parameters[name], best.evidence - max(less, 0.0),
                  rivals=found.rivals)
        )  # fmt: skip
    return causes


def _with_law(model: Model, found: Landings) -> Model:
    """The model with the law that was accepted, its numbers marked as identified."""
    best = found.best
    if best is None:
        return model
    for name in best.effects:
        own = best.parameters[name]
        model = model.with_effect(name, None, **{p: value for p, (value, _, _) in own.items()})
        quantities = dict(model.quantities)
        for p, (_, sigma, _) in own.items():
            full = f'{name}.{p}'
            quantities[full] = replace(
                quantities[full], tolerance=float(sigma), source='identified'
            )
        model = replace(model, quantities=quantities)
    return model


def landing_gains(answer: Diagnosis, found: Landings) -> tuple[Gain, ...]:
    """Error of each output on the landings held out, before and after."""
    body = answer.nominal.mechanism
    return tuple(
        Gain(channel, unit, float(s * np.sqrt(b)), float(s * np.sqrt(a)), float(s))
        for channel, unit, s, b, a in zip(
            body.outputs, body.output_units, answer.held[0].sigma, found.before, found.after,
            strict=True,
        )
        if b > 0
    )  # fmt: skip


def words(answer: Diagnosis, found: Landings) -> str:
    """One or two sentences on the landings."""
    stated = 'plastic impacts' if found.stated.plastic else "the model's law of contact"
    biggest = max(landing_gains(answer, found), key=lambda g: g.before / g.noise)
    if found.accepted:
        named = ' and '.join(described(cause) for cause in _causes(found))
        return (
            f'Its landings are not {stated}: the simulation lacks {named}; with it the held-out '
            f'error of {biggest.channel} after touchdowns falls from {biggest.before:.3g} to '
            f'{biggest.after:.3g} {biggest.unit} (noise {biggest.noise:.2g}).'
        )
    left = biggest.before / biggest.noise
    if left > UNEXPLAINED:
        return (
            f'Its {found.judged} landings are followed by an error of {biggest.channel} of '
            f'{left:.1f} noise standard deviations, which neither a rebound nor a slide explains.'
        )
    return f'Its {found.judged} landings are {stated}.'
