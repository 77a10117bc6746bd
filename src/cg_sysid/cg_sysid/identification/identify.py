"""Identification by simulation error over many records at once: theory.md, (ID).

    J = sum_records sum_k |y_sim[k] - y_measured[k]|^2_W  +  |theta - theta_file|^2_(1/tolerance^2)

over the parameters shared by all records and, for each record, its own initial motion. Gauss-
Newton with exact sensitivities and Levenberg-Marquardt damping; each record's own unknowns are
eliminated by a Schur complement, so that many records cost no more than their simulation.

Two things make it robust. The horizon grows from a fraction of a second to the whole record, so
that the cliffs of the full cost (thesis, 4.2.3) are met only near the solution. And the weight
W follows the residual that is left, so that a wrong model does not buy a small gain in fit with
parameters far outside what the model file believes.
"""

import time as clock
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cg_dynamics.assemble import acting_effects, parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rollout.compiled import compile_model
from cg_sysid.identification import along_motion, kept_fits, torque_error
from cg_sysid.identification.data_set import DataSet, prepare
from cg_sysid.identification.descent import (
    CLOSE,
    DAMPING,
    FAR,
    NEAR,
    NONE,
    SMALL_GAIN,
    Descent,
    error_of,
    minimise,
)
from cg_sysid.identification.fit_result import (
    Fit,
    as_waves_are_written,
    warnings_of,
    with_uncertainty,
)
from cg_sysid.identification.information_criterion import weight_of
from cg_sysid.identification.kept_fits import End
from cg_sysid.identification.simulation_error import Point, Problem, Trial, attempt, own_values
from cg_sysid.identification.uncertainty import not_asked, uncertainty
from cg_sysid.identification.unknowns import (
    IdentificationError,
    own_unknowns,
    unknowns_of,
    unsettled_states,
)
from cg_sysid.records.record import Record
from cg_sysid.text import off_by

HORIZONS = (0.5, 2.0, 5.0)  # s, before the full length
MOST = 0.8  # share of the samples, from which a horizon is as good as the full length
BETWEEN_WEIGHTS = 8  # iterations after which the weights follow the residual
BETWEEN_WEIGHTS_THOROUGH = 24  # the same of a thorough fit
STEADY = 0.1  # change of the logarithm of the weights at which they count as settled
DRIFT = 1e-5  # relative change of the cost at which a fit has converged
FAR_DRIFT = 1e-3  # the same of one that is not CLOSE to the noise
LEADING = 3e-2  # the same of one that only leads the way
SETTLING = 12  # iterations of a robot around a rotor, at most
LOST = 0.1  # share of the variance of the data, from which a simulation goes its own way
REFINED = 2.0  # integration steps of a thorough fit in place of one
COARSE = 0.25  # the same of a first look: what needs short steps, as stiff teeth, is told later
WHOLE = 'fitting whole records, in rounds until it settles'
Progress = Callable[[str, int, int, str], None]


def _so_far(found: Descent) -> str:
    """How good a descent is, in words."""
    if found.point is None:
        return ''
    return off_by(float(found.point.sse.sum() / max(found.point.count.sum(), 1)))


def fit(
    model: Model,
    data_sets: Sequence[DataSet],
    only: Sequence[str] | None = None,
    iterations: int = 60,
    reweight: bool = True,
    horizon: float = np.inf,
    start: Fit | None = None,
    at: Mapping[str, float] | None = None,
    own: Mapping[str, Mapping[str, float]] | None = None,
    bounds: Mapping[str, float] | None = None,
    thorough: bool = False,
    reach: float = np.inf,
    sure: bool = True,
    company: bool = False,
    progress: Progress = lambda what, done, total, best: None,
) -> Fit:
    """Identify a model's parameters from data sets.

    Args:
        model: What is believed: values, tolerances, bounds. The search sets out from there.
        data_sets: Prepared records (data set.prepare).
        only: Full names of the parameters to identify; by default all that are free.
        iterations: Limit for the last, full-length stage.
        reweight: Let the weights follow the residual that is left.
        horizon: Use only this much of each record, in s: a cheap first look.
        start: Set out from this fit of the same unknowns to a shorter horizon instead.
        at: Set out from these values (full name -> value) instead of those of the file; without
            them a robot of a URDF sets out from what its torques say (torque_error.py).
        own: Name of a data set -> first guesses, by full name, of what it has beyond its
            initial motion (`own_unknowns`); without one the model's value is the guess.
        bounds: Parameters that stay near the model's value (`unknowns_of`).
        thorough: Down to the very bottom, at several times the cost: until a tenth of a squared
            standard deviation is all that is left to gain, with finer integration. For values
            that are to be as good as their intervals say.
        reach: chi2/N that matters: a fit that lies beyond and gains little is broken off.
        sure: Whether to work out how sure the values are, a tenth of the time of a short fit.
        company: A first look: compiled beside other effects (company.py), in coarse steps. On a
            robot of a URDF it is led by torques, near enough to take fine ones.
        progress: Called with (what, done, total, how good it is so far in words).

    Raises:
        IdentificationError: if the model cannot be simulated along the data at all.
    """
    if not data_sets:
        raise IdentificationError('no record to identify from; at least one is needed')
    began = clock.perf_counter()
    unknowns = unknowns_of(model, only, bounds)
    coarse = company and not torque_error.can(model)
    refinement = REFINED if thorough else COARSE if coarse else 1.0
    problem = Problem(
        model, data_sets, unknowns, _guesses(model, data_sets, own or {}), refinement, company
    )
    first = _start_of(problem, only, bounds, start, at)
    longest = min(max(data_set.duration for data_set in data_sets), horizon)
    place = kept_fits.place_of(
        model, data_sets, names=[u.name for u in unknowns], theta=first.theta,
        motions=first.motions, guesses=problem.guesses, longest=longest, weight=first.weight,
        reweight=reweight, behind=first.behind, bounds=bounds or {}, iterations=iterations,
        thorough=thorough, refinement=refinement, reach=reach,
    )  # fmt: skip
    end, trial = kept_fits.recall(place), None
    if end is None:
        end, trial = _searched(
            problem, first, longest, iterations, reweight, thorough, reach, progress
        )
        kept_fits.keep(place, end)
    if sure:
        trial = trial or attempt(problem, end.theta, end.motions, longest)
        how_sure = uncertainty(problem, trial, end.weight)
    else:
        how_sure = not_asked(problem)
    found = replace(_told(problem, end, longest, *how_sure), seconds=clock.perf_counter() - began)
    return replace(found, warnings=tuple(warnings_of(found, bounds or ()))) if sure else found


@dataclass(frozen=True)
class _Start:
    """Where a search sets out.

    Attributes:
        theta: Coordinates of the unknowns, shape (k,).
        motions: What each data set has of its own.
        weight: Of the residual.
        behind: Horizon over which this has been fitted already, s.
        by_torque: Whether torques say where.
    """

    theta: np.ndarray
    motions: list[np.ndarray]
    weight: float
    behind: float
    by_torque: bool


def _start_of(
    problem: Problem,
    only: Sequence[str] | None,
    bounds: Mapping[str, float] | None,
    start: Fit | None,
    at: Mapping[str, float] | None,
) -> _Start:
    model, unknowns = problem.model, problem.unknowns
    if start is not None:
        values, motions = start.values, list(start.motions)
        weight, behind, by_torque = 1 / start.inflation, start.horizon, False
    else:
        by_torque, behind, weight = torque_error.can(model), 0.0, 1.0
        if by_torque and at is None and unknowns:
            found = torque_error.fit_by_torque(model, problem.data_sets, only, bounds)
            at = found.values if found else None
        values = np.array([(at or {}).get(u.name, u.prior) for u in unknowns])
        motions = list(problem.guesses)
    theta = np.array([u.to_coordinate(v) for u, v in zip(unknowns, values, strict=True)])
    return _Start(theta, motions, weight, behind, by_torque)


def _searched(
    problem: Problem,
    first: _Start,
    longest: float,
    iterations: int,
    reweight: bool,
    thorough: bool,
    reach: float,
    progress: Progress,
) -> tuple[End, Trial | None]:
    """From a start to the minimum; returned as of `_descend`."""
    theta, motions, trial = first.theta, first.motions, None
    stages = [h for h in HORIZONS
              if first.behind < h and _share(problem.data_sets, h, longest) < MOST]  # fmt: skip
    if first.by_torque:
        trial = attempt(problem, theta, motions, longest)
        if _resembles(trial, first.weight):
            stages = []  # the torques have led the way
        elif stages:
            trial = attempt(problem, theta, motions, stages[0])
        theta, motions, trial = _around(
            problem, theta, motions, stages[0] if stages else longest, first.weight,
            min(SETTLING, 2 * iterations), reach, trial,
        )  # fmt: skip
    return _descend(
        problem, theta, motions, [*stages, longest], first.weight, iterations, reweight, thorough,
        reach, progress, None if stages else trial,
    )  # fmt: skip


def _told(
    problem: Problem,
    end: End,
    longest: float,
    covariance: np.ndarray,
    information: np.ndarray,
    sigmas: Sequence[np.ndarray],
) -> Fit:
    """What was found, in values."""
    model, unknowns = problem.model, problem.unknowns
    values, covariance = as_waves_are_written(
        model, unknowns, problem.values(end.theta), covariance
    )
    unsettled = len(unsettled_states(model))
    away = [motion[len(t.motion) :][:unsettled]
            for t, motion in zip(problem.data_sets, end.motions, strict=True)]  # fmt: skip
    return Fit(
        model=with_uncertainty(model, unknowns, values, covariance),
        unknowns=unknowns,
        values=values,
        covariance=covariance,
        information=information,
        motions=tuple(end.motions),
        own=problem.own,
        own_sigmas=tuple(s[unsettled:] for s in sigmas),
        starts=_demanded(away, [s[:unsettled] for s in sigmas]),
        cost=end.cost,
        mse=end.sse / np.maximum(end.count, 1),
        count=end.count,
        inflation=1 / end.weight,
        horizon=longest,
        evaluations=problem.evaluations,
        seconds=0.0,
        refinement=problem.refinement,
        converged=end.converged,
    )


def _resembles(trial: Trial | None, weight: float) -> bool:
    """Whether a simulation follows the data: each output is off by less than LOST allows."""
    if trial is None or trial.point(weight) is None:
        return False
    varies = np.array([
        np.nansum(((t.outputs - np.nanmean(t.outputs, axis=0)) / t.sigma) ** 2, axis=0)
        for t in trial.problem.data_sets
    ])  # fmt: skip
    return bool((trial.sse.sum(axis=0) < LOST * varies.sum(axis=0)).all())


def _around(
    problem: Problem,
    theta: np.ndarray,
    motions: list[np.ndarray],
    horizon: float,
    weight: float,
    iterations: int,
    reach: float,
    trial: Trial | None,
) -> tuple[np.ndarray, list[np.ndarray], Trial | None]:
    """The robot settled around what torques say of a rotor that moves by itself.

    Of its gap or its spring they know more than of what the robot weighs. Let go together, teeth
    that meet at wrong times get soft, and do not come back.
    """
    told = tuple(
        f'{e.label}.' for e in problem.model.effects if e.elastic and along_motion.follows(e)
    )
    kept = np.array([bool(told) and u.name.startswith(told) for u in problem.unknowns])
    if trial is None or not kept.any():
        return theta, motions, trial
    found = minimise(
        problem, theta, motions, horizon, weight, iterations, LEADING, reach, kept=kept,
        trial=trial,
    )  # fmt: skip
    return found.theta, found.motions, found.trial


def _descend(
    problem: Problem,
    theta: np.ndarray,
    motions: list[np.ndarray],
    horizons: Sequence[float],
    weight: float,
    iterations: int,
    reweight: bool,
    thorough: bool,
    reach: float,
    progress: Progress,
    trial: Trial | None,
) -> tuple[End, Trial | None]:
    """From a start to the minimum: over short horizons, then the last in rounds of weights.

    Given `trial` is the start simulated over the last horizon, where that is the only one and it
    is known; returned are where it came to and the simulations there.
    """
    *stages, longest = horizons
    found = Descent(theta, motions, None, False, trial)
    at_once = min(iterations, BETWEEN_WEIGHTS_THOROUGH if thorough else BETWEEN_WEIGHTS)
    rounds = max(1, iterations // max(1, at_once))
    for k, horizon in enumerate(stages):
        progress(f'fitting the first {horizon:g} s', k, len(stages) + rounds, _so_far(found))
        # The short horizons only lead the way; the belief of the file keeps them sober.
        ahead = minimise(
            problem, found.theta, found.motions, horizon, weight, 12, LEADING, reach, leading=True
        )
        if ahead.point is not None:
            found = replace(ahead, trial=None)
            weight = _weight(problem, ahead.point) if reweight else 1.0
        if found.hopeless:
            at_once, rounds = 0, 1
            break
    led = problem.company and torque_error.can(problem.model)
    valley = FAR if thorough else NONE if led else NEAR
    damping = DAMPING
    for k in range(rounds):
        progress(WHOLE, len(stages) + k, len(stages) + rounds, _so_far(found))
        # Under weights that nobody knows yet a minimum is none.
        leads = reweight and not k and rounds > 1 and weight == 1.0
        close = found.point is None or error_of(found.point) < CLOSE
        drift = LEADING if leads else 0.0 if thorough else DRIFT if close else FAR_DRIFT
        found = minimise(
            problem, found.theta, found.motions, longest, weight, at_once, drift, reach,
            valley=valley, damping=damping, trial=found.trial,
        )  # fmt: skip
        if found.point is None:
            raise IdentificationError(
                f'model {problem.model.name!r} runs away along the data '
                f'({", ".join(t.name for t in problem.data_sets)}); its values are too far off, '
                'or the records are too long for an unstable motion: cut them into windows'
            )
        new = _weight(problem, found.point) if reweight else 1.0
        # Nor is it one under weights that are about to change.
        steady = bool(abs(np.log(new / weight)) < STEADY)
        idle = not thorough and found.gained < at_once * max(SMALL_GAIN, drift * found.point.cost)
        converged = steady and (found.converged or idle) and not leads
        if converged or found.hopeless:
            break
        weight, damping = new, found.damping if steady else max(DAMPING, found.damping)
    point = found.point
    assert point is not None
    end = End(
        found.theta, found.motions, float(point.cost), point.sse, point.count, float(weight),
        converged,
    )  # fmt: skip
    return end, found.trial


def _guesses(
    model: Model, data_sets: Sequence[DataSet], own: Mapping[str, Mapping[str, float]]
) -> list[np.ndarray]:
    stated = {u.name: u.prior for u in own_unknowns(model)}
    settled = [0.0] * len(unsettled_states(model))
    return [
        np.array(
            [
                *data_set.motion,
                *settled,
                *(own.get(data_set.name, {}).get(n, v) for n, v in stated.items()),
            ]
        )
        for data_set in data_sets
    ]


def _weight(problem: Problem, point: Point) -> float:
    step = np.median(np.concatenate([np.diff(data_set.time) for data_set in problem.data_sets]))
    return float(weight_of(point.sse.sum() / point.count.sum(), step))


def _share(data_sets: Sequence[DataSet], horizon: float, longest: float) -> float:
    """Of the samples over the longest horizon: those within a shorter one."""
    within = [np.searchsorted(t.time, [horizon, longest], side='right') for t in data_sets]
    return float(np.divide(*np.sum(within, axis=0)))


def _demanded(away: Sequence[np.ndarray], sigmas: Sequence[np.ndarray]) -> float:
    """Twice the nats that starts of extra states cost, by Laplace's approximation.

    Each was believed to be 0 +- 1: what it is away from that, and how much narrower the data make
    it. What they do not see costs nothing.
    """
    narrower = np.clip(np.concatenate(sigmas), 1e-6, 1.0)
    return float((np.concatenate(away) ** 2).sum() - 2 * np.log(narrower).sum())


def in_data_set(model: Model, own: np.ndarray) -> tuple[Model, np.ndarray]:
    """The model with what a data set has of its own (Fit.motions), and its start, (nx,).

    The start is as `CompiledModel.initial_state` takes it.
    """
    unknowns = own_unknowns(model)
    happened = dict(zip((u.name for u in unknowns), own_values(unknowns, own), strict=True))
    model = model.with_values(happened)
    start = own[: len(own) - len(unknowns)]
    states = unsettled_states(model)
    acting = {f'{e.label}.{s}' for e in acting_effects(model) for s in e.states}
    taken = [True] * (len(start) - len(states)) + [name in acting for name in states]
    return model, start[np.array(taken, bool)]


def identify(model: Model, records: Sequence[Record], **how: Any) -> Fit:
    """Identify a model's parameters from recordings.

    Args:
        model: What is believed: values, tolerances, bounds.
        records: Recordings of its machine.
        how: Options of `fit`.

    Raises:
        IdentificationError: if the records cannot be used with this model.
    """
    return fit(model, prepare(model, records), **how)


def predict(
    model: Model, data_set: DataSet, motion: np.ndarray, refinement: float = 1.0
) -> np.ndarray:
    """Outputs that a model simulates along a data set, shape (n, ny).

    Args:
        model: The model.
        data_set: The data set.
        motion: What the data set has of its own (Fit.motions).
        refinement: As the fit's.
    """
    model, motion = in_data_set(model, motion)
    compiled = compile_model(model, data_set.setup)
    p = parameter_vector(model, data_set.setup)
    u = data_set.inputs_for(compiled.input_names)
    x0 = compiled.initial_state(motion, u[0], p)
    return compiled.readings(data_set.time, u, x0, p, refinement)


def score(
    model: Model,
    data_sets: Sequence[DataSet],
    unseen: Sequence[str] = (),
    own: Mapping[str, Mapping[str, float]] | None = None,
    bounds: Mapping[str, float] | None = None,
    thorough: bool = False,
    reach: float = np.inf,
) -> Fit:
    """How well a model simulates data sets that it was not fitted to.

    Only what each data set has of its own is fitted: its initial motion, as no recording states it
    exactly, and what happened in it alone, from the guess `own` (see `fit`); and parameters
    `unseen` of which the others could tell nothing, as the shape of a push that none of them had.
    """
    return fit(
        model, data_sets, only=unseen, own=own, bounds=bounds, thorough=thorough, reach=reach
    )
