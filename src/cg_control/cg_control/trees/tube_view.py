"""The tube of an orbit and the surface of a phase, to look at: what of them shows in the plane.

A state has two angles and two rates, and what a viewer draws has a hip and two feet. So the tube
(x - x0)' F (x - x0) <= 1 is drawn as what hip and swing foot do in it, to first order, with any
rates: about each knot the swing foot stays in an ellipse, the hip on a stretch of its arc,

    foot   p + J d,   d'F d <= 1:   (p - p0)' (J F^-1 J')^-1 (p - p0) <= 1            (VIEW)

with J = dp/dx. Of the surface n'(x - x0) = 0 those poses are drawn that have the rates of x0: a
line of them, as far as the tube, or else the funnel, reaches.
"""

import numpy as np

from cg_control.following.nodes import Nodes
from cg_control.trees.way_home import WayHome
from cg_dynamics.rig import STANCES

MOST_KNOTS = 60  # knots of the tube that are drawn
CORNERS = 16  # of each ellipse
LARGEST = 0.15  # rad, or m of an ellipse: what is wider is drawn so wide
POSES = 9  # along the line of a surface


def tube_segments(
    nodes: Nodes, way: WayHome, leg_length: float, foot: float = 0.0
) -> dict[str, np.ndarray]:
    """The tube of the orbit that a way leads to, as segments.

    Args:
        nodes: The tree.
        way: A way home; one to upright has no tube.
        leg_length: In m.
        foot: Where the foot stands at the beginning, m ahead.

    Returns:
        'tube_hip' and 'tube_foot' -> (x ahead, z up) of both ends in m, shape (n, 2, 2); at most
        MOST_KNOTS and MOST_KNOTS * CORNERS segments.
    """
    on = np.flatnonzero(nodes.orbiting[way.nodes] & ~nodes.impact[way.nodes])
    if len(on) > MOST_KNOTS:
        on = on[np.linspace(0, len(on) - 1, MOST_KNOTS).astype(int)]
    hip, swing = _places(way, on, leg_length, foot)
    J_hip, J_swing = _jacobians(way.states[on], way.stance[on], leg_length)
    spread = _inverse(nodes.F[way.nodes[on]])
    angle = 2 * np.pi * np.arange(CORNERS + 1) / CORNERS
    rim = _root(J_swing @ spread @ J_swing.transpose(0, 2, 1)) @ np.stack(
        [np.cos(angle), np.sin(angle)]
    )
    rim = swing[:, None] + rim.transpose(0, 2, 1)
    # The hip moves along its arc alone: there the form has rank one.
    reach = _root(J_hip @ spread @ J_hip.transpose(0, 2, 1))
    along = np.stack([np.cos(_lean(way, on)), -np.sin(_lean(way, on))], axis=-1)
    reach = np.einsum('nij,nj->ni', reach, along)
    return {
        'tube_hip': np.stack([hip - reach, hip + reach], axis=1),
        'tube_foot': np.stack([rim[:, :-1], rim[:, 1:]], axis=2).reshape(-1, 2, 2),
    }


def surface_segments(
    nodes: Nodes, way: WayHome, node: int, leg_length: float, foot: float = 0.0
) -> np.ndarray:
    """The poses on the surface of a node, with its rates: legs at both ends, hip and foot between.

    Args:
        nodes: The tree.
        way: That leads over the node.
        node: Where the reference is.
        leg_length: In m.
        foot: Where the foot stands at the beginning of the way, m ahead.

    Returns:
        (x ahead, z up) of both ends in m, shape (n, 2, 2), 2 (POSES - 1) + 4 segments; none where
        the node is not on the way, or its surface asks for no angle.
    """
    (rows,) = np.nonzero(way.nodes == node)
    normal = nodes.surfaces[node, 0, :2] if len(rows) else np.zeros(2)
    if not normal.any():
        return np.zeros((0, 2, 2))
    row = int(rows[0])
    turn = np.array([normal[1], -normal[0], 0.0, 0.0])
    turn /= np.abs(turn).max()
    cost = float(turn @ nodes.F[node] @ turn)
    rho = float(nodes.rho[node])
    reach = np.sqrt(rho / cost) if cost > 0 and 0 < rho < np.inf else LARGEST
    states = way.states[row] + np.linspace(-1, 1, POSES)[:, None] * min(reach, LARGEST) * turn
    stands = np.array([way.feet(leg_length, foot)[row], 0.0])
    leg = int(way.stance[row])
    up = leg_length * np.stack([np.sin(states[:, :2]), np.cos(states[:, :2])], axis=-1)
    hip = stands + up[:, leg]
    swing = hip - up[:, 1 - leg]
    legs = [(stands, hip[0]), (hip[0], swing[0]), (stands, hip[-1]), (hip[-1], swing[-1])]
    lines = [np.stack([line[:-1], line[1:]], axis=1) for line in (hip, swing)]
    return np.concatenate([np.array(legs), *lines])


def _places(
    way: WayHome, rows: np.ndarray, leg_length: float, foot: float
) -> tuple[np.ndarray, np.ndarray]:
    """Hip and swing foot at rows of a way, (n, 2) each."""
    points = way.points(leg_length, foot)
    feet = np.stack([points[f'{leg}_foot'][rows] for leg in STANCES])
    return points['hip'][rows], feet[1 - way.stance[rows], np.arange(len(rows))]


def _lean(way: WayHome, rows: np.ndarray) -> np.ndarray:
    return way.states[rows, way.stance[rows]]


def _jacobians(
    states: np.ndarray, stance: np.ndarray, leg_length: float
) -> tuple[np.ndarray, np.ndarray]:
    """How hip and swing foot move with the state, (n, 2, 4) each."""
    rows = np.arange(len(states))
    turned = leg_length * np.stack([np.cos(states[:, :2]), -np.sin(states[:, :2])], axis=-1)
    hip = np.zeros((len(states), 2, 4))
    hip[rows, :, stance] = turned[rows, stance]
    swing = hip.copy()
    swing[rows, :, 1 - stance] = -turned[rows, 1 - stance]
    return hip, swing


def _inverse(forms: np.ndarray) -> np.ndarray:
    """F^-1, where rounding may have made the least eigenvalue of F negative: (n, 4, 4)."""
    values, vectors = np.linalg.eigh(forms)
    values = np.maximum(values, 1e-9 * values[:, -1:])
    return (vectors / values[:, None]) @ vectors.transpose(0, 2, 1)


def _root(forms: np.ndarray) -> np.ndarray:
    """The symmetric root of forms (n, 2, 2), no wider than LARGEST."""
    values, vectors = np.linalg.eigh(forms)
    widths = np.clip(np.sqrt(np.maximum(values, 0.0)), 0.0, LARGEST)
    return (vectors * widths[:, None]) @ vectors.transpose(0, 2, 1)
