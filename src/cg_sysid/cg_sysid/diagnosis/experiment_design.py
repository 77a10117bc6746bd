"""Which experiment next, where recordings cannot tell causes apart.

Every experiment that can be launched is rehearsed: each of the rival models in turn is taken for
the machine, and the others are fitted to what it would record, starting from what the recordings
so far have taught them. The evidence that the machine's own model would gain over its rivals,
in the worst case, is what the experiment is worth.
"""

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_interfaces.channels import interface
from cg_sysid.experiments.catalogue import Experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.identification.data_set import DataSet, as_data_set, led_in
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.identify import fit, predict
from cg_sysid.identification.information_criterion import evidence
from cg_sysid.identification.unknowns import IdentificationError
from cg_sysid.parallel import run_all
from cg_sysid.records.record import Record
from cg_sysid.search.outcome import Outcome

STEP_S = 0.002
FASTER = 4.0  # an excitation is also rehearsed with so many times its highest frequency
FASTEST_HZ = 12.0
REHEARSED_S = 5.0  # of an experiment; evidence grows with its length
ITERATIONS = 16
MOST_RIVALS = 2
SEED = 20111  # of noise and excitation of the rehearsals


@dataclass(frozen=True)
class Proposal:
    """An experiment that would tell causes apart.

    Attributes:
        experiment: Its name.
        excitation: Settings of the torque (excitation.py).
        duration: Its length in s.
        evidence: Nats that one record is expected to give, whichever of the causes is true.
        weakest: The two causes that it tells apart least.
    """

    experiment: str
    excitation: Mapping[str, Any]
    duration: float
    evidence: float
    weakest: tuple[str, str]


def propose(
    rivals: Sequence[Outcome],
    sigma: np.ndarray,
    experiments: Sequence[Experiment],
    workers: int | None = None,
    executor: Executor | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> tuple[Proposal, ...]:
    """Experiments by how surely they would tell rival models apart, best first.

    Args:
        rivals: What is accepted, then its rivals, each fitted to the same records.
        sigma: Noise floor of each output.
        experiments: What can be launched.
        workers: Local processes.
        executor: Use this instead.
        progress: Called with (done, total).
    """
    told = [(o.label, o.train) for o in rivals[: 1 + MOST_RIVALS]]
    found = run_all(
        _rehearsed,
        [(told, sigma, experiment, excitation)
         for experiment in experiments for excitation in _excitations(experiment)],
        workers, executor, lambda done, total, _: progress(done, total),
    )  # fmt: skip
    return tuple(
        sorted((p for p in found if p is not None), key=lambda p: p.evidence, reverse=True)
    )


def _excitations(experiment: Experiment) -> list[dict[str, Any]]:
    """The experiment's own excitation, and a faster one."""
    own = dict(experiment.excitation)
    if own.get('kind') not in ('multisine', 'chirp') or own.get('f_max', np.inf) >= FASTEST_HZ:
        return [own]
    return [own, {**own, 'f_max': min(FASTER * own['f_max'], FASTEST_HZ)}]


def _rehearsed(
    rivals: Sequence[tuple[str, Fit]],
    sigma: np.ndarray,
    experiment: Experiment,
    excitation: Mapping[str, Any],
) -> Proposal | None:
    """What one experiment is worth; None where it cannot be done with this machine."""
    (accepted, _), *others = rivals
    worth = []
    try:
        for other, _ in others:
            for truth, doubted in ((accepted, other), (other, accepted)):
                models = dict(rivals)
                data_set = imagined(models[truth].model, sigma, experiment, excitation)
                # Noise alone costs some models some hundred nats, and the true one as many.
                nats = _lost(models[doubted], data_set) - _lost(models[truth], data_set)
                worth.append((nats * experiment.duration / data_set.duration, (accepted, other)))
    except (IdentificationError, DynamicsError, ValueError, np.linalg.LinAlgError):
        return None
    nats, weakest = min(worth)
    return Proposal(experiment.name, excitation, experiment.duration, float(nats), weakest)


def imagined(
    model: Model, sigma: np.ndarray, experiment: Experiment, excitation: Mapping[str, Any]
) -> DataSet:
    """What the first seconds of an experiment would record if the model were the machine."""
    duration = min(experiment.duration, REHEARSED_S)
    settings = ExcitationSettings(**excitation, duration=duration, seed=SEED)
    signal = make_signal(settings)
    body = model.mechanism
    time = STEP_S * np.arange(round(duration / STEP_S))
    torque = np.array([signal(t) for t in time])
    record = Record(
        name=experiment.name,
        stamp_ns=np.rint(1e9 * time).astype(np.int64),
        inputs={name: torque for name in body.inputs},
        outputs={channel: np.zeros(len(time)) for channel in body.outputs},
        mechanism=interface(body),
        setup=experiment.setup,
        note={},
    )
    data_set = as_data_set(body, record, sigma)
    noise = sigma * np.random.default_rng(SEED).standard_normal(data_set.outputs.shape)
    seen = predict(model, data_set, np.array(experiment.initial_state)) + noise
    outputs = dict(zip(body.outputs, seen.T, strict=True))
    data_set = as_data_set(body, replace(record, outputs=outputs), sigma)
    return led_in(data_set)


def _lost(rival: Fit, data_set: DataSet) -> float:
    """Evidence in nats that a data set gives against a model that knows what its fit knows."""
    found = fit(rival.model, [data_set], iterations=ITERATIONS)
    belief = sum(
        ((u.to_coordinate(v) - u.to_coordinate(u.prior)) / u.tolerance) ** 2
        for u, v in zip(found.unknowns, found.values, strict=True)
        if np.isfinite(u.tolerance)
    )
    samples = float(found.count.sum())
    error = float((found.mse * found.count).sum())
    return evidence(error, samples, samples, 0, belief)
