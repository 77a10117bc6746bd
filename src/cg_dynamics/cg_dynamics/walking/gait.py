"""Periodic gaits: fixed points of the map from one double support to the next.

Right after an impact both feet are on the ground, so with alpha half the angle between the legs
the angles are q_st = slope - alpha and q_sw = slope + alpha, where the slope (positive downhill
ahead) turns the ground's frame. The section has three coordinates s = (alpha, v_st, v_sw);
Newton's method solves P(s) = s, and the eigenvalues of dP/ds say whether the gait is stable.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.walking.hybrid import Command, Walk, WalkOptions, walk


class GaitError(DynamicsError):
    """No periodic gait was found; the message says how the search ended."""


@dataclass(frozen=True)
class Gait:
    """A periodic gait.

    Attributes:
        x0: State right after the impact that starts it, shape (4,).
        stance: Stance leg then.
        walk: One period of it.
        period: In s.
        step_lengths: Of the steps in one period, m.
        multipliers: Eigenvalues of the map; the gait is stable if all are inside the unit circle.
        residual: Largest |P(s) - s|.
    """

    x0: np.ndarray
    stance: str
    walk: Walk
    period: float
    step_lengths: tuple[float, ...]
    multipliers: np.ndarray
    residual: float

    @property
    def stable(self) -> bool:
        """True if small disturbances die out from period to period."""
        return bool(np.abs(self.multipliers).max() < 1)


def section_state(s: np.ndarray, stance: str, slope: float) -> np.ndarray:
    """State (4,) of section coordinates (alpha, v_st, v_sw)."""
    standing, swinging = slope - s[0], slope + s[0]
    if stance == 'inner':
        return np.array([standing, swinging, s[1], s[2]])
    return np.array([swinging, standing, s[2], s[1]])


def section_coordinates(x: np.ndarray, stance: str) -> np.ndarray:
    """Section coordinates (alpha, v_st, v_sw) of a state in double support."""
    standing, swinging = (0, 1) if stance == 'inner' else (1, 0)
    return np.array([(x[swinging] - x[standing]) / 2, x[2 + standing], x[2 + swinging]])


def find_gait(
    model: Model,
    stance: str,
    guess: np.ndarray,
    options: WalkOptions | None = None,
    steps: int = 2,
    command: Command | None = None,
    tolerance: float = 1e-10,
    iterations: int = 30,
) -> Gait:
    """The periodic gait nearest to a guess, by Newton's method.

    Args:
        model: A compass gait without extra states.
        stance: Stance leg at the start of the period.
        guess: (alpha in rad, v_st, v_sw in rad/s) right after an impact.
        options: How to walk.
        steps: Steps in a period; one step is a period only if both leg pairs are alike.
        command: Torque as in `walk`, its time counted from the start of the period.
        tolerance: Largest |P(s) - s| that counts as periodic.
        iterations: After which to give up.

    Raises:
        GaitError: if there is none near.
    """
    options = replace(options or WalkOptions(), largest_steps=steps)

    def period(s):
        x0 = section_state(s, stance, options.slope)
        done = walk(model, stance, x0, 5.0 * steps, command, options)
        if len(done.impacts) < steps:
            raise GaitError(f'no gait: from s = {s} the walk ends by {done.outcome!r}')
        last = done.impacts[-1].impact
        assert last is not None, 'an impact event carries its impact'
        return section_coordinates(last.x_plus, last.stance), done

    s = np.array(guess, float)
    for _ in range(iterations):
        image, done = period(s)
        residual = np.abs(image - s).max()
        jacobian = np.empty((3, 3))
        for j in range(3):
            nudge = np.zeros(3)
            nudge[j] = 1e-5
            jacobian[:, j] = (period(s + nudge)[0] - period(s - nudge)[0]) / 2e-5
        if residual < tolerance:
            return Gait(
                section_state(s, stance, options.slope),
                stance,
                done,
                done.impacts[-1].time,
                tuple(event.step_length for event in done.impacts),
                np.linalg.eigvals(jacobian),
                float(residual),
            )
        change = np.linalg.solve(jacobian - np.eye(3), s - image)
        # A long Newton step leads out of the region where the robot takes a step at all.
        s = s + change * min(1.0, 0.1 / max(np.abs(change).max(), math.ulp(1.0)))
    raise GaitError(f'no gait: |P(s) - s| is still {residual:.3g} after {iterations} iterations')
