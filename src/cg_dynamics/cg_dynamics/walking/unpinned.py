"""The compass gait with no foot held: four coordinates, as impacts and ground forces need it.

q4 = (q_inner, q_outer, x, z) with (x, z) the stance foot in m. The energies are those of the
pinned model with the hip moved along by the foot,

    h = (x, z) + l d(q_st),   M4 dv4/dt + b4 = B4 u + (0, 0, F_x, F_z)          (UNP)

so that the unpinned model cannot disagree with the pinned one; pinning it (x = z = 0) gives the
force F that the ground exerts on the stance foot.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from cg_dynamics.assemble import acting_effects, overrides, parameter_names, parameter_vector
from cg_dynamics.effects import Body
from cg_dynamics.errors import ModelError
from cg_dynamics.lagrange import manipulator
from cg_dynamics.mechanisms.compass_gait import CompassGait, direction, normal
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.compiled import compile_model


@dataclass(frozen=True)
class FloatingBody(Body):
    """The mechanism as an effect sees it while the stance foot is anywhere.

    Attributes:
        foot_rate: Velocity of the stance foot in m/s, shape (2, 1).
    """

    foot_rate: ca.SX

    def point(self, name: str, distance) -> tuple[ca.SX, ca.SX]:
        """World position in m and velocity in m/s of a point of a body."""
        position, velocity = super().point(name, distance)
        return position, self.foot_rate + velocity


@dataclass(frozen=True)
class Unpinned:
    """(UNP) in symbols.

    Attributes:
        q: (q_inner, q_outer, x, z), shape (4, 1).
        v: Their rates.
        p: Parameter vector of the model without springs, shape (np, 1).
        mass_matrix: M4(q), shape (4, 4).
        bias: b4(q, v) in N m and N, shape (4, 1).
        kinetic: Kinetic energy in J.
        potential: Potential energy in J.
        swing_foot: Position of the swing foot in m, shape (2, 1).
    """

    q: ca.SX
    v: ca.SX
    p: ca.SX
    mass_matrix: ca.SX
    bias: ca.SX
    kinetic: ca.SX
    potential: ca.SX
    swing_foot: ca.SX


def unpinned(model: Model, stance: str) -> Unpinned:
    """Build (UNP) of a compass gait, with the energies of all its acting effects.

    Args:
        model: Its mechanism must be a compass gait.
        stance: The leg pair whose foot is (x, z), 'inner' or 'outer'.
    """
    if not isinstance(model.mechanism, CompassGait):
        raise ModelError(f'impacts are those of a compass gait, not of a {model.mechanism.name}')
    setup = Setup(stance=stance)
    names = parameter_names(model, setup)
    p = ca.SX.sym('p', len(names))
    by_name = dict(zip(names, ca.vertsplit(p), strict=True))
    q, v = ca.SX.sym('q', 4), ca.SX.sym('v', 4)
    leg, l = STANCES.index(stance), by_name['leg_length']
    hip = q[2:] + l * direction(q[leg])
    hip_rate = v[2:] + l * normal(q[leg]) * v[leg]

    effects = acting_effects(model)
    for effect in effects:
        if overrides(effect, 'foot'):
            raise ModelError(f'impacts and ground forces know point feet only, not {effect.label}')
    own = {
        e.label: {a.name: by_name[f'{e.label}.{a.name}'] for a in e.parameters} for e in effects
    }
    up = ca.SX([0, 1])
    for effect in effects:
        up = effect.up(up, own[effect.label])
    kinetic, potential = model.mechanism.energies_about_hip(q, v, hip, hip_rate, by_name, up)
    body = FloatingBody(model.mechanism, setup, q[:2], v[:2], by_name, up, q[2:], v[2:])
    for effect in effects:
        more_kinetic, more_potential = effect.energies(body, own[effect.label])
        kinetic, potential = kinetic + more_kinetic, potential + more_potential
    mass_matrix, bias = manipulator(kinetic, potential, q, v)
    return Unpinned(
        q, v, p, mass_matrix, bias, kinetic, potential, hip - l * direction(q[1 - leg])
    )


def ground_reaction(model: Model, stance: str, states: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Force (F_x, F_z) in N of the ground on the stance foot, in the rig frame: shape (n, 2).

    The pinned model holds only while F_z > 0 and |F_x| stays below friction times F_z. What else
    the world pulls or pushes at the robot (a tether, a push) is not told apart from the ground.

    Args:
        model: A compass gait.
        stance: The leg pair that stands.
        states: States x, shape (n, nx).
        u: Inputs that act, the hip torque in N m first, shape (n, nu).
    """
    setup = Setup(stance=stance)
    p = parameter_vector(model, setup)
    rates = np.asarray(compile_model(model, setup).f(np.transpose(states), np.transpose(u), p))
    n = len(states)
    at_rest = np.zeros((2, n))
    force = _reaction(model, stance)(
        np.vstack([np.transpose(states)[:2], at_rest]),
        np.vstack([np.transpose(states)[2:4], at_rest]),
        np.vstack([rates[2:4], at_rest]),
        p,
    )
    return np.asarray(force).T


def _reaction(model: Model, stance: str) -> ca.Function:
    key = structure(model, stance)
    if key not in _reactions:
        e = unpinned(model, stance)
        dv = ca.SX.sym('dv', 4)
        force = (ca.mtimes(e.mass_matrix, dv) + e.bias)[2:]
        _reactions[key] = ca.Function('reaction', [e.q, e.v, dv, e.p], [force])
    return _reactions[key]


_reactions: dict[tuple, ca.Function] = {}


def structure(model: Model, stance: str) -> tuple:
    """What the symbols of `unpinned` depend on: all but the values of parameters."""
    return (
        model.mechanism.name,
        tuple((e.name, e.at) for e in model.effects),
        tuple(e.label for e in acting_effects(model)),
        stance,
    )
