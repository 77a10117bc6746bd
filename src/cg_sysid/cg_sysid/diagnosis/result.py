"""The answer of a diagnosis as data.

What was found, what was tried, and the gain; how it is found is in diagnose.py, how it is told in
summary.py, how it becomes plain data in report/facts.py.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum
from pathlib import Path

import numpy as np

from cg_dynamics.model import Model
from cg_sysid.diagnosis.between_recordings import Wandering
from cg_sysid.diagnosis.experiment_design import Proposal
from cg_sysid.experiments.catalogue import Experiment
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.gain import Gain
from cg_sysid.identification.measured_start import MeasuredStart
from cg_sysid.landings.result import Landings
from cg_sysid.learned.unmodelled import Unmodelled
from cg_sysid.records.record import Record
from cg_sysid.search.ranking import Candidate, Round, per_output
from cg_sysid.search.standings import Unfinished

MOST_ROUNDS = 4


class Verdict(str, Enum):
    """What a diagnosis says of records: diagnosis.md, section 6."""

    CONSISTENT = 'consistent'
    EXPLAINED = 'explained'
    AMBIGUOUS = 'ambiguous'
    UNEXPLAINED = 'unexplained'
    UNUSABLE = 'unusable'
    UNFINISHED = 'unfinished'

    __str__ = str.__str__


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
        at_edge: Parameters that ended at an edge of their range where physics goes on.
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
    at_edge: tuple[str, ...] = ()
    replaces: tuple[str, ...] = ()


@dataclass(frozen=True)
class Diagnosis:
    """The answer.

    Attributes:
        verdict: Unfinished where the search was broken off before it found what explains most of
            the error.
        summary: One sentence for people.
        causes: Named causes, strongest first; those of `unexplained` leave most of the error.
        gains: Simulation error before and after on held-out records.
        nominal: The model as it was given.
        baseline: The same, its parameters identified on the training records.
        extended: The model with the causes in it, identified on the training records.
        rounds: What was tried, in order.
        train: Data sets used for fitting.
        held: Data sets held out.
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
        model: What was found, for whoever simulates: the extended model with numbers from all
            records, those held out among them.
        from_all: False where there was no time for that fit, and `model` has the numbers of the
            training records.
        measured_start: The gain where held-out records start at measured angles; None where no
            cause is named, or their starts carry nowhere.
    """

    verdict: Verdict
    summary: str
    causes: tuple[Cause, ...]
    gains: tuple[Gain, ...]
    nominal: Model
    baseline: Candidate
    extended: Candidate
    rounds: tuple[Round, ...]
    train: tuple[DataSet, ...]
    held: tuple[DataSet, ...]
    remaining: dict[str, float]
    model: Model
    from_all: bool
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


def gains_of(model: Model, held: Sequence[DataSet], before: Fit, after: Fit) -> tuple[Gain, ...]:
    """Error of each output before and after on the held-out data sets."""
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
