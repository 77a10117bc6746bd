"""Peers of the diagnosis: other ways to name a cause, each as well made as its author could.

Each peer is one module with a function `name_cause(case)`. All get the same data sets, and all are
judged by the same number: the error of their final model when it simulates the held-out records.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid.identification.data_set import DataSet


@dataclass(frozen=True)
class Case:
    """What a peer gets.

    Attributes:
        nominal: The model to start from, with its beliefs.
        train: Data sets to fit.
        held: Data sets to judge on.
        machine: The machine itself, without what is hidden in it: for peers that are told the
            true rigid body and friction, as their row says.
    """

    nominal: Model
    train: tuple[DataSet, ...]
    held: tuple[DataSet, ...]
    machine: Model


@dataclass(frozen=True)
class Answer:
    """What a peer says.

    Attributes:
        cause: Standard name of the effect that it names first; empty for none.
        error: chi2/N of its final model on the held-out data sets.
        strength: What it decided by, for tuning thresholds.
    """

    cause: str
    error: float
    strength: float


def effects_for(case: Case) -> list[tuple[str, str | None]]:
    """(effect, at) of all in our library that peers are handed: those that can show here.

    Left out is what needs an unrecorded switch, and what happens in one record only.
    """
    model = case.nominal
    body, present = model.mechanism, {effect.label for effect in model.effects}
    setups = [data_set.setup for data_set in (*case.train, *case.held)]
    found = []
    for name, effect in LIBRARY.items():
        known = set(effect.extra_inputs) <= {'time', *body.inputs}
        if not known or not effect.applies(setups) or any(p.each for p in effect.parameters):
            continue
        made = [effect(body, at) for at in effect.sites(body)]
        found += [(name, e.at) for e in made if e.label not in present]
    return found


def mean_square(residuals: list[np.ndarray]) -> float:
    """chi2/N of residuals over noise, NaN where there is no sample."""
    return float(np.nanmean(np.concatenate([r.ravel() for r in residuals]) ** 2))


NameCause = Callable[[Case], Answer]
