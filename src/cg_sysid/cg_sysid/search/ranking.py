"""Candidates judged on top of one base, ranked, and what names of effects say of each other."""

from dataclasses import dataclass

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid.identification.fit_result import Fit


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


def effect_name(label: str) -> str:
    """Standard name of an effect, its place left out."""
    return label.partition('@')[0]


def contains(label: str, other: str) -> bool:
    """Whether an effect turns into a simpler one, at the same place, at a limit of its own."""
    (name, _, at), (simpler, _, there) = label.partition('@'), other.partition('@')
    return simpler in LIBRARY[name].contains and not (at and there and at != there)


def per_output(fit: Fit) -> np.ndarray:
    """chi2/N of each output over all data sets; 0 for an output without samples."""
    return (fit.mse * fit.count).sum(axis=0) / np.maximum(fit.count.sum(axis=0), 1)
