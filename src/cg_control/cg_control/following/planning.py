"""From a task to a trajectory that may be run: planned, given feedback, and checked.

The check simulates the exact hybrid model (cg_dynamics.walking.hybrid): open loop, the model as it
was planned on, for as long as collocation can be held to its word, since the upright robot
amplifies every error by exp(3.2 t); closed loop, the robot with everything that it has, over all
of it.
"""

from dataclasses import dataclass

import numpy as np

from cg_control.following.nodes import Nodes
from cg_control.following.tracking import Tracker, TrackingSettings
from cg_control.trajectories.collocation import Options, PlanningError, optimise, planning_model
from cg_control.trajectories.task import Task
from cg_control.trajectories.trajectory import Trajectory
from cg_control.trajectories.tvlqr import Weights, stabilise
from cg_dynamics.model import Model
from cg_dynamics.walking.hybrid import Walk, WalkOptions, walk

SAMPLE_TIME = 0.002  # s


class RejectedError(PlanningError):
    """A motion was found, but the exact model does not make it."""


@dataclass(frozen=True)
class CheckOptions:
    """What a trajectory must keep.

    Attributes:
        horizon: Of the open-loop simulation, s.
        open_loop: Largest deviation of an angle over the horizon, rad; rates may err ten times
            as much.
        closed_loop: Largest deviation of an angle at the end, rad; rates as above.
        minimum_step: Distance in m that the foot must be ahead for an impact: shorter steps are
            not taken, as on blocks.
    """

    horizon: float = 0.6
    open_loop: float = 0.01
    closed_loop: float = 0.02
    minimum_step: float = 0.02


@dataclass(frozen=True)
class Check:
    """How a trajectory fares on the exact hybrid model.

    Attributes:
        open_loop: Largest scaled deviation over the horizon, rad.
        closed_loop: Scaled deviation at the end, rad.
        impact_delay: Largest difference of an impact from its nominal instant, closed loop, s.
        problem: Why the trajectory is not accepted; empty if it is.
    """

    open_loop: float
    closed_loop: float
    impact_delay: float
    problem: str


RATE_SHARE = np.array([1.0, 1.0, 0.1, 0.1])


def executed(
    trajectory: Trajectory,
    robot: Model,
    settings: TrackingSettings,
    known: Model | None = None,
    x0: np.ndarray | None = None,
    more: float = 0.0,
    options: WalkOptions | None = None,
    balance: np.ndarray | None = None,
) -> Walk:
    """Run a trajectory on the exact hybrid model.

    Args:
        trajectory: With gains, unless settings switch feedback off.
        robot: What moves.
        settings: How the trajectory is followed.
        known: The robot as the controller knows it; None: as it is.
        x0: Start, shape (4,); None: that of the trajectory.
        more: Time after the end of the trajectory, s.
        options: Of the simulation.
        balance: Gain after the end, shape (4,).
    """
    model = known or robot
    tracker = Tracker(Nodes.of(trajectory, model, balance, settings.late), model, settings)

    def command(t, stance, x):
        return np.array([tracker.torque(t, stance, x)])

    start = trajectory.states[0] if x0 is None else x0
    return walk(
        robot, trajectory.modes[0], start, trajectory.duration + more, command,
        options or WalkOptions(sample_time=SAMPLE_TIME),
    )  # fmt: skip


def check(trajectory: Trajectory, model: Model, options: CheckOptions | None = None) -> Check:
    """Simulate a trajectory open loop and closed loop.

    Args:
        trajectory: With gains.
        model: The robot that it was planned for.
        options: What it must keep.
    """
    options = options or CheckOptions()
    how = WalkOptions(
        slope=trajectory.provenance.get('slope', 0.0),
        minimum_step=options.minimum_step,
        sample_time=SAMPLE_TIME,
    )
    planned = planning_model(model, trajectory.provenance.get('friction') == 'planned')
    nominal = walk(
        planned, trajectory.modes[0], trajectory.states[0],
        min(options.horizon, trajectory.duration),
        lambda t, stance, x: np.array([trajectory.at(t + SAMPLE_TIME / 2).torque]), how,
    )  # fmt: skip
    open_loop = 0.0
    for arc, phase in zip(nominal.arcs, trajectory.phases, strict=False):
        inside = (arc.time >= phase.start) & (arc.time <= phase.end)
        reference = np.array([phase.at(t).state for t in arc.time[inside]])
        if len(reference):
            deviation = np.abs(reference - arc.states[inside, :4]) * RATE_SHARE
            open_loop = max(open_loop, float(deviation.max()))
    closed = executed(trajectory, model, TrackingSettings(), options=how)
    end = np.abs(closed.state[:4] - trajectory.states[-1]) * RATE_SHARE
    delays = [
        abs(event.time - t)
        for event, t in zip(closed.impacts, trajectory.impact_times, strict=False)
    ]
    periodic = bool(trajectory.provenance.get('periodic', False))
    expected = len(trajectory.impact_times)
    problem = ''
    if open_loop > options.open_loop:
        problem = (
            f'open loop the model leaves it by {open_loop:.3g} rad within '
            f'{options.horizon:g} s, allowed are {options.open_loop:g}; plan with more intervals'
        )
    elif closed.outcome != 'time':
        problem = f'closed loop the robot ends by {closed.outcome!r} at {closed.time:.2f} s'
    elif not periodic and len(closed.impacts) != expected:
        problem = f'closed loop the foot lands {len(closed.impacts)} times, planned {expected}'
    elif not periodic and end.max() > options.closed_loop:
        problem = (
            f'closed loop the robot ends {end.max():.3g} rad away, '
            f'allowed are {options.closed_loop:g}'
        )
    return Check(open_loop, float(end.max()), max(delays, default=0.0), problem)


def plan(
    model: Model,
    task: Task,
    options: Options | None = None,
    friction: bool = True,
    weights: Weights | None = None,
    checks: CheckOptions | None = None,
) -> Trajectory:
    """A trajectory with feedback that the exact model was seen to follow.

    Args:
        model: The robot.
        task: What is asked.
        options: Of the optimisation.
        friction: Whether joint friction is part of the plan.
        weights: Of the feedback.
        checks: What the trajectory must keep.

    Raises:
        InfeasibleError, UndecidedError: no motion was found.
        RejectedError: the exact model does not make the motion.
    """
    trajectory = stabilise(optimise(model, task, options, friction), model, weights)
    result = check(trajectory, model, checks)
    if result.problem:
        raise RejectedError(
            f'the motion {" -> ".join(task.modes)} was planned but is not accepted: '
            f'{result.problem}',
            trajectory.provenance['iterations'],
        )
    return trajectory.with_phases(
        trajectory.phases,
        checked={'open_loop': result.open_loop, 'closed_loop': result.closed_loop},
    )
