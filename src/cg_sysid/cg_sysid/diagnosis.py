"""The answer of a diagnosis as data, and in words.

What was found, what was tried, and the gain; how it is found is in diagnose.py, how it is written
to disk in diagnosis_file.py.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid.advice import Proposal
from cg_sysid.experiments import Experiment
from cg_sysid.gain import NO_GAIN, Gain
from cg_sysid.identify import Fit
from cg_sysid.landed import Landings
from cg_sysid.measured_start import MeasuredStart
from cg_sysid.record import Record
from cg_sysid.so_far import Unfinished
from cg_sysid.text import listed, measured, number
from cg_sysid.trial import Trial
from cg_sysid.unmodelled import NOTHING, Unmodelled
from cg_sysid.wandering import Wandering

MOST_ROUNDS = 4
INTERVAL = 1.96  # standard deviations on either side of a 95 % interval
MOST_TOLD = 3  # events of single records in the summary
CERTAIN = 30.0  # nats: odds of 1e13 to 1, beyond what a noise floor a little off could feign
MARGIN = 6.0  # nats: rivals closer than this are not told apart (odds of 400 to 1)


@dataclass(frozen=True)
class Candidate:
    """One effect tried on top of a base model.

    Attributes:
        label: Effect label.
        model: Base model plus the effect, identified on the training records.
        train: Fit on the training records.
        held: Score on the held-out records.
        evidence: In nats against the base model: positive speaks for the effect.
        held_gain: Fall of the held-out squared error, relative.
        significance: The same in standard errors, by the ranks of blocks of time.
        explained: RMS error explained on held-out records, in noise standard deviations, of the
            output where it is largest.
        parameters: Own parameters: name -> (value, standard deviation, unit).
        reason: Why it was not accepted; empty if it could be.
    """

    label: str
    model: Model
    train: Fit
    held: Fit
    evidence: float
    held_gain: float
    significance: float
    explained: float
    parameters: dict[str, tuple[float, float, str]]
    reason: str = ''


@dataclass(frozen=True)
class Round:
    """All candidates tried on top of one base model, best first, and what was made of them.

    Attributes:
        base: Title of that model.
        candidates: Those fitted to whole records, judged.
        accepted: Label of the one that was taken up; empty if none.
        independent: Independent samples behind the evidence.
        aside: Labels of those that the first seconds of the records ruled out.
    """

    base: str
    candidates: tuple[Candidate, ...]
    accepted: str
    independent: float
    aside: tuple[str, ...] = ()


@dataclass(frozen=True)
class Cause:
    """A named cause: an accepted effect and what these data cannot rule out beside it.

    Attributes:
        label: Label of the effect.
        parameters: Own parameters: name -> (value, standard deviation, unit).
        evidence: In nats against the model without it.
        rivals: Other effects that explain the records as well.
        places: Labels of the same effect at other places that explain the records as well.
        proposals: Experiments that would tell it from its rivals, best first.
        undetermined: Parameters of which the records do not even tell the order.
        replaces: Labels of simpler effects of the nominal model that it makes idle.
        events: What happened in single records: record -> parameter -> (value, standard
            deviation, unit).
    """

    label: str
    parameters: dict[str, tuple[float, float, str]]
    evidence: float
    rivals: tuple[str, ...] = ()
    places: tuple[str, ...] = ()
    events: Mapping[str, Mapping[str, tuple[float, float, str]]] = field(default_factory=dict)
    proposals: tuple[Proposal, ...] = ()
    undetermined: tuple[str, ...] = ()
    replaces: tuple[str, ...] = ()


@dataclass(frozen=True)
class Diagnosis:
    """The answer.

    Attributes:
        verdict: consistent, explained, ambiguous, unexplained, unusable, or unfinished where the
            search was broken off before it found what explains most of the error.
        summary: One sentence for people.
        causes: Named causes, strongest first; those of `unexplained` leave most of the error.
        gains: Simulation error before and after on held-out records.
        nominal: The model as it was given.
        baseline: The same, its parameters identified on the training records.
        extended: The model with the causes in it, identified on the training records.
        rounds: What was tried, in order.
        train: Trials used for fitting.
        held: Trials held out.
        remaining: chi2/N of each output that the extended model leaves on held-out records.
        findings: What a person should know: warnings of the fits, lumps out of tolerance.
        unmodelled: What the extended model leaves above the noise, as a learned term; None if it
            leaves nothing or no such term is significant.
        landings: What the landings of a walking robot say; None where there are too few.
        wandering: A number that differs from recording to recording, where an error is left and
            one explains most of it.
        late: What errors of timing make of an error that stays unexplained, as a sentence; empty
            where there are none.
        unfinished: What an early end left undone; None for a whole search.
        measured_start: The gain where held-out records start at measured angles; None where no
            cause is named, or their starts carry nowhere.
    """

    verdict: str
    summary: str
    causes: tuple[Cause, ...]
    gains: tuple[Gain, ...]
    nominal: Model
    baseline: Candidate
    extended: Candidate
    rounds: tuple[Round, ...]
    train: tuple[Trial, ...]
    held: tuple[Trial, ...]
    remaining: dict[str, float]
    findings: tuple[str, ...] = ()
    unmodelled: Unmodelled | None = None
    landings: Landings | None = None
    wandering: Wandering | None = None
    late: str = ''
    unfinished: Unfinished | None = None
    measured_start: MeasuredStart | None = None


@dataclass(frozen=True)
class Options:
    """How a diagnosis is done.

    Attributes:
        effects: Labels or names to try; by default the whole library.
        rounds: Most effects to add.
        workers: Local processes.
        held: Names of the records to hold out; by default every second one of each set-up.
        experiments: What can be launched next, where these records do not decide.
        wholes: Recordings that were cut into windows and can be followed whole: where all their
            windows are held out, they judge whole.
        kept: Folder where fits of local processes are kept, so that a search that was broken off
            goes on from them; None keeps none.
    """

    effects: tuple[str, ...] | None = None
    rounds: int = MOST_ROUNDS
    workers: int | None = None
    held: tuple[str, ...] | None = None
    experiments: tuple[Experiment, ...] = ()
    kept: Path | None = None
    wholes: tuple[Record, ...] = ()


def effect_name(label: str) -> str:
    """Standard name of an effect, its place left out."""
    return label.partition('@')[0]


def contains(label: str, other: str) -> bool:
    """Whether an effect turns into a simpler one, at the same place, at a limit of its own."""
    (name, _, at), (simpler, _, there) = label.partition('@'), other.partition('@')
    return simpler in LIBRARY[name].contains and not (at and there and at != there)


def gains_of(
    model: Model, held: Sequence[Trial], before: Fit, after: Fit
) -> tuple[Gain, ...]:
    """Error of each output before and after on the held-out trials."""
    sigma = held[0].sigma
    return tuple(
        Gain(channel, unit, float(s * np.sqrt(b)), float(s * np.sqrt(a)), float(s))
        for channel, unit, s, b, a, n in zip(
            model.mechanism.outputs,
            model.mechanism.output_units,
            sigma,
            per_output(before),
            per_output(after),
            before.count.sum(axis=0),
            strict=True,
        )
        if n
    )


def summary_of(
    verdict: str,
    causes: Sequence[Cause],
    gains: Sequence[Gain],
    left: dict[str, float],
    strained: Sequence[str] = (),
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
        strained: Numbers that the file does not believe.
        unmodelled: What is left, as a learned term.
        tried: Effects that were tried; None for the whole library.
        wandering: A number that differs from recording to recording.
        explained: Share of the squared error above the noise that the causes take.
        late: What errors of timing make of an error that stays unexplained, as a sentence.
    """
    if verdict == 'consistent':
        text = 'The model explains the records down to the noise of the sensors'
        if max(g.before / g.after for g in gains) > NO_GAIN:
            text += (
                ', with what sound robots have besides: small faults and laws of another shape, '
                'which the findings list and model.yaml holds'
            )
        if strained:
            text += f', but with {", ".join(strained)} far from what its file believes'
        return f'{text}.'
    biggest = max(gains, key=lambda g: g.before / g.noise)
    if verdict == 'unexplained':
        known = ' '.join(seen.text for seen in (unmodelled, wandering) if seen)
        whose = 'of the library' if tried is None else f'that was tried ({", ".join(tried)})'
        text = (
            f'Something is missing that no effect {whose} explains: {biggest.channel} is '
            f'simulated with an error of {biggest.after:.3g} {biggest.unit}, its noise is '
            f'{biggest.noise:.2g}. {known or NOTHING}'
        )
        if causes:
            text += (
                f' No more than {100 * explained:.0f} % of the squared error on held-out records '
                f'goes with {listed([described(c) for c in causes])}, which may only stand in '
                'for what is missing.'
            )
        return f'{text} {late}' if late else text
    named = ', '.join(described(c) for c in causes)
    if verdict == 'unfinished':
        text = (
            f'{biggest.channel} is simulated with an error of {biggest.after:.3g} '
            f'{biggest.unit}, its noise is {biggest.noise:.2g}, and no cause of most of it was '
            'found so far.'
        )
        return f'{text} {named} takes {100 * explained:.0f} % of it.' if causes else text
    if biggest.before < NO_GAIN * biggest.after and strained:
        text = (
            f'The simulation lacks {named}: without it the model follows the records only with '
            f'{", ".join(strained)} far from what its file believes.'
        )
    else:
        text = (
            f'The simulation lacks {named}, {_sureness(causes)}; with it the held-out error of '
            f'{biggest.channel} falls from {biggest.before:.3g} to {biggest.after:.3g} '
            f'{biggest.unit} (noise {biggest.noise:.2g}).'
        )
    vague = [f'{c.label}.{name}' for c in causes for name in c.undetermined]
    if vague:
        text += (
            f' These records do not determine {" and ".join(vague)}: what acts like this need '
            'not be what it is named after.'
        )
    best = next((c.proposals[0] for c in causes if c.proposals), None)
    if best is not None and best.evidence > MARGIN:
        text += (
            f' To tell {" from ".join(best.weakest)}, run {best.experiment} '
            f'(about {best.evidence:.0f} nats expected).'
        )
    elif best is not None:
        text += (
            f' No experiment that can be launched would tell {" from ".join(best.weakest)}: for '
            'what these recordings show they are one.'
        )
    if left:
        text += f' An error above the noise remains in {", ".join(left)}.'
        text += f' {unmodelled.text}' if unmodelled else ''
        text += f' {wandering.text}' if wandering else ''
    return text


def described(cause: Cause) -> str:
    """A cause with its numbers and rivals, in words."""
    own = _of_single_records(cause)
    shared = [name for name in cause.parameters if not own or name not in own]
    numbers = ', '.join(f'{name} {_told(cause, name)}' for name in shared)
    happened = _happened(cause, own) if own else []
    inside = '; '.join(part for part in (*happened, numbers) if part)
    rivals = f' or {" or ".join(cause.rivals)}' if cause.rivals else ''
    replaced = f', which replaces {listed(list(cause.replaces))}' if cause.replaces else ''
    return f'{cause.label} ({inside}){rivals}{replaced}'


def _of_single_records(cause: Cause) -> tuple[str, ...]:
    """Names of what happened in single records, as a push; none where nothing surely did."""
    kind = LIBRARY.get(effect_name(cause.label))
    if kind is None or not cause.events:
        return ()
    return tuple(p.name for p in kind.parameters if p.each == 'record')


def _happened(cause: Cause, names: Sequence[str]) -> list[str]:
    """Each event with its record, the largest first; how many more there are."""
    ordered = sorted(cause.events, key=lambda record: -abs(cause.events[record][names[0]][0]))
    told = [
        f'in {record} ' + ', '.join(
            f'{name} = {measured(*cause.events[record][name])}' for name in names
        )
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
    """Whether the 95 % interval of a place on a body tells where it is.

    It does if it is no wider than what lies between two of the places from which it is sought.

    Args:
        label: Of the effect.
        name: Of its parameter; all that are no places, sizes among them, count as determined.
        sigma: Standard deviation in its unit.
    """
    kind = LIBRARY.get(effect_name(label))
    declared = {p.name: p for p in kind.parameters}.get(name) if kind else None
    if declared is None or declared.neutral is not None or declared.logarithmic:
        return True
    if declared.unit != 'm' or len(declared.starts) < 2:
        return True
    return 2 * INTERVAL * sigma <= float(np.diff(sorted(declared.starts)).min())


def per_output(fit: Fit) -> np.ndarray:
    """chi2/N of each output over all trials; 0 for an output without samples."""
    return (fit.mse * fit.count).sum(axis=0) / np.maximum(fit.count.sum(axis=0), 1)
