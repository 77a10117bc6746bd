"""Contact of a foot with the ground: landing, rebound, sliding: theory.md, "Contact".

The ground falls by `slope` ahead, n and t are its normal and its direction ahead. A foot that
touches it with velocity u receives the impulse P,

    u+ = u- + W P,   n.u+ = -e n.u-,   |t.P| <= mu n.P,   W = A M4^-1 A'             (LAND)

and sticks (t.u+ = 0) if the cone allows, else slides with t.P = -mu sgn(t.u+) n.P. A foot on
the ground or above it moves by

    dv4/dt = (dv/dt of the pinned model, 0) + M4^-1 E (F - F_pin)                     (CON)

F_pin is the force that would hold it, E picks the foot's coordinates. Off the ground F = 0; a foot
that slides has F = N (n - mu s t), s = sgn(t.u), with N such that it stays on the ground.
"""

import math
from dataclasses import dataclass

import casadi as ca
import numpy as np

from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.effects.effect import ContactLaw
from cg_dynamics.errors import SimulationError
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.walking.impact import Impact, impact, other
from cg_dynamics.walking.unpinned import structure, unpinned

# A rebound slower than this, in m/s, counts as none: its flight is over in a tenth of a
# millisecond and the foot rises by a micrometre.
REST_SPEED = 1e-3


def contact_law(model: Model) -> ContactLaw:
    """The law that the effects of a model make."""
    law, values = ContactLaw(), model.values
    for effect in model.effects:
        own = {p.name: values[f'{effect.label}.{p.name}'] for p in effect.parameters}
        law = effect.landing(law, own)
    return law


@dataclass(frozen=True)
class Ground:
    """A plane that falls by `slope` rad ahead, in the frame of the angles.

    Attributes:
        normal: Unit vector (x, z) off the ground.
        tangent: Unit vector (x, z) along it, ahead.
    """

    slope: float

    @property
    def normal(self) -> np.ndarray:
        """Unit vector (x, z) off the ground."""
        return np.array([math.sin(self.slope), math.cos(self.slope)])

    @property
    def tangent(self) -> np.ndarray:
        """Unit vector (x, z) along the ground, ahead."""
        return np.array([math.cos(self.slope), -math.sin(self.slope)])


def contact_impulse(
    u: np.ndarray, W: np.ndarray, law: ContactLaw, ground: Ground
) -> tuple[np.ndarray, str]:
    """Impulse of the ground on a foot: (LAND).

    Args:
        u: Velocity of the foot before in m/s, towards the ground, shape (2,).
        W: Inverse inertia of the foot in 1/kg, shape (2, 2).
        law: The law of contact.
        ground: The ground.

    Returns:
        Impulse (x, z) in N s, shape (2,), and what the foot does after: 'stick', 'slide', or
        'flight' if it leaves the ground.

    Raises:
        SimulationError: where friction would not let the foot slide either way (Painleve).
    """
    n, t = ground.normal, ground.tangent
    rebound = -law.restitution * (n @ u)
    if rebound < REST_SPEED:
        rebound = 0.0
    after = 'flight' if rebound else ''
    stuck = np.linalg.solve(W, rebound * n - u)
    if math.isinf(law.friction) or abs(t @ stuck) <= law.friction * (n @ stuck):
        return stuck, after or 'stick'
    # The way that the foot cannot help sliding comes first; with a slanted W it may be the other.
    first = -np.sign(t @ stuck)
    for sense in (first, -first):
        direction = n - law.friction * sense * t
        gain = n @ W @ direction
        if gain <= 0:
            continue
        impulse = (rebound - n @ u) / gain * direction
        if sense * (t @ (u + W @ impulse)) >= 0:
            return impulse, after or 'slide'
    raise SimulationError(
        f'a foot jams: friction {law.friction:g} lets it neither stick nor slide', math.nan
    )


def land(
    model: Model,
    stance: str,
    x: np.ndarray,
    law: ContactLaw,
    ground: Ground,
    foot_velocity: np.ndarray | None = None,
) -> Impact:
    """Landing of the swing foot; with a plastic law on a held foot this is (IMP).

    Args:
        model: A compass gait.
        stance: Stance leg before.
        x: State before, shape (nx,).
        law: The law of contact.
        ground: The ground.
        foot_velocity: Velocity of the foot that was stance, in m/s; None if it was held.
    """
    if law.plastic and foot_velocity is None:
        return impact(model, stance, x)
    before = np.zeros(2) if foot_velocity is None else foot_velocity
    v4 = np.concatenate([x[2:4], before])
    return _struck(model, stance, x, v4, law, ground, landing=True)


def rebound(
    model: Model,
    stance: str,
    x: np.ndarray,
    law: ContactLaw,
    ground: Ground,
    foot_velocity: np.ndarray,
) -> Impact:
    """A further landing of the foot of the stance leg; arguments as in `land`."""
    v4 = np.concatenate([x[2:4], foot_velocity])
    return _struck(model, stance, x, v4, law, ground, landing=False)


def _struck(
    model: Model,
    stance: str,
    x: np.ndarray,
    v4: np.ndarray,
    law: ContactLaw,
    ground: Ground,
    landing: bool,
) -> Impact:
    results = foot_functions(model, stance, landing)(x[:2], v4, parameters(model))
    u, W, G = (np.asarray(part) for part in results)
    u = u.ravel()
    impulse, then = contact_impulse(u, W, law, ground)
    after = u + W @ impulse
    v4_plus = v4 + G @ impulse
    x_plus = np.array(x, float)
    x_plus[2:4] = v4_plus[:2]
    lost = -impulse @ (u + after) / 2
    # Only the foot that was stance before a step has a velocity of its own to speak of.
    trailing = v4_plus[2:] if landing else np.full(2, np.nan)
    leg = other(stance) if landing else stance
    if then == 'stick':
        after = np.zeros(2)
    return Impact(x_plus, leg, impulse, trailing, float(lost), after, then)


def foot_functions(model: Model, stance: str, landing: bool) -> ca.Function:
    """Velocity, inverse inertia and response to an impulse of a foot.

    Args:
        model: A compass gait.
        stance: The leg whose foot is at the origin.
        landing: Of the other foot; otherwise of that one.

    Returns:
        (q (2), v4 (4), p) -> u (2), W (2, 2), G (4, 2) with v4+ = v4- + G P.
    """
    key = (*structure(model, stance), landing)
    if key not in _feet:
        e = unpinned(model, stance)
        A = ca.jacobian(e.swing_foot if landing else e.q[2:], e.q)
        G = ca.solve(e.mass_matrix, A.T)
        q = ca.SX.sym('q', 2)
        out = ca.substitute([ca.mtimes(A, e.v), ca.mtimes(A, G), G], [e.q], [ca.vertcat(q, 0, 0)])
        _feet[key] = ca.Function('foot', [q, e.v, e.p], [ca.densify(part) for part in out])
    return _feet[key]


_feet: dict[tuple, ca.Function] = {}


@dataclass(frozen=True)
class FreeFoot:
    """Motion of the robot while the foot of the stance leg slides or flies: (CON).

    y = (x, foot place (x, z) in m, foot velocity in m/s), shape (nx + 4,).

    Attributes:
        force: (x, u, p) -> force (F_x, F_z) in N that would hold the foot.
        slide: (y, u, p, h, c, slope) -> y after h s of sliding, c = mu sgn(t.u).
        flight: (y, u, p, h, c, slope) -> y after h s off the ground.
        normal_force: (y, u, p, c, slope) -> N in N while it slides.
    """

    force: ca.Function
    slide: ca.Function
    flight: ca.Function
    normal_force: ca.Function


def free_foot(model: Model, stance: str) -> FreeFoot:
    """The functions of (CON), one Runge-Kutta step of order 4 each; built once per structure."""
    key = structure(model, stance)
    if key not in _free:
        _free[key] = _build(model, stance)
    return _free[key]


_free: dict[tuple, FreeFoot] = {}


def _build(model: Model, stance: str) -> FreeFoot:
    pinned, e = assemble(model, Setup(stance=stance)), unpinned(model, stance)
    x, u, p = pinned.x, pinned.u, pinned.p
    place, rate = ca.SX.sym('place', 2), ca.SX.sym('rate', 2)
    at = ca.vertcat(x[:2], 0, 0)
    # The bias does not know how fast the foot moves: uniform motion is no motion.
    M, b = ca.substitute(
        [e.mass_matrix, e.bias], [ca.vertcat(e.q, e.v, e.p)],
        [ca.vertcat(at, x[2:4], 0, 0, p)],
    )  # fmt: skip
    dv = pinned.rates[2:4]
    held = (ca.mtimes(M, ca.vertcat(dv, 0, 0)) + b)[2:]
    G = ca.solve(M, ca.vertcat(ca.SX.zeros(2, 2), ca.SX.eye(2)))
    W = G[2:, :]

    c, slope, h = ca.SX.sym('c'), ca.SX.sym('slope'), ca.SX.sym('h')
    n = ca.vertcat(ca.sin(slope), ca.cos(slope))
    t = ca.vertcat(ca.cos(slope), -ca.sin(slope))
    direction = n - c * t
    normal_force = ca.dot(n, ca.mtimes(W, held)) / ca.dot(n, ca.mtimes(W, direction))
    y = ca.vertcat(x, place, rate)

    def step(name: str, force: ca.SX) -> ca.Function:
        more = ca.mtimes(G, force - held)
        rates = ca.vertcat(pinned.rates[:2], dv + more[:2], pinned.rates[4:], rate, more[2:])
        f = ca.Function('f', [y, u, p, c, slope], [ca.cse(rates)])
        k1 = f(y, u, p, c, slope)
        k2 = f(y + h / 2 * k1, u, p, c, slope)
        k3 = f(y + h / 2 * k2, u, p, c, slope)
        k4 = f(y + h * k3, u, p, c, slope)
        return ca.Function(name, [y, u, p, h, c, slope], [y + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])

    return FreeFoot(
        ca.Function('force', [x, u, p], [held]),
        step('slide', normal_force * direction),
        step('flight', ca.SX.zeros(2)),
        ca.Function('normal_force', [y, u, p, c, slope], [normal_force]),
    )


def parameters(model: Model) -> np.ndarray:
    """Parameter vector of the functions above."""
    return parameter_vector(model, Setup())
