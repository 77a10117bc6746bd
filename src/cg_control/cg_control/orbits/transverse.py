"""Transverse linear-quadratic regulation: theory.md, "Transverse coordinates".

A state on the surface of phase s is x = x0(s) + E(s) z, with E the frame of the surface and z its
three coordinates. Exactly, and to first order in z and the torque v = u - u0(s),

    ds/dt = n'f / (n'x0' - n_s'E z),   dz/dt = Pi (f - E_s z ds/dt)                  (TRV)
    dz/ds = A_z z + B_z v,   A_z = Pi (A E - E_s),   B_z = Pi B                      (TLIN)
    z+ = Pi+ D E- z-                                                                 (TJMP)

Pi takes the coordinates out of a deviation along the flow, so Pi x0' = 0 and Pi E = 1. With the
cost to go z'P z of (TLIN) and (TJMP), solved by (RIC), the full-state gain is K = K_z Pi: a robot
that is early or late, and otherwise on its orbit, gets the torque of its own phase.
"""

import itertools
from dataclasses import dataclass, replace

import numpy as np

from cg_control.orbits.surfaces import (
    IMPACT,
    UNITS,
    Points,
    between,
    design_of,
    in_double_support,
    with_planes,
)
from cg_control.trajectories.trajectory import Phase, Trajectory, TrajectoryError
from cg_control.trajectories.tvlqr import (
    GAUSS,
    Weights,
    balance_regulator,
    costs_backward,
    exponentials,
    hamiltonian_flows,
    jump_matrix,
    linearised,
    magnus,
    stabilise_periodically,
)
from cg_dynamics.model import Model

# The balance controller's weights throw the swing leg away: its rate costs next to nothing there.
TRANSVERSE = Weights(swing_rate=1.0, torque=1 / 100)
# Tuned by the share of starts around two orbits that walk on; checked on others.
OVER_PHASE = Weights(swing_angle=35.0, stance_rate=100.0, swing_rate=0.002, torque=1 / 2300)
SWEEPS = 200  # round the orbit, after which its Riccati equation is said not to converge
CONVERGED = 1e-10  # of the largest cost to go, from sweep to sweep

# The units of quaternions: I n, J n, K n are orthogonal to n and to each other, and as long as n.
QUATERNION = np.array([
    [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 0, -1], [0, 0, 1, 0]],
    [[0, 0, -1, 0], [0, 0, 0, 1], [1, 0, 0, 0], [0, -1, 0, 0]],
    [[0, 0, 0, -1], [0, 0, -1, 0], [0, 1, 0, 0], [1, 0, 0, 0]],
], float)  # fmt: skip


class UnstableError(TrajectoryError):
    """No transverse feedback stabilises the motion."""


def frame(normal: np.ndarray) -> np.ndarray:
    """E: columns that span the surface of each normal (..., 4), shape (..., 4, 3).

    Linear in the normal, hence smooth wherever it is; in units the columns are orthogonal.
    """
    columns = np.einsum('aij,...j->...ia', QUATERNION, normal * UNITS)
    return UNITS[:, None] * columns


def projection(normal: np.ndarray, rate: np.ndarray) -> np.ndarray:
    """Pi: the coordinates in `frame` of deviations, shape (..., 3, 4).

    Args:
        normal: n, shape (..., 4).
        rate: x0', the direction along which deviations are projected, shape (..., 4).
    """
    E, length = frame(normal), (normal * UNITS) ** 2
    onto = (E / (UNITS**2)[:, None]).swapaxes(-1, -2) / length.sum(axis=-1)[..., None, None]
    crossing = (normal * rate).sum(axis=-1)[..., None, None]
    return onto @ (np.eye(4) - rate[..., :, None] * normal[..., None, :] / crossing)


def transverse_linearisation(
    design: Model, stance: str, points: Points
) -> tuple[np.ndarray, np.ndarray]:
    """A_z (n, 3, 3) and B_z (n, 3, 1) of (TLIN).

    Args:
        design: Model to linearise.
        stance: Leg that stands.
        points: Of a motion with surfaces, n of them.
    """
    A, B = linearised(design, stance, points.states, points.torque)
    Pi = projection(points.normals, points.rates)
    return Pi @ (A @ frame(points.normals) - frame(points.turning)), Pi @ B


def stabilise_transversely(
    trajectory: Trajectory,
    model: Model,
    weights: Weights | None = None,
    final_cost: np.ndarray | None = None,
) -> Trajectory:
    """The trajectory with gains K_z Pi and costs to go Pi'P Pi, of rank 3, at its knots.

    Where it has no surfaces, gains and costs are those of (RIC) over time.

    Args:
        trajectory: With surfaces. A periodic one gets the cost to go that repeats itself.
        model: The one it was planned for.
        weights: Of deviations in the surface; None takes TRANSVERSE.
        final_cost: Of deviations at the end of a motion that is not periodic, shape (4, 4), such
            as the cost to go of the orbit there; None: `weights.final` times that of
            `balance_regulator` on the last leg.

    Raises:
        UnstableError: if the cost to go does not settle round the orbit.
        TrajectoryError: for another model's trajectory, or one without surfaces.
    """
    trajectory.require_model(model)
    weights = weights or TRANSVERSE
    design = design_of(trajectory, model)
    pieces = [_pieces(design, phase, weights) for phase in trajectory.phases]
    if not any(piece.frame is not None for of_phase in pieces for piece in of_phase):
        raise TrajectoryError('the trajectory has no surfaces; give it some first')
    jumps = _jumps(design, trajectory)
    if trajectory.provenance.get('periodic', False):
        if final_cost is not None:
            raise ValueError('final_cost: a periodic motion has no end that could cost anything')
        S = _periodic_cost(pieces, jumps, weights.Q(trajectory.modes[-1]))
    elif final_cost is not None:
        S = np.array(final_cost, float)
        if S.shape != (4, 4) or not np.allclose(S, S.T):
            raise ValueError(f'final_cost must be a symmetric (4, 4) matrix, got {S.shape}')
    else:
        slope = trajectory.provenance.get('slope', 0.0)
        if in_double_support(trajectory.states[-1], slope):
            raise ValueError('final_cost is missing: the motion ends on both feet, not upright')
        S = weights.final * balance_regulator(model, trajectory.modes[-1]).S
    phases = []
    costs = _costs(pieces, jumps, S)
    for phase, cost in zip(trajectory.phases, costs, strict=True):
        _, B = linearised(design, phase.stance, phase.states, phase.torque)
        gains = (np.linalg.inv(weights.R) @ B.transpose(0, 2, 1) @ cost)[:, 0, :]
        phases.append(replace(phase, gains=gains, cost_to_go=cost))
    return trajectory.with_phases(tuple(phases), weights=vars(weights), feedback='transverse')


def stabilise_over_phase(
    trajectory: Trajectory, model: Model, weights: Weights | None = None
) -> Trajectory:
    """An orbit with the gains of TVLQR, on surfaces that its own cost to go asks for: (OWN).

    The clock of the design starts anew at impacts, `stabilise_periodically`. The phase of a robot
    is the point of the orbit that costs least to go to, x0'S (x - x0) = 0; a phase ends with the
    impact surface. The cost to go is that of deviations in the surface, of rank 3. Gains see what
    is ahead or behind, too: it counts where the phase cannot follow, at the ends of a phase.

    Args:
        trajectory: Periodic; surfaces that it has are replaced.
        model: The one it was planned for.
        weights: Of deviations; None takes OVER_PHASE.

    Raises:
        TrajectoryError: as `stabilise_periodically`.
    """
    motion = stabilise_periodically(trajectory, model, weights or OVER_PHASE, restarts=True)
    phases = []
    for phase in motion.phases:
        normals, S = _own_normals(phase), phase.cost_to_go
        across = np.eye(4) - phase.rates[:, :, None] * normals[:, None, :]
        cost = across.transpose(0, 2, 1) @ S @ across
        phases.append(replace(phase, normals=normals, cost_to_go=cost))
    return motion.with_phases(tuple(phases), surfaces='own', feedback='over phase')


def with_own_surfaces(
    trajectory: Trajectory, model: Model, weights: Weights | None = None
) -> Trajectory:
    """An orbit with the surfaces that the cost to go of TVLQR asks for, between impact surfaces.

    As (OWN), but a phase begins with the impact surface, too: for `stabilise_transversely`, which
    takes it that no phase is ever wrong.

    Args:
        trajectory: Periodic.
        model: The one it was planned for.
        weights: Of deviations; None takes OVER_PHASE.

    Raises:
        TrajectoryError: as `stabilise_periodically`.
    """
    motion = stabilise_periodically(trajectory, model, weights or OVER_PHASE, restarts=True)
    phases = tuple(
        replace(phase, normals=_own_normals(own, begins=True))
        for phase, own in zip(trajectory.phases, motion.phases, strict=True)
    )
    return trajectory.with_phases(phases, surfaces='own')


def _own_normals(phase: Phase, begins: bool = False) -> np.ndarray:
    """Normals of (OWN) at the knots of a phase with a cost to go over time, (n, 4).

    With `begins` its first surface is the impact surface.
    """
    normals = np.einsum('nij,nj->ni', phase.cost_to_go, phase.rates)
    # There S x0' = 0: whoever lands has ended the phase.
    normals[-1] = IMPACT
    if begins:
        normals[0] = IMPACT
    crossing = np.einsum('ni,ni->n', normals, phase.rates)
    if (crossing <= 0).any():
        at = float(phase.time[np.argmax(crossing <= 0)])
        raise TrajectoryError(f'at {at:.3g} s the motion does not cross its surface forward')
    return normals / crossing[:, None]


@dataclass(frozen=True)
class Piece:
    """Some intervals of a phase that all have surfaces, or all have none.

    Attributes:
        first: Knot at which it begins,
        last: and at which it ends.
        flows: Of (MAG4) in three coordinates with surfaces, else in four.
        frame: E at its end, shape (4, 3); None without surfaces.
        projections: Pi at its knots; None without surfaces.
    """

    first: int
    last: int
    flows: np.ndarray
    frame: np.ndarray | None = None
    projections: np.ndarray | None = None

    def costs(self, S: np.ndarray) -> np.ndarray:
        """Costs to go at its knots, (n + 1, 4, 4), from that of deviations at its end, (4, 4)."""
        if self.frame is None or self.projections is None:
            return costs_backward(self.flows, S)
        P = costs_backward(self.flows, self.frame.T @ S @ self.frame)
        return self.projections.transpose(0, 2, 1) @ P @ self.projections


def _pieces(design: Model, phase: Phase, weights: Weights) -> list[Piece]:
    h, Q = np.diff(phase.time), weights.Q(phase.stance)
    first, second = (between(phase, share) for share in GAUSS)
    pieces, at, end = [], 0, len(h)
    for begin, stop in [*with_planes(phase), (end, end)]:
        if begin > at:
            part = slice(at, begin)
            A, B = zip(*(
                linearised(design, phase.stance, points.states[part], points.torque[part])
                for points in (first, second)
            ), strict=True)  # fmt: skip
            flows = hamiltonian_flows(h[part], np.array(A), np.array(B), Q, weights.R)
            pieces.append(Piece(at, begin, flows))
        if stop > begin:
            part = slice(begin, stop)
            of_part = [points.cut(part) for points in (first, second)]
            A, B = zip(*(
                transverse_linearisation(design, phase.stance, points) for points in of_part
            ), strict=True)  # fmt: skip
            E = np.array([frame(points.normals) for points in of_part])
            flows = hamiltonian_flows(
                h[part], np.array(A), np.array(B), E.swapaxes(-1, -2) @ Q @ E, weights.R
            )
            knots = slice(begin, stop + 1)
            pieces.append(Piece(
                begin, stop, flows, frame(phase.normals[stop]),
                projection(phase.normals[knots], phase.rates[knots]),
            ))  # fmt: skip
        at = stop
    return pieces


def _jumps(design: Model, trajectory: Trajectory) -> list[np.ndarray | None]:
    """(SALT) at the end of each phase; None at the end of a motion that is not periodic."""
    slope = trajectory.provenance.get('slope', 0.0)
    phases = trajectory.phases
    jumps: list[np.ndarray | None] = [
        jump_matrix(design, before, after, slope) for before, after in itertools.pairwise(phases)
    ]
    if not trajectory.provenance.get('periodic', False):
        return [*jumps, None]
    if phases[-1].stance == phases[0].stance:
        raise TrajectoryError('a period ends on the leg that it begins on: half of it is missing')
    return [*jumps, jump_matrix(design, phases[-1], phases[0], slope)]


def _costs(
    pieces: list[list[Piece]], jumps: list[np.ndarray | None], S: np.ndarray
) -> list[np.ndarray]:
    """Costs to go at the knots of every phase, from the one after everything."""
    phases = []
    for of_phase, jump in zip(reversed(pieces), reversed(jumps), strict=True):
        if jump is not None:
            S = jump.T @ S @ jump
        costs = np.empty((of_phase[-1].last + 1, 4, 4))
        for piece in reversed(of_phase):
            costs[piece.first : piece.last + 1] = piece.costs(S)
            S = costs[piece.first]
        phases.append(costs)
    return phases[::-1]


def _periodic_cost(
    pieces: list[list[Piece]], jumps: list[np.ndarray | None], S: np.ndarray
) -> np.ndarray:
    """The cost to go right after the last impact that comes back round the orbit."""
    for _ in range(SWEEPS):
        before, S = S, _costs(pieces, jumps, S)[0][0]
        size = np.abs(S).max()
        if not np.isfinite(size):
            break
        if np.abs(S - before).max() <= CONVERGED * size:
            return S
    raise UnstableError(
        f'the cost to go does not settle within {SWEEPS} periods: the torque does not reach '
        'what is unstable about the orbit'
    )


def monodromy(trajectory: Trajectory, model: Model, parts: int = 4) -> np.ndarray:
    """How z at the start of a periodic motion is mapped to z a period later, shape (3, 3).

    Under the gains of the trajectory, whichever they are; its eigenvalues are the multipliers.

    Args:
        trajectory: Periodic, with surfaces at every knot.
        model: The one it was planned for.
        parts: Steps of (MAG4) between two knots.

    Raises:
        TrajectoryError: for a motion that is not periodic, or without surfaces somewhere.
    """
    design = design_of(trajectory, model)
    phases = trajectory.phases
    if not trajectory.provenance.get('periodic', False):
        raise TrajectoryError('the trajectory is not periodic; it has no multipliers')
    result = np.eye(3)
    for k, (phase, jump) in enumerate(zip(phases, _jumps(design, trajectory), strict=True)):
        if with_planes(phase) != [(0, len(phase.time) - 1)]:
            raise TrajectoryError('the trajectory has no surfaces at some of its knots')
        h = np.diff(phase.time) / parts
        steps = np.array([
            exponentials(magnus(h, np.array([
                _closed_loop(design, phase, (part + share) / parts) for share in GAUSS
            ])))
            for part in range(parts)
        ])  # fmt: skip
        for interval in range(len(h)):
            for part in range(parts):
                result = steps[part, interval] @ result
        after = phases[(k + 1) % len(phases)]
        onto = projection(after.normals[0], after.rates[0])
        result = onto @ jump @ frame(phase.normals[-1]) @ result
    return result


def _closed_loop(design: Model, phase: Phase, share: float) -> np.ndarray:
    """A_z - B_z K E at one share of every interval."""
    points = between(phase, share)
    A, B = transverse_linearisation(design, phase.stance, points)
    K = (1 - share) * phase.gains[:-1] + share * phase.gains[1:]
    return A - B @ (K[:, None, :] @ frame(points.normals))
