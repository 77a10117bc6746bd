"""What the landings of a walking robot say, as data; how it is found is in landing_jury.py."""

from dataclasses import dataclass

import numpy as np

from cg_dynamics.effects.effect import ContactLaw


@dataclass(frozen=True)
class Impulse:
    """Impulse of the ground on a landing foot, measured: the robot is its own force plate.

    Attributes:
        name: Record and time of the touchdown.
        measured: Along the ground (ahead) and off it, in N s, shape (2,).
        covariance: Of these, in (N s)^2, shape (2, 2).
        plastic: What (IMP) predicts from the motion before, shape (2,).
    """

    name: str
    measured: np.ndarray
    covariance: np.ndarray
    plastic: np.ndarray


@dataclass(frozen=True)
class LawTried:
    """One law of contact tried on the landings.

    Attributes:
        effects: Effects whose parameter was fitted.
        parameters: Effect -> parameter -> (value, standard deviation, unit).
        law: The law.
        evidence: In nats against the law that the model states.
        held_gain: Fall of the squared error on landings held out, relative.
        significance: The same in standard errors, by the ranks of blocks of time.
        explained: RMS error explained there, in noise standard deviations, of the output where
            it is largest.
        errors: chi2/N on training landings and on those held out.
        reason: Why it was not accepted; empty if it could be.
    """

    effects: tuple[str, ...]
    parameters: dict[str, dict[str, tuple[float, float, str]]]
    law: ContactLaw
    evidence: float
    held_gain: float
    significance: float
    explained: float
    errors: tuple[float, float]
    reason: str = ''

    @property
    def label(self) -> str:
        """The effects in one word."""
        return ' + '.join(self.effects)


@dataclass(frozen=True)
class Landings:
    """The landings of all records.

    Attributes:
        found: Number of touchdowns.
        judged: Number of landings that were simulated.
        stated: The law that the model states.
        tried: Laws tried, best first.
        accepted: Effects that were named.
        rivals: Effects that explain the landings as well.
        before: chi2/N of each output on landings held out, with the law stated, shape (ny,).
        after: The same with what was accepted.
        independent: Independent samples behind the evidence.
        impulses: Measured impulses.
    """

    found: int
    judged: int
    stated: ContactLaw
    tried: tuple[LawTried, ...]
    accepted: tuple[str, ...]
    rivals: tuple[str, ...]
    before: np.ndarray
    after: np.ndarray
    independent: float
    impulses: tuple[Impulse, ...]

    @property
    def best(self) -> LawTried | None:
        """The law that was accepted, if one was."""
        return next((t for t in self.tried if t.effects == self.accepted), None)
