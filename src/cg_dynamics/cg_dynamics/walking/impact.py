"""Impact of the swing foot: theory.md, "Impact".

The swing foot r(q4) sticks where it lands, the ground pushes on that foot alone, and angles do
not change. With A = dr/dq4 of the unpinned model (Eq. 4.10 times the leg length),

    v4+ = v4- - M4^-1 A' (A M4^-1 A')^-1 A v4-                              (IMP), Eq. 4.11
    P   = -(A M4^-1 A')^-1 A v4-    impulse of the ground on the landing foot, N s

and then the landing leg is stance. Energies of effects (a payload) take part; finite forces
(torque, friction, springs) do not, and the rotor behind a flexible joint keeps its rate.
"""

from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.walking.unpinned import structure, unpinned


def other(stance: str) -> str:
    """The other leg pair."""
    return STANCES[1 - STANCES.index(stance)]


@dataclass(frozen=True)
class Impact:
    """An impact.

    Attributes:
        x_plus: State after it, the same angles and extra states, shape (nx,).
        stance: Stance leg after it.
        impulse: (P_x, P_z) of the ground on the landing foot in N s.
        foot_velocity: Velocity of the foot that was stance, right after, in m/s. The model
            holds if its vertical part is not negative: that foot must leave the ground.
        energy_lost: In J.
        landing_velocity: Velocity of the foot that landed, right after, in m/s; zero if it stuck.
        mode: What that foot does then: 'stick', 'slide' or 'flight' (contact.py).
    """

    x_plus: np.ndarray
    stance: str
    impulse: np.ndarray
    foot_velocity: np.ndarray
    energy_lost: float
    landing_velocity: np.ndarray = field(default_factory=lambda: np.zeros(2))
    mode: str = 'stick'


def impact_function(model: Model, stance: str) -> ca.Function:
    """(IMP) while `stance` is the leg that stands before: q, v, p -> v_plus, and what it does.

    The function is smooth and differentiable: planners embed it, sensitivities pass through it.
    Inputs: q (2), v (2), p (parameter vector of `Setup(stance)`). Outputs: v_plus (2),
    impulse (2), foot_velocity (2), energy_lost.
    """
    key = structure(model, stance)
    if key not in _functions:
        e = unpinned(model, stance)
        q, v = ca.SX.sym('q', 2), ca.SX.sym('v', 2)
        A = ca.jacobian(e.swing_foot, e.q)
        M_inv_At = ca.solve(e.mass_matrix, A.T)
        v4 = ca.vertcat(v, 0, 0)
        impulse = -ca.solve(ca.mtimes(A, M_inv_At), ca.mtimes(A, v4))
        v4_plus = v4 + ca.mtimes(M_inv_At, impulse)
        kinetic = ca.Function('T', [e.q, e.v, e.p], [e.kinetic])
        # The foot is at the origin; M4 does not depend on where it is.
        q4 = ca.vertcat(q, 0, 0)
        impulse, v4_plus = ca.substitute([impulse, v4_plus], [e.q], [q4])
        lost = kinetic(q4, v4, e.p) - kinetic(q4, v4_plus, e.p)
        _functions[key] = ca.Function(
            'impact',
            [q, v, e.p],
            [v4_plus[:2], impulse, v4_plus[2:], lost],
            ['q', 'v', 'p'],
            ['v_plus', 'impulse', 'foot_velocity', 'energy_lost'],
        )
    return _functions[key]


_functions: dict[tuple, ca.Function] = {}


def impact(model: Model, stance: str, x: np.ndarray) -> Impact:
    """What the landing of the swing foot does to a state.

    Args:
        model: A compass gait.
        stance: Stance leg before.
        x: State before, (q_inner, q_outer), rates, extra states: shape (nx,).
    """
    v_plus, impulse, foot_velocity, lost = impact_function(model, stance)(
        x[:2], x[2:4], parameter_vector(model, Setup(stance=stance))
    )
    x_plus = np.array(x, float)
    x_plus[2:4] = np.asarray(v_plus).ravel()
    return Impact(
        x_plus,
        other(stance),
        np.asarray(impulse).ravel(),
        np.asarray(foot_velocity).ravel(),
        float(lost),
    )
