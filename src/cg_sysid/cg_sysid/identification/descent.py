"""Descent of the simulation error over one horizon, under given weights.

Gauss-Newton with Levenberg-Marquardt damping, inside the bounds of the unknowns and of what bodies
can be. The floor of this cost is narrow and curved, so a step uphill is followed by some across
the valley; and the border of consistency comes near along a central path.
"""

from dataclasses import dataclass

import numpy as np

from cg_sysid.deadline import check_time
from cg_sysid.identification.hope import out_of_reach
from cg_sysid.identification.simulation_error import (
    BARRIER,
    Point,
    Problem,
    Trial,
    attempt,
    moved,
    reduced,
    settled,
)

SMALL_GAIN = 0.1  # squared standard deviations: nobody would call one fit better than another
CENTRAL = 1e-2  # weight of the border of consistency over what is still to be gained, [1]
BACK = 5  # steps across a valley after one uphill, at most
CLOSE = 1e4  # chi2/N; farther from the noise nobody needs the floor of a valley
ROUNDING = 1e-12  # share of a curvature that elimination of other unknowns may leave by chance
HALF = 0.5  # share that a step takes off a positive value, before it takes less than it says
DAMPING = 1e-3  # of the first step
SHORT = 0.5  # damping from which a step is short


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
class Descent:
    """Where a minimisation came to; without a point where the simulation runs away."""

    theta: np.ndarray
    motions: list[np.ndarray]
    point: Point | None
    converged: bool
    trial: Trial | None = None  # the simulations of that point, over the horizon of the search
    hopeless: bool = False
    damping: float = DAMPING  # with which to go on
    gained: float = np.inf  # of the cost


def minimise(
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
) -> Descent:
    """From a point downhill, until little is to be gained.

    Args:
        problem: What is simulated, and the unknowns.
        theta: Coordinates of the unknowns, shape (k,).
        motions: What each data set has of its own.
        horizon: Use only this much of each record, in s.
        weight: Of the residual in the cost.
        iterations: At most.
        drift: Relative change of the cost at which this has converged.
        reach: chi2/N that matters, as of `identify.fit`.
        leading: Unknowns that this horizon does not notice stay where they are.
        valley: How far steps may leave its floor.
        damping: Of the first step.
        trial: The start, where it has been simulated already.
        kept: Unknowns that stay where they are, shape (k,).
    """
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
        return Descent(theta, motions, None, False)
    began = float(point.cost)
    errors = [error_of(point)]

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

    def end(converged: bool, hopeless: bool = False) -> Descent:
        assert point is not None
        there = point.beside(barrier, BARRIER)
        return Descent(
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
        for _ in range(BACK if error_of(point) < CLOSE else 0):
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
            errors.append(error_of(point))
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
                errors.append(error_of(point))
            damping *= 10
            if damping > 1e8:
                # No step is short enough: a minimum, or a corner of what bodies can be.
                return end(bool(point.cost <= tried < np.inf))
    return end(False)


def error_of(point: Point) -> float:
    """chi2/N at a point, all data sets and outputs together."""
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
