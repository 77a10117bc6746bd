"""Floquet multipliers of an orbit: what becomes of a small deviation in a period.

A deviation follows (FLOW) from knot to knot and jumps at impacts by

    Xi = D (I - f- n' / (n'f-))                                                  (RESTART)

if the clock of torque and gains starts anew at each impact, whenever that is: so deviations are
compared at the impacts themselves. With f+ n' / (n'f-) besides, (SALT), they are compared at one
instant. After an impact both feet are on the ground, which leaves the three coordinates of a
section, (alpha, v_st, v_sw) of cg_dynamics.walking.gait, and three multipliers.
"""

import functools

import numpy as np

from cg_control.orbits.orbit import Orbit
from cg_control.trajectories.flow import phase_flow
from cg_control.trajectories.tvlqr import jump_matrix
from cg_dynamics.walking.gait import section_coordinates, section_state


def monodromy(orbit: Orbit, feedback: bool = False, restarts: bool = True) -> np.ndarray:
    """How a deviation right after the last impact returns there, shape (4, 4).

    Args:
        orbit: Its exact motion is what deviations are from.
        feedback: Under u0 - K (x - x0) with the gains of its trajectory, x0 being the exact
            motion; otherwise under u0 alone.
        restarts: (RESTART) at impacts; False: (SALT). If the feedback follows the state and not
            a clock, one eigenvalue is then 1, of deviations along the motion, and the others are
            the multipliers of the section.
    """
    phases, matrices = orbit.trajectory.phases, []
    for phase, after in zip(phases, (*phases[1:], phases[0]), strict=True):
        matrices += list(phase_flow(orbit.planned, phase, feedback).by_state)
        matrices.append(jump_matrix(orbit.planned, phase, after, orbit.slope, restarts))
    return functools.reduce(lambda done, step: step @ done, matrices, np.eye(4))


def section_map(orbit: Orbit, feedback: bool = False) -> np.ndarray:
    """Derivative of the map of the section onto itself, shape (3, 3).

    Args:
        orbit: As in `monodromy`.
        feedback: As in `monodromy`.
    """
    stance, M = orbit.trajectory.modes[0], monodromy(orbit, feedback)
    # Both are linear but for the slope, which does not deviate.
    columns = [M @ section_state(unit, stance, 0.0) for unit in np.eye(3)]
    return np.column_stack([section_coordinates(column, stance) for column in columns])


def multipliers(orbit: Orbit, feedback: bool = False) -> np.ndarray:
    """Eigenvalues of `section_map`, the largest first, shape (3,); inside the unit circle: stable.

    Args:
        orbit: As in `monodromy`.
        feedback: As in `monodromy`.
    """
    values = np.linalg.eigvals(section_map(orbit, feedback))
    return values[np.argsort(-np.abs(values))]
