"""The answer of a diagnosis in a few sentences."""

from collections.abc import Sequence

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_sysid.diagnosis.between_recordings import Wandering
from cg_sysid.diagnosis.result import Cause, Verdict
from cg_sysid.identification.gain import NO_GAIN, Gain
from cg_sysid.learned.unmodelled import NOTHING, Unmodelled
from cg_sysid.search import settings
from cg_sysid.search.ranking import effect_name
from cg_sysid.text import listed, measured, number, sentence

INTERVAL = 1.96  # standard deviations on either side of a 95 % interval
MOST_TOLD = 3  # events of single records in the summary
CERTAIN = 30.0  # nats: odds of 1e13 to 1, beyond what a noise floor a little off could feign


def summary_of(
    verdict: Verdict,
    causes: Sequence[Cause],
    gains: Sequence[Gain],
    left: dict[str, float],
    prior_conflicts: Sequence[str] = (),
    unmodelled: Unmodelled | None = None,
    tried: Sequence[str] | None = None,
    wandering: Wandering | None = None,
    explained: float = 1.0,
    late: str = '',
) -> str:
    """The answer in a few sentences.

    Args:
        verdict: The verdict.
        causes: Named causes.
        gains: Errors before and after.
        left: Outputs with an error above the noise.
        prior_conflicts: Numbers that the file does not believe.
        unmodelled: What is left, as a learned term.
        tried: Effects that were tried; None for the whole library.
        wandering: A number that differs from recording to recording.
        explained: Share of the squared error above the noise that the causes take.
        late: What errors of timing make of an error that stays unexplained, as a sentence.
    """
    if verdict == Verdict.CONSISTENT:
        return _consistent(gains, prior_conflicts)
    biggest = max(gains, key=lambda g: g.before / g.noise)
    if verdict == Verdict.UNEXPLAINED:
        known = ' '.join(seen.text for seen in (unmodelled, wandering) if seen)
        return _unexplained(causes, biggest, tried, explained, known, late)
    if verdict == Verdict.UNFINISHED:
        return _unfinished(causes, biggest, explained)
    text = _lacks(causes, biggest, prior_conflicts) + _what_need_not_be(causes) + _advice(causes)
    if left:
        text += f' An error above the noise remains in {", ".join(left)}.'
        text += ''.join(f' {seen.text}' for seen in (unmodelled, wandering) if seen)
    return text


def _consistent(gains: Sequence[Gain], prior_conflicts: Sequence[str]) -> str:
    text = 'The model explains the records down to the noise of the sensors'
    if max(g.before / g.after for g in gains) > NO_GAIN:
        text += (
            ', with what sound robots have besides: small faults and laws of another shape, '
            'which the findings list and model.yaml holds'
        )
    if prior_conflicts:
        text += f', but with {", ".join(prior_conflicts)} far from what its file believes'
    return f'{text}.'


def _unexplained(
    causes: Sequence[Cause],
    biggest: Gain,
    tried: Sequence[str] | None,
    explained: float,
    known: str,
    late: str,
) -> str:
    whose = 'of the library' if tried is None else f'that was tried ({", ".join(tried)})'
    text = (
        f'Something is missing that no effect {whose} explains: {biggest.channel} is '
        f'simulated with an error of {biggest.after:.3g} {biggest.unit}, its noise is '
        f'{biggest.noise:.2g}. {known or late or NOTHING}'
    )
    if causes:
        text += (
            f' No more than {100 * explained:.0f} % of the squared error on held-out records '
            f'goes with {listed([described(c) for c in causes])}, which may only stand in '
            'for what is missing.'
        )
    return f'{text} {late}' if known and late else text


def _unfinished(causes: Sequence[Cause], biggest: Gain, explained: float) -> str:
    text = (
        f'{biggest.channel} is simulated with an error of {biggest.after:.3g} '
        f'{biggest.unit}, its noise is {biggest.noise:.2g}, and no cause of most of it was '
        'found so far.'
    )
    named = ', '.join(described(c) for c in causes)
    return f'{text} {named} takes {100 * explained:.0f} % of it.' if causes else text


def _lacks(causes: Sequence[Cause], biggest: Gain, prior_conflicts: Sequence[str]) -> str:
    """What is wrong, how sure that is, and how much better the model is with it."""
    named = ', '.join(described(c) for c in causes)
    if biggest.before < NO_GAIN * biggest.after and prior_conflicts:
        return (
            f'The simulation lacks {named}: without it the model follows the records only with '
            f'{", ".join(prior_conflicts)} far from what its file believes.'
        )
    return (
        f'The simulation lacks {named}, {_sureness(causes)}; with it the held-out error of '
        f'{biggest.channel} falls from {biggest.before:.3g} to {biggest.after:.3g} '
        f'{biggest.unit} (noise {biggest.noise:.2g}).'
    )


def _advice(causes: Sequence[Cause]) -> str:
    """The experiment that would tell rivals apart, if there is one."""
    best = next((c.proposals[0] for c in causes if c.proposals), None)
    if best is None:
        return ''
    weakest = ' from '.join(best.weakest)
    if best.evidence > settings.SELECTION.margin:
        return (
            f' To tell {weakest}, run {best.experiment} (about {best.evidence:.0f} nats expected).'
        )
    return (
        f' No experiment that can be launched would tell {weakest}: for '
        'what these recordings show they are one.'
    )


def _what_need_not_be(causes: Sequence[Cause]) -> str:
    """That causes may act like what they are named after, and be something else."""
    vague = [f'{c.label}.{name}' for c in causes for name in c.undetermined]
    ended = [
        f'{c.label}.{name}' for c in causes for name in c.at_edge if name not in c.undetermined
    ]
    reasons = []
    if vague:
        reasons.append(f'these records do not determine {listed(vague)}')
    if ended:
        reasons.append(f'the fit drove {listed(ended)} to the edge of what was tried')
    if not reasons:
        return ''
    return (
        f' {sentence("; ".join(reasons))}: what acts like this need not be what it is named after.'
    )


def described(cause: Cause) -> str:
    """A cause with its numbers and rivals, in words."""
    own = _of_single_records(cause)
    shared = [name for name in cause.parameters if not own or name not in own]
    numbers = ', '.join(f'{name} {_told(cause, name)}' for name in shared)
    happened = _happened(cause, own) if own else []
    inside = '; '.join(part for part in (*happened, numbers) if part)
    size = f' ({inside})' if inside else ''  # none of one that acts otherwise in each recording
    rivals = f' or {" or ".join(cause.rivals)}' if cause.rivals else ''
    replaced = f', which replaces {listed(list(cause.replaces))}' if cause.replaces else ''
    return f'{cause.label}{size}{rivals}{replaced}'


def _of_single_records(cause: Cause) -> tuple[str, ...]:
    """Names of what happened in single records, as a push; none where nothing surely did."""
    kind = LIBRARY.get(effect_name(cause.label))
    if kind is None or not cause.events or all(p.each != 'record' for p in kind.parameters):
        return ()
    return tuple(next(iter(cause.events.values())))


def _happened(cause: Cause, names: Sequence[str]) -> list[str]:
    """Each event with its record, the largest first; how many more there are."""
    ordered = sorted(cause.events, key=lambda record: -abs(cause.events[record][names[0]][0]))
    told = [
        f'in {record} '
        + ', '.join(f'{name} = {measured(*cause.events[record][name])}' for name in names)
        for record in ordered[:MOST_TOLD]
    ]
    more = len(ordered) - len(told)
    return [*told, *([f'and {more} more'] if more else [])]


def _sureness(causes: Sequence[Cause]) -> str:
    """How sure the least sure of the causes is, in words and in nats."""
    least = min(cause.evidence for cause in causes)
    if not np.isfinite(least):
        return 'very likely, as the model without it does not follow the records at all'
    sure = 'very likely' if least >= CERTAIN else 'likely'
    either = 'one or the other ' if any(cause.rivals for cause in causes) else ''
    return f'{either}{sure} ({number(least)} nats of evidence)'


def _told(cause: Cause, name: str) -> str:
    """The value of a parameter, or what it ranges over where records have their own."""
    value, sigma, unit = cause.parameters[name]
    if not is_determined(cause.label, name, sigma):
        return 'not determined'
    own = {row[name][0] for row in cause.events.values() if name in row}
    if len(own) > 1:
        tail = '' if unit == '1' else f' {unit}'
        return f'from {number(min(own))} to {number(max(own))}{tail}'
    return f'= {measured(value, sigma, unit)}'


def is_determined(label: str, name: str, sigma: float) -> bool:
    """Whether the records say anything of a parameter: not if its interval has no end.

    Of a place on a body the 95 % interval also has to tell where it is: it does if it is no wider
    than what lies between two of the places from which it is sought.

    Args:
        label: Of the effect.
        name: Of its parameter; all that are no places, sizes among them, count as determined.
        sigma: Standard deviation in its unit.
    """
    if not np.isfinite(sigma):
        return False
    kind = LIBRARY.get(effect_name(label))
    declared = {p.name: p for p in kind.parameters}.get(name) if kind else None
    if declared is None or declared.neutral is not None or declared.logarithmic:
        return True
    if declared.unit != 'm' or len(declared.starts) < 2:
        return True
    return 2 * INTERVAL * sigma <= float(np.diff(sorted(declared.starts)).min())
