"""Walking orbits: periodic motions of two steps, for a demanded speed and step length.

A gait of this robot repeats after two steps, as its leg pairs differ. `plan_orbit` finds the one
with the least int u^2 dt among those whose steps have the demanded length each, and whose two
durations, the split being free, make the demanded mean speed. It is then moved to the nearest
motion of the exact hybrid model (`closing.py`).
"""

import functools
import math
from dataclasses import dataclass, replace

import numpy as np
import scipy

from cg_control.friction import friction_parameters, friction_torque
from cg_control.orbits.closing import closed, half_angle
from cg_control.trajectories.collocation import Options, PlanningError, optimise, planning_model
from cg_control.trajectories.program import Guess
from cg_control.trajectories.task import Box, Task
from cg_control.trajectories.trajectory import Phase, Trajectory
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_dynamics.walking.contact import Ground
from cg_dynamics.walking.hybrid import swing_foot
from cg_dynamics.walking.impact import Impact, impact
from cg_dynamics.walking.unpinned import ground_reaction

PASSED = 0.02  # m the swing foot must be ahead for an impact: WalkOptions.minimum_step
SAMPLES = 20  # of an interval, where a motion is measured
SHORTEST = 0.1  # s of a phase
KEPT_ABOVE = 0.02  # m of retraction that a second search allows
INTERVALS = 25


@dataclass(frozen=True)
class Orbit:
    """A periodic motion of two steps, and the robot that makes it.

    Attributes:
        trajectory: Phases 'inner', 'outer'; its torque is what is left for the motion, without
            the friction that a controller gives back.
        model: The robot.
    """

    trajectory: Trajectory
    model: Model

    @functools.cached_property
    def planned(self) -> Model:
        """The model whose exact motion the trajectory is."""
        return planning_model(self.model, friction=False)

    @property
    def slope(self) -> float:
        """Fall of the ground ahead, rad."""
        return float(self.trajectory.provenance.get('slope', 0.0))

    @property
    def period(self) -> float:
        """Of both steps, s."""
        return self.trajectory.duration

    @property
    def step_lengths(self) -> tuple[float, ...]:
        """From foot to foot along the ground at each impact, m."""
        l = self.model.values['leg_length']
        return tuple(
            math.hypot(*swing_foot(phase.states[-1], phase.stance, l))
            for phase in self.trajectory.phases
        )

    @property
    def speed(self) -> float:
        """Mean along the ground, m/s."""
        return sum(self.step_lengths) / self.period

    @property
    def impacts(self) -> tuple[Impact, ...]:
        """What happens at the end of each phase."""
        return tuple(
            impact(self.planned, phase.stance, phase.states[-1])
            for phase in self.trajectory.phases
        )

    @functools.cached_property
    def samples(self) -> tuple['Sampled', ...]:
        """Each phase between its knots."""
        return tuple(Sampled.of(phase, self.model, self.slope) for phase in self.trajectory.phases)

    @property
    def peak_torque(self) -> float:
        """Largest torque of the motor, with the friction that it gives back, N m."""
        return max(float(np.abs(sampled.motor).max()) for sampled in self.samples)

    @property
    def cost_of_transport(self) -> float:
        """Mechanical: int |P| dt / (m g d), P the power of the motor, d the way."""
        return self._transport(np.abs)

    @property
    def positive_cost_of_transport(self) -> float:
        """As if braking cost nothing: int max(P, 0) dt / (m g d)."""
        return self._transport(lambda power: np.maximum(power, 0.0))

    def _transport(self, counted) -> float:
        work = sum(float(np.trapezoid(counted(s.power), s.time)) for s in self.samples)
        weight = self.model.values['total_mass'] * self.model.values['gravity']
        return work / (weight * sum(self.step_lengths))

    @functools.cached_property
    def ground_forces(self) -> tuple[np.ndarray, ...]:
        """(along, off) the ground on the stance foot at the samples of each phase, N: (n, 2)."""
        ground = Ground(self.slope)
        axes = np.column_stack([ground.tangent, ground.normal])
        return tuple(
            ground_reaction(self.planned, s.stance, s.states, s.torque[:, None]) @ axes
            for s in self.samples
        )

    @property
    def least_load(self) -> float:
        """Least force off the ground on the stance foot, N; the foot must be pushed."""
        return min(float(force[:, 1].min()) for force in self.ground_forces)

    @property
    def friction_needed(self) -> float:
        """Friction of the ground without which the stance foot slides."""
        return max(float(np.abs(f[:, 0] / f[:, 1]).max()) for f in self.ground_forces)

    @property
    def impact_friction_needed(self) -> float:
        """Friction of the ground without which a foot slides as it lands."""
        ground, impulses = Ground(self.slope), [struck.impulse for struck in self.impacts]
        return max(float(abs(P @ ground.tangent / (P @ ground.normal))) for P in impulses)

    @property
    def foot_depth(self) -> float:
        """How deep the extended swing foot would be in the ground: what it must retract, m."""
        return max(0.0, *(-float(sampled.height.min()) for sampled in self.samples))

    @property
    def problem(self) -> str:
        """Why the robot cannot walk so: the foot is pulled, or lands early; '' if it can."""
        normal = Ground(self.slope).normal
        if self.least_load <= 0:
            return f'the ground would have to pull at the foot, by {-self.least_load:.3g} N'
        for sampled, struck in zip(self.samples, self.impacts, strict=True):
            if sampled.lands_early:
                return f'the {sampled.stance} phase ends early: its swing foot lands before'
            if struck.impulse @ normal <= 0:
                return f'the impact that ends the {sampled.stance} phase pulls at the foot'
            if struck.foot_velocity @ normal < 0:
                return f'after the {sampled.stance} phase its foot would move into the ground'
        return ''


@dataclass(frozen=True)
class Sampled:
    """A phase between its knots, cubic as a trajectory is.

    Attributes:
        stance: Leg that stands.
        time: Shape (n,), s.
        states: Shape (n, 4).
        torque: That is left for the motion, shape (n,), N m.
        motor: With what joint friction takes, shape (n,), N m.
        power: Of the motor, shape (n,), W.
        reach: How far the swing foot is ahead, shape (n,), m.
        height: Of the extended swing foot above the ground, shape (n,), m.
    """

    stance: str
    time: np.ndarray
    states: np.ndarray
    torque: np.ndarray
    motor: np.ndarray
    power: np.ndarray
    reach: np.ndarray
    height: np.ndarray

    @classmethod
    def of(cls, phase: Phase, model: Model, slope: float) -> 'Sampled':
        """A phase of a robot on a slope."""
        knots = np.arange(len(phase.time))
        time = np.interp(np.linspace(0, knots[-1], SAMPLES * knots[-1] + 1), knots, phase.time)
        cubic = scipy.interpolate.CubicHermiteSpline(phase.time, phase.states, phase.rates)
        states, torque = cubic(time), np.interp(time, phase.time, phase.torque)
        slip = states[:, 2] - states[:, 3]
        hip = states[:, 0] - states[:, 1]
        taken = friction_torque(model)(hip[None], slip[None], friction_parameters(model))
        motor = torque + np.asarray(taken).ravel()
        standing = STANCES.index(phase.stance)
        stance, swing = states[:, standing], states[:, 1 - standing]
        l = model.values['leg_length']
        reach = l * (np.sin(stance) - np.sin(swing))
        height = l * (np.cos(stance) - np.cos(swing)) + reach * math.tan(slope)
        return cls(phase.stance, time, states, torque, motor, motor * slip, reach, height)

    @property
    def lands_early(self) -> bool:
        """Whether the foot comes down through the ground, ahead, before the end."""
        down = (self.height[:-1] > 0) & (self.height[1:] <= 0) & (self.reach[1:] > PASSED)
        return bool(down[:-1].any())


def plan_orbit(
    model: Model,
    speed: float,
    step_length: float,
    slope: float = 0.0,
    torque_limit: float | None = None,
    retraction: float = math.inf,
    approach: float = 0.05,
    near: Orbit | None = None,
    options: Options | None = None,
) -> Orbit:
    """The cheapest orbit found for a demand.

    Args:
        model: The robot; its friction is left to be compensated.
        speed: Mean along the ground, m/s.
        step_length: Of both steps, along the ground, m.
        slope: Fall of the ground ahead, rad.
        torque_limit: Of the motor, friction included, N m; None takes the model's.
        retraction: As in a `Task`.
        approach: As in a `Task`; a foot that lands steeper needs less friction of the ground.
        near: An orbit of a similar demand, from which the search starts.
        options: Of the optimisation; by default guesses fit the demand.

    Raises:
        ValueError: for a demand without meaning.
        PlanningError: if no orbit was found, or the robot could not walk on it.
    """
    if not (speed > 0 and math.isfinite(speed)):
        raise ValueError(f'speed is {speed} m/s; it must be positive')
    if not 0 < step_length < 2 * model.values['leg_length']:
        raise ValueError(
            f'step_length is {step_length} m; it must be positive and below twice the leg length'
        )
    period = 2 * step_length / speed
    reach = step_length * math.cos(slope)
    task = Task(
        ('inner', 'outer'), Box.anywhere(), Box.anywhere(), periodic=True,
        torque_limit=torque_limit, slope=slope, retraction=retraction, reach=reach,
        farthest=reach, approach=approach, total=(period, period),
        durations=(SHORTEST, period - SHORTEST),
    )  # fmt: skip
    if options is None:
        durations = (period / 2, 0.8, 0.3 * period)
        angle = half_angle(model, step_length)
        starts = tuple(Guess(angle, duration) for duration in durations)
        options = Options(fine=INTERVALS, starts=starts, coarse_iterations=60)
    start = None if near is None else _hastened(near.trajectory, period / near.period)
    try:
        return _orbit(model, task, options, start, step_length)
    except PlanningError as error:
        # What keeps its foot above the ground is an orbit all the same, and found elsewhere.
        if retraction <= KEPT_ABOVE:
            raise
        try:
            careful = replace(task, retraction=KEPT_ABOVE)
            return _orbit(model, careful, options, start, step_length)
        except PlanningError as again:
            error.iterations += again.iterations
        raise error from None


def _orbit(
    model: Model, task: Task, options: Options, start: Trajectory | None, step_length: float
) -> Orbit:
    plan = optimise(model, task, options, friction=False, near=start)
    assert task.total is not None, 'an orbit has a period'
    orbit = Orbit(
        closed(
            plan, planning_model(model, friction=False), half_angle(model, step_length),
            task.total[0], task.slope,
        ),
        model,
    )  # fmt: skip
    if orbit.problem:
        speed = 2 * step_length / task.total[0]
        raise PlanningError(
            f'at {speed:g} m/s with steps of {step_length:g} m {orbit.problem}',
            plan.provenance['iterations'],
        )
    return orbit


def _hastened(motion: Trajectory, ratio: float) -> Trajectory:
    """The same path in another time."""
    phases = tuple(
        replace(
            phase,
            time=phase.time * ratio,
            states=phase.states / [1, 1, ratio, ratio],
            rates=phase.rates / [ratio, ratio, ratio**2, ratio**2],
        )
        for phase in motion.phases
    )
    return motion.with_phases(phases)
