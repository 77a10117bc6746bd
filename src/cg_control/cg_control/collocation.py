"""Planning a motion of the hybrid robot: what is asked, and how it is solved.

    min int effort u^2 + time dt   subject to (HS), (ID), (IMP), the ends and the limits   (OCP)

A task is solved coarsely first: a few intervals say whether there is a motion at all, and their
solution starts the fine one. Where a solve from one guess ends in nothing, others follow that
differ in durations and in the pose at the impact.
"""

import logging
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cg_control.trajectory import Phase, Trajectory
from cg_control.transcription import (
    KNOT,
    MEMORY_UNITS,
    RATE_SCALE,
    UNITS,
    Structure,
    Transcription,
    transcribe,
)
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.linearise import DRY_FRICTION
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup

log = logging.getLogger(__name__)

LARGEST_ANGLE, LARGEST_RATE = 1.5, 30.0  # rad, rad/s: bounds of every state
JOINT_FRICTION = (*DRY_FRICTION, 'viscous_friction', 'quadratic_friction')


class PlanningError(ValueError):
    """No motion was found.

    Attributes:
        seconds: Time that was spent.
    """

    def __init__(self, message: str, seconds: float):
        super().__init__(message)
        self.seconds = seconds


class InfeasibleError(PlanningError):
    """From every guess the solver ended where the constraints cannot be brought closer together.

    A local statement: it holds near the guesses.
    """


class UndecidedError(PlanningError):
    """Time or iterations were over before the solver knew."""


@dataclass(frozen=True)
class Box:
    """A set of states between bounds; equal bounds make a point.

    Attributes:
        lower: (q_inner, q_outer) and rates, shape (4,); -inf where free.
        upper: As `lower`.
    """

    lower: np.ndarray
    upper: np.ndarray

    def __post_init__(self):
        for name in ('lower', 'upper'):
            value = np.array(getattr(self, name), float)
            if value.shape != (4,) or np.isnan(value).any():
                raise ValueError(
                    f'{name} of a set of states must be 4 numbers (q_inner, q_outer and rates), '
                    f'got {value.tolist()}'
                )
            object.__setattr__(self, name, value)
        if not (self.lower <= self.upper).all():
            raise ValueError('a set of states has lower bounds above its upper bounds')

    @classmethod
    def point(cls, x: Sequence[float] | np.ndarray) -> 'Box':
        """One state."""
        x = np.array(x, float)
        if x.shape != (4,) or not np.isfinite(x).all():
            raise ValueError(
                f'a state must be 4 finite numbers (q_inner, q_outer and rates), got {x.tolist()}'
            )
        return cls(x, x)

    @classmethod
    def anywhere(cls) -> 'Box':
        """Any state."""
        return cls(np.full(4, -np.inf), np.full(4, np.inf))

    @property
    def center(self) -> np.ndarray:
        """Middle of the bounds, 0 where there are none."""
        with np.errstate(invalid='ignore'):
            middle = (self.lower + self.upper) / 2
        return np.where(np.isfinite(middle), middle, 0.0)


@dataclass(frozen=True)
class Ellipsoid:
    """The states with (x - center)' form (x - center) <= 1, as a basin of attraction.

    Attributes:
        center: Shape (4,).
        form: Shape (4, 4), symmetric, positive definite.
    """

    center: np.ndarray
    form: np.ndarray


UPRIGHT = Box.point(np.zeros(4))


@dataclass(frozen=True)
class Task:
    """What is asked of a motion.

    Attributes:
        modes: Stance leg of each phase.
        start: States to start from.
        goal: States to end in; for a periodic motion bounds that its end must keep.
        periodic: The motion ends with an impact after which it begins anew.
        torque_limit: In N m; None takes the model's.
        rate_limit: Of the torque, N m/s.
        durations: Shortest and longest phase, s.
        effort: Weight of u^2, 1/((N m)^2 s).
        time: Weight of the duration, 1/s.
        slope: Fall of the ground ahead, rad.
        retraction: The swing foot may go this deep below the ground before it is ahead by 2 cm;
            infinite: it is not looked at, as on blocks. m.
        reach: Least step length, m.
        approach: Least rate at which the foot lands, m/s: the instant of a grazing impact is
            not defined well.
    """

    modes: tuple[str, ...]
    start: Box = UPRIGHT
    goal: Box | Ellipsoid = UPRIGHT
    periodic: bool = False
    torque_limit: float | None = None
    rate_limit: float = math.inf
    durations: tuple[float, float] = (0.1, 2.0)
    effort: float = 0.01
    time: float = 0.1
    slope: float = 0.0
    retraction: float = math.inf
    reach: float = 0.1
    approach: float = 0.05

    def __post_init__(self):
        object.__setattr__(self, 'modes', tuple(self.modes))
        for mode in self.modes:
            if mode not in STANCES:
                raise ValueError(f'modes: {mode!r} is not one of {", ".join(STANCES)}')
        if self.torque_limit is not None and not self.torque_limit >= 0:
            raise ValueError(f'torque_limit is {self.torque_limit}; it must not be negative')
        low, high = self.durations
        if not 0 < low < high:
            raise ValueError(f'durations are {self.durations}; they must be positive, increasing')
        if not self.rate_limit > 0 or not self.retraction >= 0:
            raise ValueError('rate_limit must be positive and retraction not negative')

    def structure(self, intervals: int, elastic: bool = False) -> Structure:
        """What has to be compiled for this task."""
        return Structure(
            self.modes,
            (intervals,) * len(self.modes),
            periodic=self.periodic,
            rate_limited=math.isfinite(self.rate_limit),
            clearance=math.isfinite(self.retraction),
            region=isinstance(self.goal, Ellipsoid),
            elastic=elastic,
        )


def planning_model(model: Model, friction: bool = True) -> Model:
    """What is planned on: the model in four states, without delays and sensor errors.

    Args:
        model: The robot.
        friction: Keep what the joints rub. Without it a controller has to add it, as the
            friction compensator of the seed does.
    """
    for effect in model.effects:
        if (
            effect.states
            or effect.extra_inputs
            or effect.place in ('sensor', 'timing')
            or effect.name in ('torque_saturation', 'actuator_delay')
            or (effect.name in JOINT_FRICTION and not friction)
        ):
            model = model.without_effect(effect.label)
    return model


def softened(model: Model) -> Model:
    """The model with dry friction that turns its sign over a wider band of rates.

    A few intervals cannot follow a change within 0.01 rad/s, and need not.
    """
    values = model.values
    return model.with_values({
        name: max(values[name], SOFT_TRANSITION)
        for name in values
        if name.endswith('.transition_rate')
    })


@dataclass(frozen=True)
class Options:
    """How a task is solved.

    Attributes:
        coarse: Intervals a phase of the first solve.
        fine: Intervals a phase of the second.
        guesses: From how many guesses the coarse solve starts, more where those find nothing; the
            cheapest motion is refined.
        coarse_iterations: Of one coarse solve.
        fine_iterations: Of the fine solve.
        tolerance: Of constraints and optimality, in the units of the scaled rows.
        seconds: After which no further solve begins.
    """

    coarse: int = 8
    fine: int = 20
    guesses: int = 3
    coarse_iterations: int = 25
    fine_iterations: int = 100
    tolerance: float = 1e-6
    seconds: float = 10.0


@dataclass(frozen=True)
class Guess:
    """Where a solve starts: half the angle between the legs at impacts in rad, durations in s."""

    half_angle: float
    duration: float


GUESSES = (Guess(0.15, 0.9), Guess(0.25, 0.6), Guess(0.2, 1.4), Guess(0.35, 0.45))
SMALLEST_LIMIT = 0.01  # N m
SOFT_TRANSITION = 0.2  # rad/s
WEAK = 1e-4  # weight of the running cost in the elastic program
MISSED = 0.01  # of the scaled miss: 1 mrad or 3 mrad/s, several times what the weak cost leaves
BALLISTIC = 0.2  # s
ELASTIC_ITERATIONS = 60
FAR = 1.0  # within one phase a miss by so much is believed at once; others must be every guess's


@dataclass(frozen=True)
class Solution:
    """What a solve ended with.

    Attributes:
        converged: Whether the solver says so and the rows hold.
        cost: Of the motion.
        violation: Largest violation of a row or bound, scaled.
        knots: (x, a, u) at the knots of each phase, shapes (n + 1, 7).
        durations: Of the phases, s.
        iterations: Of the solver.
        seconds: That it took.
    """

    converged: bool
    cost: float
    violation: float
    knots: tuple[np.ndarray, ...]
    durations: tuple[float, ...]
    iterations: int
    seconds: float

    def trajectory(self, modes: Sequence[str], model_hash: str, **provenance: Any) -> Trajectory:
        """The motion as a trajectory that begins at time zero."""
        phases, start = [], 0.0
        for mode, knots, duration in zip(modes, self.knots, self.durations, strict=True):
            times = start + np.linspace(0.0, duration, len(knots))
            rates = np.column_stack([knots[:, 2:4], knots[:, 4:6]])
            phases.append(Phase(mode, times, knots[:, :4], rates, knots[:, 6]))
            start = float(times[-1])
        return Trajectory(tuple(phases), model_hash, provenance)

    def resampled(self, intervals: int) -> 'Solution':
        """With other knots: cubic in the states, linear in accelerations and torque."""
        knots = []
        for old, duration in zip(self.knots, self.durations, strict=True):
            times = np.linspace(0.0, duration, len(old))
            rates = np.column_stack([old[:, 2:4], old[:, 4:6]])
            phase = Phase('inner', times, old[:, :4], rates, old[:, 6])
            new = np.linspace(0.0, duration, intervals + 1)
            a = np.column_stack([np.interp(new, times, old[:, j]) for j in (4, 5)])
            u = np.interp(new, times, old[:, 6])
            x = np.array([phase.at(t).state for t in new])
            knots.append(np.column_stack([x, a, u]))
        return replace(self, knots=tuple(knots))


class Program:
    """A task on one grid: bounds, parameters, guesses and answers of a compiled program."""

    def __init__(self, model: Model, task: Task, intervals: int, elastic: bool = False):
        self.task, self.intervals = task, intervals
        self.transcription: Transcription = transcribe(model, task.structure(intervals, elastic))
        limit = model.torque_limit if task.torque_limit is None else task.torque_limit
        # Interior-point methods want room: what is next to nothing is nothing.
        self.limit = min(limit, 1e4) if limit > SMALLEST_LIMIT else 0.0
        # The running cost makes the elastic motion unique and must not compete with its misses.
        weak = WEAK if elastic else 1.0
        self.p = np.concatenate([
            parameter_vector(model, Setup()),
            [
                task.slope,
                weak * task.effort,
                weak * task.time,
                task.retraction if math.isfinite(task.retraction) else 0.0,
                task.reach,
                task.approach,
            ],
            _goal_parameters(task.goal),
        ])  # fmt: skip
        t = self.transcription
        self.lower, self.upper = t.lower.copy(), t.upper.copy()
        if 'rate' in t.rows_of:
            limit = task.rate_limit / RATE_SCALE
            self.lower[t.rows_of['rate']], self.upper[t.rows_of['rate']] = -limit, limit
        self.x_lower, self.x_upper = self._bounds(elastic)

    def _columns(self) -> Iterator[tuple[int, int, int, int]]:
        """(phase, knot, first variable of the stage, its size) in order."""
        offsets, stage = self.transcription.offsets, 0
        for i in range(len(self.task.modes)):
            for k in range(self.intervals + 1):
                yield i, k, int(offsets[stage]), int(offsets[stage + 1] - offsets[stage])
                stage += 1

    def _bounds(self, elastic: bool) -> tuple[np.ndarray, np.ndarray]:
        task, size = self.task, self.transcription.size
        upper = np.full(size, np.inf)
        lower = -upper
        last = (len(task.modes) - 1, self.intervals)
        for i, k, at, _ in self._columns():
            edge = [LARGEST_ANGLE] * 2 + [LARGEST_RATE] * 2
            low, high = -np.array(edge), np.array(edge)
            if (i, k) == (0, 0):
                low, high = np.maximum(low, task.start.lower), np.minimum(high, task.start.upper)
            if (i, k) == last and isinstance(task.goal, Box) and not elastic:
                low, high = np.maximum(low, task.goal.lower), np.minimum(high, task.goal.upper)
            lower[at : at + 4], upper[at : at + 4] = low / UNITS[:4], high / UNITS[:4]
            lower[at + 6], upper[at + 6] = -self.limit / UNITS[6], self.limit / UNITS[6]
            if k == 0:
                lower[at + 7], upper[at + 7] = task.durations
        return lower, upper

    def guess(self, guess: Guess) -> Solution:
        """Straight lines from end to end, by way of the impact poses."""
        task, n = self.task, self.intervals
        knots = []
        for i, mode in enumerate(task.modes):
            pose = guess.half_angle * np.where(np.array(STANCES) == mode, 1.0, -1.0)
            first, last = -pose, pose
            if i == 0 and not task.periodic:
                first = task.start.center[:2]
            if i == len(task.modes) - 1 and not task.periodic:
                goal = task.goal.center
                last = goal[:2]
            share = np.linspace(0.0, 1.0, n + 1)[:, None]
            knot = np.zeros((n + 1, KNOT))
            knot[:, :2] = (1 - share) * first + share * last
            knot[:, 2:4] = (last - first) / guess.duration
            if i == 0 and not task.periodic:
                knot[0, :4] = np.clip(knot[0, :4], task.start.lower, task.start.upper)
            knots.append(knot)
        duration = float(np.clip(guess.duration, *task.durations))
        durations = (duration,) * len(knots)
        return Solution(False, math.inf, math.inf, tuple(knots), durations, 0, 0.0)

    def ballistic(self, guess: Guess) -> Solution:
        """As `guess`, but the first phase is a short coasting from the start.

        It is nearly a motion of the robot, which the elastic program asks for before all else.
        """
        x, lines = np.clip(self.task.start.center, -LARGEST_RATE, LARGEST_RATE), self.guess(guess)
        share = np.linspace(0.0, BALLISTIC, self.intervals + 1)[:, None]
        knots = np.zeros((self.intervals + 1, KNOT))
        knots[:, :2] = x[:2] + share * x[2:]
        knots[:, 2:4] = x[2:]
        duration = float(np.clip(BALLISTIC, *self.task.durations))
        return replace(
            lines,
            knots=(knots, *lines.knots[1:]),
            durations=(duration, *lines.durations[1:]),
        )

    def running_cost(self, solution: Solution) -> float:
        """What torque and time cost, by the weights of the task."""
        total = 0.0
        for knots, duration in zip(solution.knots, solution.durations, strict=True):
            squares = knots[:, 6] ** 2
            mean = (squares[1:] + squares[:-1]).mean() / 2
            total += duration * (self.task.effort * mean + self.task.time)
        return total

    def _packed(self, start: Solution) -> np.ndarray:
        z = np.zeros(self.transcription.size)
        memory = self.transcription.memory
        for i, k, at, size in self._columns():
            nx = self.transcription.nx
            z[at : at + KNOT] = start.knots[i][k] / UNITS
            z[at + 7] = start.durations[i]
            z[at + 8 : at + 8 + memory] = (start.knots[0][0][:4] / MEMORY_UNITS)[:memory]
            if k < self.intervals:
                z[at + nx : at + size] = start.knots[i][k + 1] / UNITS
            elif i < len(self.task.modes) - 1:
                z[at + nx : at + size - 1] = (start.knots[i + 1][0] / UNITS)[4:]
                z[at + size - 1] = start.durations[i + 1]
        return z

    def solve(self, start: Solution, iterations: int, tolerance: float) -> Solution:
        """Solve from a start on the same grid."""
        began = time.perf_counter()
        points = (self.x_lower == self.x_upper).tobytes()
        solver = self.transcription.solver(iterations, tolerance, points)
        try:
            result = solver(
                x0=self._packed(start), lbx=self.x_lower, ubx=self.x_upper,
                lbg=self.lower, ubg=self.upper, p=self.p,
            )  # fmt: skip
        except RuntimeError as error:  # what the solver throws where it meets no number
            log.debug('fatrop gave up: %s', error)
            seconds = time.perf_counter() - began
            return replace(start, converged=False, violation=math.inf, seconds=seconds)
        seconds = time.perf_counter() - began
        z, g = (np.asarray(result[name]).ravel() for name in ('x', 'g'))
        violation = max(
            (self.lower - g).max(), (g - self.upper).max(),
            (self.x_lower - z).max(), (z - self.x_upper).max(), 0.0,
        )  # fmt: skip
        knots: list[list[np.ndarray]] = [[] for _ in self.task.modes]
        durations = [0.0] * len(self.task.modes)
        for i, _, at, _ in self._columns():
            knots[i].append(z[at : at + KNOT] * UNITS)
            durations[i] = float(z[at + 7])
        stats = solver.stats()
        finite = bool(np.isfinite(z).all())
        return Solution(
            bool(stats['success']) and finite and violation < 100 * tolerance,
            float(result['f']),
            float(violation) if finite else math.inf,
            tuple(np.array(phase) for phase in knots),
            tuple(durations),
            int(stats['iter_count']),
            seconds,
        )


def _goal_parameters(goal: Box | Ellipsoid) -> np.ndarray:
    if isinstance(goal, Ellipsoid):
        return np.concatenate([goal.center, np.asarray(goal.form, float).ravel(order='F')])
    return np.clip(np.concatenate([goal.lower, goal.upper]), -1e3, 1e3)


@dataclass(frozen=True)
class Screening:
    """What the coarse solves say.

    Attributes:
        verdict: 'feasible', 'infeasible' or 'undecided'.
        best: The cheapest motion found; None if there is none.
        miss: Least scaled distance by which goal and landing were missed, 0 if feasible.
        seconds: Spent.
    """

    verdict: str
    best: Solution | None
    miss: float
    seconds: float


def screen(model: Model, task: Task, options: Options | None = None) -> Screening:
    """Is there a motion at all? Coarse solves from several guesses.

    Where the solver finds nothing, the elastic program from the same guess brings goal and landing
    as near as it can. If it converges to a miss, the task is infeasible near that guess; if it
    meets them, its motion starts the solver anew.

    Args:
        model: As planned on (`planning_model`).
        task: What is asked.
        options: How.
    """
    options = options or Options()
    began = time.perf_counter()
    strict = Program(model, task, options.coarse)
    elastic: Program | None = None
    best: Solution | None = None
    misses: list[float] = []
    for number, guess in enumerate(GUESSES):
        if best is not None and number >= options.guesses:
            break
        if time.perf_counter() - began > options.seconds:
            break
        found = strict.solve(strict.guess(guess), options.coarse_iterations, options.tolerance)
        if not found.converged and best is None:
            elastic = elastic or Program(model, task, options.coarse, elastic=True)
            start = elastic.guess(guess) if number % 2 else elastic.ballistic(guess)
            near = elastic.solve(start, ELASTIC_ITERATIONS, options.tolerance)
            miss = math.sqrt(max(near.cost - WEAK * elastic.running_cost(near), 0.0))
            if near.converged and miss > MISSED:
                misses.append(miss)
                if miss > FAR and len(task.modes) == 1 and not task.periodic:
                    break
            elif near.converged:
                found = strict.solve(near, options.coarse_iterations, options.tolerance)
        if found.converged and (best is None or found.cost < best.cost):
            best = found
    verdict = 'feasible' if best is not None else 'infeasible' if misses else 'undecided'
    miss = 0.0 if best else min(misses, default=math.inf)
    return Screening(verdict, best, miss, time.perf_counter() - began)


def optimise(
    model: Model, task: Task, options: Options | None = None, friction: bool = True
) -> Trajectory:
    """The cheapest motion found for a task, without feedback.

    Args:
        model: The robot; planned on is its `planning_model`.
        task: What is asked.
        options: How to solve.
        friction: Whether joint friction is part of the plan.

    Raises:
        InfeasibleError: no motion near any guess.
        UndecidedError: the solver came to no conclusion.
    """
    options = options or Options()
    planned = planning_model(model, friction)
    coarse = screen(softened(planned), task, options)
    what = f'{" -> ".join(task.modes)} from {_said(task.start)} to {_said(task.goal)}'
    if coarse.verdict == 'infeasible':
        limit = planned.torque_limit if task.torque_limit is None else task.torque_limit
        raise InfeasibleError(
            f'no motion {what} within {limit:g} N m: the nearest misses goal or landing '
            f'by {coarse.miss:.2g} (1 is 0.1 rad or 0.3 rad/s)',
            coarse.seconds,
        )
    if coarse.best is None:
        raise UndecidedError(
            f'no motion {what} found within {options.guesses} guesses of '
            f'{options.coarse_iterations} iterations or {options.seconds:g} s; there may be one',
            coarse.seconds,
        )
    fine = Program(planned, task, options.fine)
    spent = coarse.seconds
    starts = [coarse.best.resampled(options.fine), *map(fine.guess, GUESSES[: options.guesses])]
    for start in starts:
        found = fine.solve(start, options.fine_iterations, options.tolerance)
        spent += found.seconds
        if found.converged or spent > options.seconds:
            break
    if not found.converged:
        raise UndecidedError(
            f'a coarse motion {what} exists, but {options.fine} intervals a phase do not '
            f'converge within {options.fine_iterations} iterations',
            spent,
        )
    return found.trajectory(
        task.modes,
        model.hash,
        model=model.name,
        friction='planned' if friction else 'to be compensated',
        cost=found.cost,
        method='Hermite-Simpson collocation, fatrop',
        intervals=options.fine,
        periodic=task.periodic,
        slope=task.slope,
        seconds=round(spent, 4),
    )


def _said(ends: Box | Ellipsoid) -> str:
    if isinstance(ends, Box) and not (ends.lower == ends.upper).all():
        return 'a set of states'
    center = ' '.join(f'{value:.3g}' for value in ends.center)
    return f'({center})' if isinstance(ends, Box) else f'a region around ({center})'
