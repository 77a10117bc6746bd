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
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cg_dynamics.assemble import acting_effects, parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rollout.compiled import compile_model
from cg_sysid.deadline import check_time
from cg_sysid.identification import along_motion, kept_fits, torque_error
from cg_sysid.identification.data_set import DataSet, prepare
from cg_sysid.identification.hope import out_of_reach
from cg_sysid.identification.information_criterion import weight_of
from cg_sysid.identification.simulation_error import (
    BARRIER,
    Point,
    Problem,
    Trial,
    attempt,
    moved,
    own_values,
    reduced,
    settled,
)
from cg_sysid.identification.uncertainty import not_asked, uncertainty
from cg_sysid.identification.unknowns import (
    IdentificationError,
    Unknown,
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
SMALL_GAIN = 0.1  # squared standard deviations: nobody would call one fit better than another
CENTRAL = 1e-2  # weight of the border of consistency over what is still to be gained, [1]
DRIFT = 1e-5  # relative change of the cost at which a fit has converged
FAR_DRIFT = 1e-3  # the same of one that is not CLOSE to the noise
LEADING = 3e-2  # the same of one that only leads the way
SETTLING = 12  # iterations of a robot around a rotor, at most
LOST = 0.1  # share of the variance of the data, from which a simulation goes its own way
BACK = 5  # steps across a valley after one uphill, at most
CLOSE = 1e4  # chi2/N; farther from the noise nobody needs the floor of a valley
ROUNDING = 1e-12  # share of a curvature that elimination of other unknowns may leave by chance
HALF = 0.5  # share that a step takes off a positive value, before it takes less than it says
REFINED = 2.0  # integration steps of a thorough fit in place of one
COARSE = 0.25  # the same of a first look: what needs short steps, as stiff teeth, is told later
DAMPING = 1e-3  # of the first step
SHORT = 0.5  # damping from which a step is short
WHOLE = 'fitting whole records, in rounds until it settles'
ORDER = 0.5  # relative standard deviation from which not even the order of a number is known
Progress = Callable[[str, int, int, str], None]


@dataclass(frozen=True)
class Valley:
    """How far steps along a curved valley may leave its floor.

    Attributes:
        uphill: Ratio of costs up to which a step uphill is followed by some across the valley.
        across: Damping of those: what is flatter, beside the walls, stays as it is.
    """

    uphill: float
    across: float


# A long step may leap over the minima of play: only a fit that is at its end takes those that a
# valley needs whose floor is a billionth as steep as its walls, as of a load and what carries it.
NEAR, FAR = Valley(1e3, 1e-3), Valley(1e5, 1e-6)
NONE = Valley(1.0, 1.0)  # of looks that torques have led: no step uphill


@dataclass(frozen=True)
class _Descent:
    """Where a minimisation came to; without a point where the simulation runs away."""

    theta: np.ndarray
    motions: list[np.ndarray]
    point: Point | None
    converged: bool
    trial: Trial | None = None  # the simulations of that point, over the horizon of the search
    hopeless: bool = False
    damping: float = DAMPING  # with which to go on
    gained: float = np.inf  # of the cost


def _so_far(found: _Descent) -> str:
    """How good a descent is, in words."""
    if found.point is None:
        return ''
    return off_by(float(found.point.sse.sum() / max(found.point.count.sum(), 1)))


@dataclass(frozen=True)
class _End:
    """Where a fit came to, before anybody asks how sure that is; as numbers it can be kept.

    Attributes:
        theta: Coordinates of the unknowns, shape (k,).
        motions: What each data set has of its own.
        cost: Final cost.
        sse: Squared error over noise variance of each data set and output, shape (data sets, ny).
        count: Samples behind it.
        weight: Of the residual in the cost.
        converged: Whether it is a minimum.
    """

    theta: np.ndarray
    motions: list[np.ndarray]
    cost: float
    sse: np.ndarray
    count: np.ndarray
    weight: float
    converged: bool

    def numbers(self) -> dict[str, Any]:
        """All of it as lists."""
        return {
            'theta': self.theta.tolist(), 'motions': [m.tolist() for m in self.motions],
            'cost': self.cost, 'sse': self.sse.tolist(), 'count': self.count.tolist(),
            'weight': self.weight, 'converged': self.converged,
        }  # fmt: skip

    @classmethod
    def of(cls, numbers: Mapping[str, Any] | None) -> '_End | None':
        """What `numbers` wrote; None of nothing, or of something else."""
        try:
            return None if numbers is None else cls(
                np.array(numbers['theta'], float),
                [np.array(m, float) for m in numbers['motions']],
                float(numbers['cost']), np.array(numbers['sse'], float),
                np.array(numbers['count'], float), float(numbers['weight']),
                bool(numbers['converged']),
            )  # fmt: skip
        except (KeyError, TypeError, ValueError):
            return None


@dataclass(frozen=True)
class Fit:
    """Result of an identification.

    Attributes:
        model: The model with the identified values and their standard deviations.
        unknowns: What was identified.
        values: Identified value of each unknown.
        covariance: Of the unknowns' coordinates (log where logarithmic), shape (k, k).
        information: Share of each unknown's certainty that comes from data, 0 (all from the
            model file's belief) to 1.
        motions: What each data set has of its own: initial motion, (2m,), how far extra states are
            from settled at its start (`unsettled_states`, in their spreads), then one value for
            each of `own`.
        own: Parameters of which every record has a value of its own (a push's instant).
        own_sigmas: Standard deviation of these, shape (len(own),) for each data set.
        cost: Final cost J, in squared noise standard deviations.
        mse: Mean squared error of each data set and output, in squared noise, shape (n, ny).
        count: Samples behind `mse`.
        inflation: Variance of the residual over that of the noise, as used in the weights.
        horizon: Length of the records used, in s.
        evaluations: Number of evaluations of all records.
        seconds: Wall time.
        refinement: Integration steps that were taken in place of one.
        converged: False if it stopped at the limit of iterations.
        warnings: What a person should know: bounds, correlations, unidentifiable directions.
        starts: What the starts of extra states cost as evidence, in the unit of `belief`.
    """

    model: Model
    unknowns: tuple[Unknown, ...]
    values: np.ndarray
    covariance: np.ndarray
    information: np.ndarray
    motions: tuple[np.ndarray, ...]
    own: tuple[Unknown, ...]
    own_sigmas: tuple[np.ndarray, ...]
    cost: float
    mse: np.ndarray
    count: np.ndarray
    inflation: float
    horizon: float
    evaluations: int
    seconds: float
    refinement: float
    converged: bool
    warnings: tuple[str, ...] = ()
    starts: float = 0.0

    @property
    def sigmas(self) -> np.ndarray:
        """Standard deviation of each value, in its unit, shape (k,)."""
        spread = np.sqrt(np.clip(np.diag(self.covariance), 0, None))
        pairs = zip(self.unknowns, self.values, strict=True)
        factor = [v if u.logarithmic else 1.0 for u, v in pairs]
        return spread * np.array(factor)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Positive numbers without a belief of which not even the order is known."""
        relative = np.sqrt(np.clip(np.diag(self.covariance), 0, None))
        return tuple(
            u.name
            for u, spread in zip(self.unknowns, relative, strict=True)
            if u.logarithmic and not np.isfinite(u.tolerance) and spread > ORDER
        )

    def own_by_name(self, data_sets: Sequence[DataSet]) -> dict[str, dict[str, float]]:
        """What was found of each data set alone: its name -> full name -> value."""
        count = len(self.own)
        return {
            data_set.name: {
                u.name: float(v)
                for u, v in zip(self.own, motion[len(motion) - count :], strict=True)
            }
            for data_set, motion in zip(data_sets, self.motions, strict=True)
            if count
        }

    @property
    def squares(self) -> float:
        """Squared error over noise variance, all data sets and outputs together."""
        return float((self.mse * self.count).sum())

    @property
    def belief(self) -> float:
        """Squared distance from what the model file believes, in its standard deviations."""
        return sum(
            ((u.to_coordinate(v) - u.to_coordinate(u.prior)) / u.tolerance) ** 2
            for u, v in zip(self.unknowns, self.values, strict=True)
            if np.isfinite(u.tolerance)
        )

    @property
    def normalised_error(self) -> float:
        """Mean squared error over noise variance, all data sets and outputs together."""
        return float(np.nansum(self.mse * self.count) / self.count.sum())


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
    by_torque = start is None and torque_error.can(model)
    if by_torque and at is None and unknowns:
        found = torque_error.fit_by_torque(model, data_sets, only, bounds)
        at = found.values if found else None
    values = [(at or {}).get(u.name, u.prior) for u in unknowns] if start is None else start.values
    theta = np.array([u.to_coordinate(v) for u, v in zip(unknowns, values, strict=True)])
    motions = list(problem.guesses if start is None else start.motions)
    longest = min(max(data_set.duration for data_set in data_sets), horizon)
    weight = 1.0 if start is None else 1 / start.inflation
    place = kept_fits.place_of(
        model, data_sets, names=[u.name for u in unknowns], theta=theta, motions=motions,
        guesses=problem.guesses, longest=longest, weight=weight, reweight=reweight,
        behind=start.horizon if start else 0.0, bounds=bounds or {}, iterations=iterations,
        thorough=thorough, refinement=refinement, reach=reach,
    )  # fmt: skip
    end, trial = _End.of(kept_fits.recall(place)), None
    if end is None:
        behind = start.horizon if start else 0.0
        stages = [h for h in HORIZONS if behind < h and _share(data_sets, h, longest) < MOST]
        if by_torque:
            trial = attempt(problem, theta, motions, longest)
            if _resembles(trial, weight):
                stages = []  # the torques have led the way
            elif stages:
                trial = attempt(problem, theta, motions, stages[0])
            theta, motions, trial = _around(
                problem, theta, motions, stages[0] if stages else longest, weight,
                min(SETTLING, 2 * iterations), reach, trial,
            )  # fmt: skip
        end, trial = _descend(
            problem, theta, motions, [*stages, longest], weight, iterations, reweight, thorough,
            reach, progress, None if stages else trial,
        )  # fmt: skip
        kept_fits.keep(place, end.numbers())
    values = problem.values(end.theta)
    if sure:
        trial = trial or attempt(problem, end.theta, end.motions, longest)
        covariance, information, sigmas = uncertainty(problem, trial, end.weight)
    else:
        covariance, information, sigmas = not_asked(problem)
    unsettled = len(unsettled_states(model))
    values, covariance = _as_waves_are_written(model, unknowns, values, covariance)
    fitted = _with_uncertainty(model, unknowns, values, covariance)
    result = Fit(
        model=fitted,
        unknowns=unknowns,
        values=values,
        covariance=covariance,
        information=information,
        motions=tuple(end.motions),
        own=problem.own,
        own_sigmas=tuple(s[unsettled:] for s in sigmas),
        starts=_demanded(
            [m[len(t.motion) :][:unsettled] for t, m in zip(data_sets, end.motions, strict=True)],
            [s[:unsettled] for s in sigmas],
        ),
        cost=end.cost,
        mse=end.sse / np.maximum(end.count, 1),
        count=end.count,
        inflation=1 / end.weight,
        horizon=longest,
        evaluations=problem.evaluations,
        seconds=clock.perf_counter() - began,
        refinement=refinement,
        converged=end.converged,
    )
    return replace(result, warnings=tuple(_warnings(result, bounds or ()))) if sure else result


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
    found = _minimise(
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
) -> tuple[_End, Trial | None]:
    """From a start to the minimum: over short horizons, then the last in rounds of weights.

    Given `trial` is the start simulated over the last horizon, where that is the only one and it
    is known; returned are where it came to and the simulations there.
    """
    *stages, longest = horizons
    found = _Descent(theta, motions, None, False, trial)
    at_once = min(iterations, BETWEEN_WEIGHTS_THOROUGH if thorough else BETWEEN_WEIGHTS)
    rounds = max(1, iterations // max(1, at_once))
    for k, horizon in enumerate(stages):
        progress(f'fitting the first {horizon:g} s', k, len(stages) + rounds, _so_far(found))
        # The short horizons only lead the way; the belief of the file keeps them sober.
        ahead = _minimise(
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
        close = found.point is None or _error(found.point) < CLOSE
        drift = LEADING if leads else 0.0 if thorough else DRIFT if close else FAR_DRIFT
        found = _minimise(
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
        weight, damping = new, found.damping if steady else DAMPING
    point = found.point
    assert point is not None
    end = _End(
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


def _minimise(
    problem: Problem,
    theta: np.ndarray,
    motions: list[np.ndarray],
    horizon: float,
    weight: float,
    iterations: int,
    drift: float,
    reach: float,
    leading: bool = False,
    valley: Valley = NEAR,
    damping: float = DAMPING,
    trial: Trial | None = None,
    kept: np.ndarray | None = None,
) -> _Descent:
    lower = np.array(
        [
            u.to_coordinate(max(u.lower, 1e-300) if u.logarithmic else u.lower)
            for u in problem.unknowns
        ]
    )
    upper = np.array([u.to_coordinate(u.upper) for u in problem.unknowns])
    here = trial or attempt(problem, theta, motions, horizon)
    point = here.point(weight) if here is not None else None
    if point is None:
        return _Descent(theta, motions, None, False)
    began = float(point.cost)
    errors = [_error(point)]

    def frozen(theta, point):
        """Unknowns that stay where they are, shape (k,)."""
        _, gradient, _ = reduced(point, 0.0)
        at_bounds = ((theta <= lower) & (gradient > 0)) | ((theta >= upper) & (gradient < 0))
        if kept is not None:
            at_bounds |= kept
        return at_bounds | _unseen(problem, theta, point, weight) if leading else at_bounds

    # The border's weight follows what is still to be gained (a central path): whoever meets the
    # border early creeps along it ever after.
    barrier = max(BARRIER, CENTRAL * min(_promised(point, frozen(theta, point)), point.cost))
    point = point.beside(BARRIER, barrier)

    def end(converged: bool, hopeless: bool = False) -> _Descent:
        assert point is not None
        there = point.beside(barrier, BARRIER)
        return _Descent(
            theta, motions, there, converged, here, hopeless, damping, began - float(there.cost)
        )

    def ahead(theta, motions, point, damping):
        """Where a damped Gauss-Newton step from a point leads."""
        step, factors = _step(point, damping, frozen(theta, point))
        reached = np.clip(theta + _straight(problem, step), lower, upper)
        step = reached - theta
        return attempt(problem, reached, moved(problem, motions, factors, step), horizon)

    def cost_of(trial):
        """Of a trial; infinite where the simulation runs away."""
        return np.inf if trial is None else trial.cost(weight, barrier)

    def point_of(trial):
        """Its normal equations; None where there are none."""
        there = None if trial is None else trial.point(weight)
        return None if there is None else there.beside(BARRIER, barrier)

    for _ in range(iterations):
        check_time()
        if out_of_reach(errors, reach):
            return end(False, hopeless=True)
        trial = ahead(theta, motions, point, damping)
        if trial is not None and here and not cost_of(trial) < point.cost:
            trial = settled(trial, here, weight)
        for _ in range(BACK if _error(point) < CLOSE else 0):
            if not point.cost < cost_of(trial) < valley.uphill * point.cost:
                break
            # A step along a curved valley leaves its floor: back to it, across the valley.
            uphill = point_of(trial)
            if uphill is None:
                break
            back = ahead(trial.theta, trial.motions, uphill, max(valley.across, damping))
            if cost_of(back) > cost_of(trial):
                break
            trial = back
        tried = cost_of(trial)
        candidate = point_of(trial) if tried < point.cost else None
        if candidate is not None:
            gain = point.cost - candidate.cost
            here, theta, motions, point = trial, trial.theta, trial.motions, candidate
            errors.append(_error(point))
            damping = max(damping / 10, 1e-9)
            small = max(drift * candidate.cost, SMALL_GAIN)
            little = gain < small and barrier <= max(BARRIER, CENTRAL * small)
            # A short step gains little too.
            if little and _promised(point, frozen(theta, point)) < small:
                return end(True)
            lower_barrier = max(BARRIER, min(barrier, CENTRAL * gain))
            point, barrier = point.beside(barrier, lower_barrier), lower_barrier
        else:
            if point.cost <= tried < (1 + 1e-9) * point.cost:
                return end(True)
            if damping > SHORT:
                # Before, a step that gains nothing only says that it was too long.
                errors.append(_error(point))
            damping *= 10
            if damping > 1e8:
                # No step is short enough: a minimum, or a corner of what bodies can be.
                return end(bool(point.cost <= tried < np.inf))
    return end(False)


def _error(point: Point) -> float:
    return float(point.sse.sum() / point.count.sum())


def _straight(problem: Problem, step: np.ndarray) -> np.ndarray:
    """A step along which the values of logarithmic unknowns change by what it says at its start.

    Stiffness and inertias make up for each other in proportion to their values: in logarithms
    the valley of the cost would be curved.
    """
    logarithmic = np.array([u.logarithmic for u in problem.unknowns], bool)
    factor = np.log1p(np.maximum(step, -HALF))
    return np.where(logarithmic, np.where(step > -HALF, factor, factor + 2 * (step + HALF)), step)


def _promised(point: Point, frozen: np.ndarray) -> float:
    """What a full step would lower the cost by, were it quadratic."""
    _, gradient, _ = reduced(point, 0.0)
    return float(-gradient @ _step(point, 0.0, frozen)[0])


def _step(point: Point, damping: float, frozen: np.ndarray) -> tuple[np.ndarray, list]:
    h, g, factors = reduced(point, damping)
    # What is left of a curvature may be less than its rounding: nothing, or below. Then it stays.
    curvature = np.diag(h)
    free = ~frozen & (curvature > ROUNDING * np.diag(point.shared_hessian))
    step = np.zeros(len(g))
    if free.any():
        scale = np.sqrt(curvature[free])
        scaled = h[np.ix_(free, free)] / np.outer(scale, scale)
        step[free] = -np.linalg.lstsq(scaled, g[free] / scale, rcond=1e-12)[0] / scale
    return step, factors


def _unseen(problem: Problem, theta: np.ndarray, point: Point, weight: float) -> np.ndarray:
    """Unknowns whose typical change these few seconds do not notice, such as a late push."""
    values = problem.values(theta)
    scales = np.array([u.scale for u in problem.unknowns]) / problem.chain(values)
    return np.diag(point.shared_hessian) * scales**2 < weight


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


def _as_waves_are_written(
    model: Model, unknowns: Sequence[Unknown], values: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The same fit in the one form of a wave that all fits report (Effect.wave)."""
    values, sign = values.copy(), np.ones(len(values))
    place = {u.name: i for i, u in enumerate(unknowns)}
    for effect in model.effects:
        amplitude, phase = (place.get(f'{effect.label}.{n}') for n in effect.wave or ('', ''))
        if amplitude is None or phase is None:
            continue
        if values[amplitude] < 0:
            values[amplitude] *= -1
            values[phase] += np.pi
            sign[amplitude] = -1
        values[phase] = np.pi - (np.pi - values[phase]) % (2 * np.pi)
    return values, covariance * np.outer(sign, sign)


def _with_uncertainty(
    model: Model, unknowns: tuple[Unknown, ...], values: np.ndarray, covariance: np.ndarray
) -> Model:
    model = model.with_values({u.name: v for u, v in zip(unknowns, values, strict=True)})
    quantities = dict(model.quantities)
    for j, (u, v) in enumerate(zip(unknowns, values, strict=True)):
        sigma = np.sqrt(max(covariance[j, j], 0.0)) * (abs(v) if u.logarithmic else 1.0)
        if np.isfinite(sigma):
            quantities[u.name] = replace(
                quantities[u.name], tolerance=float(sigma), source='identified'
            )
    return replace(model, quantities=quantities)


def _warnings(fit: Fit, bounds: Collection[str]):
    sigmas = fit.sigmas
    for u, value, sigma, share in zip(
        fit.unknowns, fit.values, sigmas, fit.information, strict=True
    ):
        if u.name in bounds:
            continue  # the bound is a statement, not a finding
        unit = '' if u.unit == '1' else f' {u.unit}'
        span = u.upper - u.lower
        declared = fit.model.declarations[u.name]
        inside = {'lower': value - u.lower, 'upper': u.upper - value}
        at_edge = any(inside[end] <= 1e-6 * span for end in inside.keys() - declared.ends)
        if at_edge and value != declared.neutral:
            yield f'{u.name} = {value:.4g}{unit} lies at the edge of its range'
        if not np.isfinite(sigma):
            yield f'{u.name} cannot be identified from these records'
        elif u.name in fit.undetermined:
            yield (
                f'{u.name} = {value:.2g} +- {sigma:.2g}{unit} is not determined by these '
                'records: what acts like this need not be what it is named after'
            )
        elif share < 0.2 and np.isfinite(u.tolerance):
            yield (
                f'{u.name} is hardly seen by these records: its value is mostly what the '
                'model file believed'
            )
        if np.isfinite(u.tolerance):
            away = abs(u.to_coordinate(value) - u.to_coordinate(u.prior)) / u.tolerance
            if away > 3:
                yield (
                    f'{u.name} = {value:.4g}{unit} is {away:.1f} tolerances away from what '
                    f'the model file believes ({u.prior:.4g})'
                )
    finite = np.isfinite(np.diag(fit.covariance))
    spread = np.sqrt(np.where(finite, np.diag(fit.covariance), 1))
    for a in range(len(spread)):
        for b in range(a):
            if finite[a] and finite[b] and spread[a] and spread[b]:
                r = fit.covariance[a, b] / (spread[a] * spread[b])
                if abs(r) > 0.98:
                    yield (
                        f'{fit.unknowns[b].name} and {fit.unknowns[a].name} are told apart only '
                        f'poorly: correlation {r:+.3f}'
                    )


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
