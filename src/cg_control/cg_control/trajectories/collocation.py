"""Planning a motion of the hybrid robot: coarse, then fine; infeasible told from undecided.

    min int effort u^2 + time dt   subject to (HS), (ID), (IMP), the ends and the limits   (OCP)

A task is solved coarsely first: a few intervals say whether there is a motion at all, and their
solution starts the fine one. Where a solve from one guess ends in nothing, others follow that
differ in durations and in the pose at the impact.

Dry friction turns its sign within some 0.01 rad/s, in the middle of an interval, and costs
collocation its order however fine the mesh. So u is the torque that is left for the motion: what
friction takes is given back on top of it, by the plan with knots of its own where the hip rate
changes sign, or by the controller; the limit is that of both together.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy

from cg_control.friction import compensated, friction_parameters, friction_torque, known_beforehand
from cg_control.trajectories.program import GUESSES, SMALLEST_LIMIT, WEAK, Guess, Program, Solution
from cg_control.trajectories.task import Box, Goal, Stretch, Task
from cg_control.trajectories.trajectory import Phase, Trajectory
from cg_description.model_file import Quantity
from cg_dynamics.linearise import without_extra_states
from cg_dynamics.model import Model

TURNING = 0.03  # rad/s, within which dry friction turns its sign
SLOW, FINER = 0.1, 5  # rad/s below which an interval gets so many times the knots
SOFT_TRANSITION = 0.2  # rad/s
MISSED = 0.01  # of the scaled miss: 1 mrad or 3 mrad/s, several times what the weak cost leaves
ELASTIC_ITERATIONS = 60
FAR = 1.0  # within one phase a miss by so much is believed at once; others must be every guess's


class PlanningError(ValueError):
    """No motion was found.

    Attributes:
        iterations: Of the solver that were spent.
    """

    def __init__(self, message: str, iterations: int):
        super().__init__(message)
        self.iterations = iterations


class InfeasibleError(PlanningError):
    """From every guess the solver ended where the constraints cannot be brought closer together.

    A local statement: it holds near the guesses.
    """


class UndecidedError(PlanningError):
    """Iterations were over before the solver knew."""


def planning_model(model: Model, friction: bool = True) -> Model:
    """What is planned on: the model in four states, without delays and sensor errors.

    Args:
        model: The robot.
        friction: Keep what the joints rub. Without it a controller has to add it, as the
            friction compensator of the thesis does: what it gives back is left out here.
    """
    model = without_extra_states(model)
    for effect in model.effects:
        limit = effect.torque_limit(model.values_of(effect))
        if limit < model.torque_limit:
            model = _limited(model, effect.site, limit)
        if (
            effect.place in ('sensor', 'timing')
            or math.isfinite(limit)
            or (compensated(effect) and not friction)
        ):
            model = model.without_effect(effect.label)
    return model


def _limited(model: Model, joint: str, limit: float) -> Model:
    """The model with this limit of a joint's actuator: a bound of the plan, not a corner."""
    index = list(model.mechanism.joints).index(joint)
    channel, unit = model.mechanism.inputs[index], model.mechanism.input_units[index]
    stated = {**model.actuators.get(channel, {}), 'limit': Quantity(limit, unit)}
    return replace(model, actuators={**model.actuators, channel: stated})


def softened(model: Model, labels: tuple[str, ...] | None = None) -> Model:
    """The model with dry friction that turns its sign over a wider band of rates.

    A few intervals cannot follow a change within 0.01 rad/s, and need not.

    Args:
        model: Any.
        labels: Of the effects that are softened; None: all.
    """
    beginnings = tuple(f'{label}.' for label in labels or ())
    return model.with_values(
        {
            name: max(model.values[name], SOFT_TRANSITION)
            for name, parameter in model.declarations.items()
            if parameter.smoothing and (labels is None or name.startswith(beginnings))
        }
    )


@dataclass(frozen=True)
class Options:
    """How a task is solved.

    Attributes:
        coarse: Intervals a phase of the first solve; as many as `fine`: there is no second one.
        fine: Intervals a phase of the second.
        guesses: From how many guesses the coarse solve starts, more where those find nothing; the
            cheapest motion is refined.
        starts: The guesses, in the order in which they are tried.
        elastic: Where a solve finds nothing, ask the elastic program. Without it a search that
            finds nothing is cheap and undecided.
        coarse_iterations: Of one coarse solve.
        fine_iterations: Of the fine solve.
        tolerance: Of constraints and optimality, in the units of the scaled rows.
        iterations: Of the solver in all solves, after which no further one begins; a search cut
            short is undecided. The default never cuts the default search short. No clock takes
            part, so that a plan does not depend on what else the machine does.
    """

    coarse: int = 8
    fine: int = 20
    guesses: int = 3
    starts: tuple[Guess, ...] = GUESSES
    elastic: bool = True
    coarse_iterations: int = 25
    fine_iterations: int = 100
    tolerance: float = 1e-6
    iterations: int = 1000


@dataclass(frozen=True)
class Screening:
    """What the coarse solves say.

    Attributes:
        verdict: 'feasible', 'infeasible' or 'undecided'.
        best: The cheapest motion found; None if there is none.
        miss: Least scaled distance by which goal and landing were missed, 0 if feasible.
        iterations: Of the solver that were spent.
    """

    verdict: str
    best: Solution | None
    miss: float
    iterations: int


def given_back(model: Model, task: Task, friction: bool) -> tuple[str, ...]:
    """Labels of the effects whose torque the motor gives back on top of the planned one.

    Args:
        model: The robot.
        task: Its torque limit counts: without torque nothing is given back.
        friction: False: the controller gives back all joint friction.
    """
    limit = model.torque_limit if task.torque_limit is None else task.torque_limit
    effects = planning_model(model).effects
    # A command that does not reach the joint as it is leaves dry friction to the dynamics.
    changed = any(effect.place in ('command', 'transmission') for effect in effects)
    if limit <= SMALLEST_LIMIT or (friction and changed):
        return ()
    return tuple(
        effect.label
        for effect in effects
        if known_beforehand(effect) and (not friction or effect.friction == 'dry')
    )


def screen(
    model: Model,
    task: Task,
    options: Options | None = None,
    given_back: tuple[str, ...] = (),
) -> Screening:
    """Is there a motion at all? Coarse solves from several guesses.

    Where the solver finds nothing, the elastic program from the same guess brings goal and landing
    as near as it can. If it converges to a miss, the task is infeasible near that guess; if it
    meets them, its motion starts the solver anew.

    Args:
        model: As planned on (`planning_model`).
        task: What is asked.
        options: How.
        given_back: As in a `Structure`.
    """
    options = options or Options()
    spent = 0
    strict = Program(model, task, options.coarse, False, given_back)
    elastic: Program | None = None
    best: Solution | None = None
    misses: list[float] = []
    cut_short = False
    for number, guess in enumerate(options.starts):
        if best is not None and number >= options.guesses:
            break
        if spent >= options.iterations:
            cut_short = True
            break
        found = strict.solve(strict.guess(guess), options.coarse_iterations, options.tolerance)
        spent += found.iterations
        if options.elastic and not found.converged and best is None:
            elastic = elastic or Program(model, task, options.coarse, True, given_back)
            start = elastic.guess(guess) if number % 2 else elastic.ballistic(guess)
            near = elastic.solve(start, ELASTIC_ITERATIONS, options.tolerance)
            spent += near.iterations
            miss = math.sqrt(max(near.cost - WEAK * elastic.running_cost(near), 0.0))
            if near.converged and miss > MISSED:
                misses.append(miss)
                if miss > FAR and len(task.modes) == 1 and not task.periodic:
                    break
            elif near.converged:
                found = strict.solve(near, options.coarse_iterations, options.tolerance)
                spent += found.iterations
        if found.converged and (best is None or found.cost < best.cost):
            best = found
    if best is not None:
        verdict = 'feasible'
    else:
        verdict = 'infeasible' if misses and not cut_short else 'undecided'
    miss = 0.0 if best else min(misses, default=math.inf)
    return Screening(verdict, best, miss, spent)


def optimise(
    model: Model,
    task: Task,
    options: Options | None = None,
    friction: bool = True,
    near: Trajectory | None = None,
) -> Trajectory:
    """The cheapest motion found for a task, without feedback.

    Args:
        model: The robot; planned on is its `planning_model`.
        task: What is asked.
        options: How to solve.
        friction: Whether joint friction is part of the plan.
        near: A motion of a similar task: the fine solve starts there, and where that converges
            there is no search.

    Raises:
        InfeasibleError: no motion near any guess.
        UndecidedError: the solver came to no conclusion.
    """
    options = options or Options()
    returned = given_back(model, task, friction)
    planned = planning_model(model, friction or bool(returned))
    # Of what is given back only the limit knows, and there a wider band does no harm.
    fine = Program(softened(planned, returned), task, options.fine, False, returned)
    found, spent = None, 0
    if near is not None:
        start = Solution.of(near).resampled(options.fine)
        found = fine.solve(start, options.fine_iterations, options.tolerance)
        spent = found.iterations
    if found is None or not found.converged:
        found, more = _searched(softened(planned), fine, options, returned)
        spent += more
    joined: dict[str, Any] = {}
    if isinstance(task.goal, Stretch):
        joined = dict(zip(('onto', 'elapsed'), task.goal.place(found.slid), strict=True))
    motion = found.trajectory(
        task.modes,
        model.hash,
        model=model.name,
        friction='planned' if friction else 'to be compensated',
        cost=found.cost,
        method='Hermite-Simpson collocation, fatrop',
        intervals=options.fine,
        periodic=task.periodic,
        slope=task.slope,
        iterations=spent,
        **joined,
    )
    if not (friction and returned):
        return motion
    return motion.with_phases(tuple(_with_friction(p, planned, fine.limit) for p in motion.phases))


def _searched(
    soft: Model, fine: Program, options: Options, returned: tuple[str, ...]
) -> tuple[Solution, int]:
    """Coarse, then fine: the solution, and the iterations spent."""
    task = fine.task
    coarse = screen(soft, task, options, returned)
    what = f'{" -> ".join(task.modes)} from {_said(task.start)} to {_said(task.goal)}'
    if coarse.verdict == 'infeasible':
        limit = soft.torque_limit if task.torque_limit is None else task.torque_limit
        raise InfeasibleError(
            f'no motion {what} within {limit:g} N m: the nearest misses goal or landing '
            f'by {coarse.miss:.2g} (1 is 0.1 rad or 0.3 rad/s)',
            coarse.iterations,
        )
    if coarse.best is None:
        raise UndecidedError(
            f'no motion {what} found within {len(options.starts)} guesses of '
            f'{options.coarse_iterations} iterations or {options.iterations} in all; '
            'there may be one',
            coarse.iterations,
        )
    spent, found = coarse.iterations, coarse.best
    guesses = map(fine.guess, options.starts[: options.guesses])
    starts = [coarse.best.resampled(options.fine), *guesses]
    same = options.coarse == options.fine and soft.values == fine.model.values
    for start in [] if same else starts:
        found = fine.solve(start, options.fine_iterations, options.tolerance)
        spent += found.iterations
        if found.converged or spent >= options.iterations:
            break
    if not found.converged:
        raise UndecidedError(
            f'a coarse motion {what} exists, but {options.fine} intervals a phase do not '
            f'converge within {options.fine_iterations} iterations',
            spent,
        )
    return found, spent


def _with_friction(phase: Phase, model: Model, limit: float) -> Phase:
    """The phase with what dry friction takes on top of its torque, and knots where it turns."""
    for effect in model.effects:
        if effect.friction and effect.friction != 'dry':
            model = model.without_effect(effect.label)
    taken, p = friction_torque(model), friction_parameters(model)
    cubic = scipy.interpolate.CubicHermiteSpline(phase.time, phase.states, phase.rates)

    def slip(t):
        states = cubic(t)
        return states[..., 2] - states[..., 3]

    # Where the hip is slow, friction changes within an interval.
    slow = np.abs(slip(phase.time)) < SLOW
    time = np.union1d(phase.time, [
        np.linspace(phase.time[k], phase.time[k + 1], FINER + 1)[1:-1]
        for k in np.flatnonzero(slow[:-1] | slow[1:])
    ])  # fmt: skip
    rate, more = slip(time), []
    for k in np.flatnonzero(rate[:-1] * rate[1:] < 0):
        first, last = time[k], time[k + 1]
        half = TURNING * (last - first) / abs(rate[k + 1] - rate[k])
        inside, turn = (last - first) / 1000, scipy.optimize.brentq(slip, first, last)
        more += [t for t in (turn - half, turn + half) if first + inside < t < last - inside]
    time = np.union1d(time, more)
    states = cubic(time)
    torque = np.interp(time, phase.time, phase.torque)
    angle, rate = states[:, 0] - states[:, 1], slip(time)
    torque += np.asarray(taken(angle[None], rate[None], p)).ravel()
    # A softer friction was kept within the limit.
    torque = np.clip(torque, -limit, limit)
    return Phase(phase.stance, time, states, cubic(time, 1), torque)


def _said(ends: Goal) -> str:
    if isinstance(ends, Stretch):
        return f'anywhere within {ends.length:.2g} s from node {ends.node[0]} on'
    if isinstance(ends, Box) and not (ends.lower == ends.upper).all():
        return 'a set of states'
    center = ' '.join(f'{value:.3g}' for value in ends.center)
    return f'({center})' if isinstance(ends, Box) else f'a region around ({center})'
