"""A periodic motion that closes exactly: the nearest one to what collocation found.

Collocation meets the equations of motion to the order of its mesh. Of the exact model are asked

    flow(x_k, u_k, u_k+1, h) = x_k+1     from knot to knot, (FLOW)
    impact map of the last state         = first state of the next phase, the last phase's next
                                           being the first
    (q_st, q_sw) at each end             = slope + (a, -a),   2 l sin(a) = step length
    sum of the durations                 = period                                      (CLOSE)

by Newton's method in all knots, torques and durations. These are more unknowns than equations: of
all corrections the smallest is taken, counted in the units of CORRECTION.
"""

import math
from dataclasses import replace
from itertools import accumulate

import numpy as np
import scipy.linalg

from cg_control.trajectories.collocation import PlanningError
from cg_control.trajectories.flow import phase_flow, state_rates
from cg_control.trajectories.trajectory import Phase, Trajectory
from cg_control.trajectories.tvlqr import impact_derivative
from cg_dynamics.model import Model
from cg_dynamics.walking.hybrid import STANCES
from cg_dynamics.walking.impact import impact

CORRECTION = (0.1, 0.1, 0.3, 0.3, 3.0)  # rad, rad/s and N m that are worth the same
DURATION = 0.1  # s that is worth as much
ITERATIONS = 15
CLOSED = 1e-11  # rad, rad/s and s
LARGEST_MOVE = 0.3  # in units of CORRECTION


def closed(
    trajectory: Trajectory, model: Model, half_angle: float, period: float, slope: float
) -> Trajectory:
    """The trajectory nearest to a periodic one that meets (CLOSE).

    Args:
        trajectory: Periodic, all its steps of one length.
        model: Whose exact motion it is to be, in four states.
        half_angle: a of (CLOSE), rad.
        period: In s.
        slope: Fall of the ground ahead, rad.

    Raises:
        PlanningError: if none is near.
    """
    phases = trajectory.phases
    for _ in range(ITERATIONS):
        residual, jacobian = _equations(phases, model, half_angle, period, slope)
        error = np.abs(residual).max()
        if error < CLOSED:
            return trajectory.with_phases(_with_rates(phases, model), closure=float(error))
        units = _units(phases)
        move, *_ = scipy.linalg.lstsq(jacobian * units, -residual, lapack_driver='gelsy')
        move *= min(1.0, LARGEST_MOVE / np.abs(move).max())
        phases = _moved(phases, move * units)
    raise PlanningError(
        f'the motion {" -> ".join(trajectory.modes)} does not close: from knot to knot the exact '
        f'model still misses it by {error:.2g}; plan with more intervals',
        trajectory.provenance.get('iterations', 0),
    )


def _equations(
    phases: tuple[Phase, ...], model: Model, half_angle: float, period: float, slope: float
) -> tuple[np.ndarray, np.ndarray]:
    """(CLOSE) and its Jacobian by (x, u) at all knots of all phases and, last, the durations."""
    sizes = [5 * len(phase.time) for phase in phases]
    starts = np.cumsum([0, *sizes])
    width = starts[-1] + len(phases)
    values: list[np.ndarray] = []
    rows: list[np.ndarray] = []
    for i, phase in enumerate(phases):
        n, following = len(phase.time) - 1, (i + 1) % len(phases)
        moved = phase_flow(model, phase)
        at = starts[i] + 5 * np.arange(n)
        block = np.zeros((n, 4, width))
        for k, column in enumerate(at):
            block[k, :, column : column + 4] = moved.by_state[k]
            block[k, :, column + 4] = moved.by_torque[k, :, 0]
            block[k, :, column + 9] = moved.by_torque[k, :, 1]
            block[k, :, column + 5 : column + 9] -= np.eye(4)
        block[:, :, starts[-1] + i] = moved.by_duration / n
        values.append((moved.end - phase.states[1:]).ravel())
        rows.append(block.reshape(4 * n, width))
        last, jump = starts[i + 1] - 5, np.zeros((4, width))
        jump[:, last : last + 4] = impact_derivative(model, phase)
        jump[:, starts[following] : starts[following] + 4] -= np.eye(4)
        landed = impact(model, phase.stance, phase.states[-1]).x_plus
        values.append(landed - phases[following].states[0])
        rows.append(jump)
        pose = np.zeros((2, width))
        pose[:, last : last + 2] = np.eye(2)
        values.append(phase.states[-1, :2] - slope - half_angle * _ahead(phase.stance))
        rows.append(pose)
    whole = np.zeros((1, width))
    whole[0, starts[-1] :] = 1.0
    values.append(np.array([sum(phase.end - phase.start for phase in phases) - period]))
    rows.append(whole)
    return np.concatenate(values), np.vstack(rows)


def _ahead(stance: str) -> np.ndarray:
    """+1 for the leg that stands, whose hip is ahead of its foot at the impact; -1 else."""
    return np.where(np.array(STANCES) == stance, 1.0, -1.0)


def _units(phases: tuple[Phase, ...]) -> np.ndarray:
    knots = sum(len(phase.time) for phase in phases)
    return np.concatenate([np.tile(CORRECTION, knots), np.full(len(phases), DURATION)])


def _moved(phases: tuple[Phase, ...], move: np.ndarray) -> tuple[Phase, ...]:
    knots = [len(phase.time) for phase in phases]
    parts = np.split(move[: -len(phases)].reshape(-1, 5), list(accumulate(knots))[:-1])
    result, start = [], phases[0].start
    for phase, part, longer in zip(phases, parts, move[-len(phases) :], strict=True):
        duration = phase.end - phase.start + longer
        time = start + np.linspace(0.0, 1.0, len(phase.time)) * duration
        states, torque = phase.states + part[:, :4], phase.torque + part[:, 4]
        result.append(replace(phase, time=time, states=states, torque=torque))
        start = float(time[-1])
    return tuple(result)


def _with_rates(phases: tuple[Phase, ...], model: Model) -> tuple[Phase, ...]:
    return tuple(
        replace(phase, rates=state_rates(model, phase.stance, phase.states, phase.torque))
        for phase in phases
    )


def half_angle(model: Model, step_length: float) -> float:
    """Half the angle between the legs in rad when feet stand so far apart, in m."""
    return math.asin(step_length / (2 * model.values['leg_length']))
