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
    without_unnoticed,
)

SMALL_GAIN = 0.1  # squared standard deviations: nobody would call one fit better than another
CENTRAL = 1e-2  # weight of the border of consistency over what is still to be gained, [1]
BACK = 5  # steps across a valley after one uphill, at most
CLOSE = 1e4  # chi2/N; farther from the noise nobody needs the floor of a valley
ROUNDING = 1e-12  # share of a curvature that elimination of other unknowns may leave by chance
HALF = 0.5  # share that a step takes off a positive value, before it takes less than it says
DAMPING, LEAST_DAMPING = 1e-3, 1e-13  # of the first step, and of any
ALONG = 0.1  # of what is still to be gained: a step that gains less has met the floor of a valley
LEAP = 1e3  # ratio of its damping to that of the next, as long as no step was too long
ALIKE = 0.5  # ratio from which one damping is no less than another: it changes by factors of ten
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
        leading: What this horizon does not notice stays where it is, such as a late push.
        valley: How far steps may leave its floor.
        damping: Of the first step.
        trial: The start, where it has been simulated already.
        kept: Unknowns that stay where they are, shape (k,).
    """
    start = trial or attempt(problem, theta, motions, horizon)
    if start is None or start.point(weight) is None:
        return Descent(theta, motions, None, False)
    way = _Way(problem, horizon, weight, leading, valley, kept, start, theta, motions, damping)
    for _ in range(iterations):
        check_time()
        if out_of_reach(way.errors, reach):
            return way.end(False, hopeless=True)
        converged = way.step(drift)
        if converged is not None:
            return way.end(converged)
    return way.end(False)


class _Way:
    """The way downhill from a trial that can be simulated: where it is, and how to go on.

    Attributes:
        errors: chi2/N of all points so far, and again that of one from which no step gained.
    """

    def __init__(
        self,
        problem: Problem,
        horizon: float,
        weight: float,
        leading: bool,
        valley: Valley,
        kept: np.ndarray | None,
        start: Trial,
        theta: np.ndarray,
        motions: list[np.ndarray],
        damping: float,
    ):
        self._problem, self._horizon, self._weight = problem, horizon, weight
        self._leading, self._valley, self._kept = leading, valley, kept
        ends = np.array([u.ends for u in problem.unknowns]).reshape(-1, 2)
        self._lower, self._upper = ends.T
        point = self._of_steps(start.point(weight))
        assert point is not None
        self._here, self._theta, self._motions, self._damping = start, theta, motions, damping
        self._too_long = False  # whether a step was
        self._little_at = np.inf  # damping of the last step, if that gained little
        self._began, self.errors = float(point.cost), [error_of(point)]
        # The border's weight follows what is still to be gained (a central path): whoever meets
        # the border early creeps along it ever after.
        promised = _promised(point, self._frozen(theta, point))
        self._barrier = max(BARRIER, CENTRAL * min(promised, point.cost))
        self._point = point.beside(BARRIER, self._barrier)

    def end(self, converged: bool, hopeless: bool = False) -> Descent:
        """Where it has come to."""
        there = self._point.beside(self._barrier, BARRIER)
        return Descent(
            self._theta, self._motions, there, converged, self._here, hopeless, self._damping,
            self._began - float(there.cost),
        )  # fmt: skip

    def step(self, drift: float) -> bool | None:
        """One step, taken where it gains.

        Returns:
            None to go on; else whether this is a minimum.
        """
        trial = self._ahead(self._theta, self._motions, self._point, self._damping)
        if trial is not None and not self._cost(trial) < self._point.cost:
            trial = settled(trial, self._here, self._weight)
        trial = self._back(trial)
        tried = self._cost(trial)
        there = self._normal(trial) if tried < self._point.cost else None
        if trial is None or there is None:
            return self._shortened(tried)
        return self._taken(trial, there, drift)

    def _back(self, trial: Trial | None) -> Trial | None:
        """After a step uphill, back to the floor of its valley."""
        for _ in range(BACK if error_of(self._point) < CLOSE else 0):
            if not self._point.cost < self._cost(trial) < self._valley.uphill * self._point.cost:
                break
            uphill = self._normal(trial)
            if trial is None or uphill is None:
                break
            damping = max(self._valley.across, self._damping)
            back = self._ahead(trial.theta, trial.motions, uphill, damping)
            if self._cost(back) > self._cost(trial):
                break
            trial = back
        return trial

    def _taken(self, trial: Trial, there: Point, drift: float) -> bool | None:
        gain = self._point.cost - there.cost
        self._here, self._theta, self._motions = trial, trial.theta, trial.motions
        self._point = there
        self.errors.append(error_of(there))
        promised = _promised(there, self._frozen(self._theta, there))
        # Most of what is to be gained lies along the floor, where damped steps do not go.
        leap = self._valley is FAR and gain < ALONG * promised and not self._too_long
        taken_at = self._damping
        self._damping = max(self._damping / (LEAP if leap else 10), LEAST_DAMPING)
        small = max(drift * there.cost, SMALL_GAIN)
        little = gain < small and self._barrier <= max(BARRIER, CENTRAL * small)
        # A short step gains little too; but where a longer one has failed since the last, none
        # keeps what the equations promise.
        stuck = taken_at > ALIKE * self._little_at
        self._little_at = taken_at if little else np.inf
        if little and (promised < small or stuck):
            return True
        lower = max(BARRIER, min(self._barrier, CENTRAL * gain))
        self._point, self._barrier = there.beside(self._barrier, lower), lower
        return None

    def _shortened(self, tried: float) -> bool | None:
        """A shorter step next time; `tried` is the cost of this one."""
        if self._point.cost <= tried < (1 + 1e-9) * self._point.cost:
            return True
        self._too_long = True
        if self._damping > SHORT:
            # Before, a step that gains nothing only says that it was too long.
            self.errors.append(error_of(self._point))
        self._damping *= 10
        if self._damping > 1e8:
            # No step is short enough: a minimum, or a corner of what bodies can be.
            return bool(self._point.cost <= tried < np.inf)
        return None

    def _frozen(self, theta: np.ndarray, point: Point) -> np.ndarray:
        """Unknowns that stay where they are, shape (k,)."""
        _, gradient, _ = reduced(point, 0.0)
        held = (theta <= self._lower) & (gradient > 0) | (theta >= self._upper) & (gradient < 0)
        if self._kept is not None:
            held |= self._kept
        if self._leading:
            held |= _unseen(self._problem, theta, point, self._weight)
        return held

    def _ahead(
        self, theta: np.ndarray, motions: list[np.ndarray], point: Point, damping: float
    ) -> Trial | None:
        """Where a damped Gauss-Newton step from a point leads."""
        step, factors = _step(point, damping, self._frozen(theta, point))
        reached = np.clip(theta + _straight(self._problem, step), self._lower, self._upper)
        motions = moved(self._problem, motions, factors, reached - theta)
        return attempt(self._problem, reached, motions, self._horizon)

    def _cost(self, trial: Trial | None) -> float:
        """Of a trial; infinite where the simulation runs away."""
        return np.inf if trial is None else trial.cost(self._weight, self._barrier)

    def _normal(self, trial: Trial | None) -> Point | None:
        """Its normal equations; None where there are none."""
        there = self._of_steps(None if trial is None else trial.point(self._weight))
        return None if there is None else there.beside(BARRIER, self._barrier)

    def _of_steps(self, point: Point | None) -> Point | None:
        """A point as the steps of this search have it."""
        if point is None or not (self._leading and self._problem.own):
            return point
        return without_unnoticed(self._problem, point, self._weight)


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
