"""A task on one grid: bounds and parameters of a compiled program, guesses, its solutions."""

import logging
import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cg_control.trajectories.task import Box, Ellipsoid, Goal, Stretch, Task
from cg_control.trajectories.trajectory import Phase, Trajectory
from cg_control.trajectories.transcription import (
    KNOT,
    MEMORY_UNITS,
    PIECES,
    RATE_SCALE,
    TORQUE_SCALE,
    UNITS,
    Transcription,
    transcribe,
)
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup

log = logging.getLogger(__name__)

LARGEST_ANGLE, LARGEST_RATE = 1.5, 30.0  # rad, rad/s: bounds of every state
SMALLEST_LIMIT = 0.01  # N m
WEAK = 1e-4  # weight of the running cost in the elastic program
BALLISTIC = 0.2  # s
FAR_AWAY = 1e3  # m


@dataclass(frozen=True)
class Guess:
    """Where a solve starts: half the angle between the legs at impacts in rad, durations in s."""

    half_angle: float
    duration: float


GUESSES = (Guess(0.15, 0.9), Guess(0.25, 0.6), Guess(0.2, 1.4), Guess(0.35, 0.45))


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
        slid: How far along the stretch it ends, s, if the goal is one.
    """

    converged: bool
    cost: float
    violation: float
    knots: tuple[np.ndarray, ...]
    durations: tuple[float, ...]
    iterations: int
    seconds: float
    slid: float = 0.0

    @classmethod
    def of(cls, motion: Trajectory) -> 'Solution':
        """A motion as a place to start from."""
        knots = tuple(
            np.column_stack([phase.states, phase.rates[:, 2:], phase.torque])
            for phase in motion.phases
        )
        durations = tuple(phase.end - phase.start for phase in motion.phases)
        return cls(False, math.inf, math.inf, knots, durations, 0, 0.0)

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

    def __init__(
        self,
        model: Model,
        task: Task,
        intervals: int,
        elastic: bool = False,
        given_back: tuple[str, ...] = (),
    ):
        self.model, self.task, self.intervals = model, task, intervals
        structure = task.structure(intervals, elastic, given_back)
        self.transcription: Transcription = transcribe(model, structure)
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
                min(task.farthest, FAR_AWAY),
            ],
            _goal_parameters(task, weak),
        ])  # fmt: skip
        t = self.transcription
        self.lower, self.upper = t.lower.copy(), t.upper.copy()
        if 'rate' in t.rows_of:
            limit = task.rate_limit / RATE_SCALE
            self.lower[t.rows_of['rate']], self.upper[t.rows_of['rate']] = -limit, limit
        if 'motor' in t.rows_of:
            limit = self.limit / TORQUE_SCALE
            self.lower[t.rows_of['motor']], self.upper[t.rows_of['motor']] = -limit, limit
        if 'reach' in t.rows_of:
            self.upper[t.rows_of['reach']] = task.farthest - task.reach
        if task.total is not None:
            self.lower[t.rows_of['total']], self.upper[t.rows_of['total']] = task.total
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
        if isinstance(task.goal, Stretch):
            lower[-1], upper[-1] = 0.0, task.goal.length
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
        slid = task.goal.length / 2 if isinstance(task.goal, Stretch) else 0.0
        return Solution(False, math.inf, math.inf, tuple(knots), durations, 0, 0.0, slid)

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
        if isinstance(self.task.goal, Stretch):
            total = _remaining_cost(self.task, solution.slid)
        for knots, duration in zip(solution.knots, solution.durations, strict=True):
            squares = knots[:, 6] ** 2
            mean = (squares[1:] + squares[:-1]).mean() / 2
            total += duration * (self.task.effort * mean + self.task.time)
        return total

    def _packed(self, start: Solution) -> np.ndarray:
        z = np.zeros(self.transcription.size)
        first = (start.knots[0][0][:4] / MEMORY_UNITS)[: self.transcription.memory]
        for i, k, at, size in self._columns():
            nx = self.transcription.nx
            z[at : at + KNOT] = start.knots[i][k] / UNITS
            z[at + 7] = start.durations[i]
            z[at + 8 : at + 8 + len(first)] = first
            if self.task.total is not None:
                z[at + nx - 1] = sum(start.durations[:i])
            if k < self.intervals:
                z[at + nx : at + size] = start.knots[i][k + 1] / UNITS
            elif i < len(self.task.modes) - 1:
                z[at + nx : at + size - 1] = (start.knots[i + 1][0] / UNITS)[4:]
                z[at + size - 1] = start.durations[i + 1]
        if self.transcription.slides:
            z[-1] = start.slid
        return z

    def solve(self, start: Solution, iterations: int, tolerance: float) -> Solution:
        """Solve from a start on the same grid."""
        began = time.perf_counter()
        points = (self.x_lower == self.x_upper).tobytes()
        equality = self.lower == self.upper
        solver = self.transcription.solver(iterations, tolerance, equality, points)
        try:
            result = solver(
                x0=self._packed(start), lbx=self.x_lower, ubx=self.x_upper,
                lbg=self.lower, ubg=self.upper, p=self.p,
            )  # fmt: skip
        except RuntimeError as error:  # what the solver throws where it meets no number
            log.debug('fatrop gave up: %s', error)
            # How many iterations it made is not known then; a budget counts them all.
            return replace(
                start, converged=False, violation=math.inf, iterations=iterations,
                seconds=time.perf_counter() - began,
            )  # fmt: skip
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
            float(z[-1]) if self.transcription.slides else 0.0,
        )


def _goal_parameters(task: Task, weight: float) -> np.ndarray:
    goal: Goal = task.goal
    if isinstance(goal, Stretch):
        # Pieces that are not there begin beyond what bounds allow.
        edges = np.zeros((PIECES, 4, 5))
        edges[: len(goal.span), :, :4] = goal.edges[:, :, 1:]
        edges[: len(goal.span), :, 4] = weight * _costs_to_go(task)
        start = np.full(PIECES, 1e3)
        start[: len(goal.span)] = np.cumsum(goal.span) - goal.span
        form = np.zeros(0) if goal.form is None else goal.form.ravel(order='F')
        return np.concatenate([start, edges.ravel(), form])
    if isinstance(goal, Ellipsoid):
        return np.concatenate([goal.center, np.asarray(goal.form, float).ravel(order='F')])
    return np.clip(np.concatenate([goal.lower, goal.upper]), -1e3, 1e3)


def _costs_to_go(task: Task) -> np.ndarray:
    """Cost from a point of the stretch to its end, as powers of the time since a node: (n, 4)."""
    goal = task.goal
    assert isinstance(goal, Stretch)
    a, b, h = goal.edges[:, 0, 0], goal.edges[:, 1, 0], goal.span
    # u0 = a + b t; minus the integral of effort u0^2 + time.
    powers = -np.column_stack(
        [
            np.zeros(len(h)),
            task.effort * a**2 + task.time,
            task.effort * a * b,
            task.effort * b**2 / 3,
        ]
    )
    spent = (powers * h[:, None] ** np.arange(4.0)).sum(axis=1)
    powers[:, 0] = -np.cumsum(spent[::-1])[::-1]
    return powers


def _remaining_cost(task: Task, s: float) -> float:
    """What the rest of the stretch costs from s on."""
    goal = task.goal
    assert isinstance(goal, Stretch)
    node, since = goal.place(s)
    piece = int(np.flatnonzero(goal.node == node)[0])
    return float(since ** np.arange(4.0) @ _costs_to_go(task)[piece])
