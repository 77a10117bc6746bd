"""Time-varying linear-quadratic regulation along a hybrid trajectory (thesis, 4.5).

    min int (x'Q x + u'R u) dt + x(T)'Q_f x(T),   dx/dt = A(t) x + B(t) u  (deviations)
    -dS/dt = Q + S A + A'S - S B R^-1 B'S,  S(T) = Q_f,   u = u0 - K (x - x0),  K = R^-1 B'S  (RIC)

(RIC) is solved exactly in S: with S = Y X^-1 it is linear, d(X, Y)/dt = H(t) (X, Y), and

    H = [A, -B R^-1 B'; -Q, -A'],   (X, Y)(t) = exp(-Omega) (X, Y)(t + h)
    Omega = h/2 (H1 + H2) - sqrt(3) h^2/12 [H1, H2]                               (MAG4)

is Magnus' fourth order from the two Gauss points of each interval. At an impact a deviation jumps
by the saltation matrix, which counts that a deviating robot lands at another time: with the
impact map Delta, its derivative D, the guard's gradient n and rates f before and after,

    Xi = D + (f+ - D f-) n' / (n'f-),   S- = Xi' S+ Xi                            (SALT)
"""

import functools
import math
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from scipy.linalg.lapack import dgesv

from cg_control.balancing.balance import BalanceSettings
from cg_control.balancing.linearise import linearise_stance
from cg_control.balancing.lqr import Regulator, lqr
from cg_control.trajectories.collocation import planning_model
from cg_control.trajectories.trajectory import Phase, Trajectory, TrajectoryError
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.linearise import without_dry_friction
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import CompiledModel, compile_model
from cg_dynamics.walking.hybrid import STANCES
from cg_dynamics.walking.impact import impact_function

SWEEPS, SETTLED = 200, 1e-9  # periods until a cost to go repeats itself, and to what share
GAUSS = 0.5 - math.sqrt(3) / 6, 0.5 + math.sqrt(3) / 6


@dataclass(frozen=True)
class Weights:
    """Costs of deviations, by the role of a leg: they change places with the stance leg.

    The defaults are, rounded, those of the balance controller.

    Attributes:
        stance_angle: 1/rad^2. The highest, says the thesis: it decides who still stands.
        swing_angle: 1/rad^2. The second.
        stance_rate: s^2/rad^2. Far below.
        swing_rate: s^2/rad^2. Far below.
        torque: 1/(N m)^2.
        final: Final cost, as a multiple of the balance controller's cost to go.
    """

    stance_angle: float = 178.0
    swing_angle: float = 11.0
    stance_rate: float = 69.0
    swing_rate: float = 0.016
    torque: float = 1 / 1600
    final: float = 1.0

    def __post_init__(self):
        for name in ('stance_angle', 'swing_angle', 'stance_rate', 'swing_rate'):
            if not getattr(self, name) >= 0:
                raise ValueError(f'{name} is {getattr(self, name)}; it must not be negative')
        for name in ('torque', 'final'):
            if not getattr(self, name) > 0:
                raise ValueError(f'{name} is {getattr(self, name)}; it must be positive')

    def Q(self, stance: str) -> np.ndarray:
        """Weight of (q_inner, q_outer) and rates while that leg stands, shape (4, 4)."""
        roles = [self.stance_angle, self.swing_angle, self.stance_rate, self.swing_rate]
        order = [0, 1, 2, 3] if stance == 'inner' else [1, 0, 3, 2]
        return np.diag([roles[i] for i in order])

    @property
    def R(self) -> np.ndarray:
        """Weight of the torque, shape (1, 1)."""
        return np.array([[self.torque]])


def balance_regulator(
    model: Model, stance: str, settings: BalanceSettings | None = None
) -> Regulator:
    """The balance controller of the upright robot on one leg, in continuous time.

    Args:
        model: A compass gait.
        stance: Stance leg.
        settings: Its scales are the weights, 1/scale^2.
    """
    s = settings or BalanceSettings()
    weights = Weights(
        1 / s.lean_scale**2, 1 / s.swing_scale**2, 1 / s.lean_rate_scale**2,
        1 / s.swing_rate_scale**2, 1 / s.torque_scale**2,
    )  # fmt: skip
    linear = linearise_stance(model, stance)
    return lqr(linear.A, linear.B, weights.Q(stance), weights.R)


def stabilise(
    trajectory: Trajectory,
    model: Model,
    weights: Weights | None = None,
    final_cost: np.ndarray | None = None,
    saltation: bool = True,
) -> Trajectory:
    """The trajectory with gains and cost to go at its knots.

    Args:
        trajectory: Planned for this model.
        model: Linearised as it is planned on, less dry friction: what is known of the command path
            (a weak motor) scales the gains.
        weights: Of deviations.
        final_cost: Q_f, shape (4, 4); None takes that of `balance_regulator` on the last leg.
        saltation: (SALT) at impacts; False takes D alone, as if all robots landed on time.

    Raises:
        TrajectoryError: if the trajectory is another model's.
    """
    trajectory.require_model(model)
    weights = weights or Weights()
    design = without_dry_friction(planning_model(model))
    S = final_cost
    if S is None:
        S = weights.final * balance_regulator(model, trajectory.modes[-1]).S
    S = np.array(S, float)
    if S.shape != (4, 4) or not np.allclose(S, S.T):
        raise ValueError(f'final_cost must be a symmetric (4, 4) matrix, got shape {S.shape}')
    phases: list[Phase] = []
    after: Phase | None = None
    for phase in reversed(trajectory.phases):
        if after is not None:
            jump = jump_matrix(design, phase, after, trajectory.provenance.get('slope', 0.0))
            if not saltation:
                jump = impact_derivative(design, phase)
            S = jump.T @ S @ jump
        gains, costs = riccati(design, phase, weights.Q(phase.stance), weights.R, S)
        S = costs[0]
        after = phase
        phases.append(replace(phase, gains=gains, cost_to_go=costs))
    return trajectory.with_phases(tuple(reversed(phases)), weights=vars(weights))


def stabilise_periodically(
    trajectory: Trajectory,
    model: Model,
    weights: Weights | None = None,
    restarts: bool = False,
) -> Trajectory:
    """An orbit with gains over time and the cost to go that repeats itself after a period.

    Args:
        trajectory: Periodic, planned for this model.
        model: As in `stabilise`.
        weights: Of deviations; `final` has no part.
        restarts: The clock starts anew where a foot lands, (RESTART) of walking.md, as
            with the remedy `event` of tracking.py; else it goes on, (SALT).

    Raises:
        TrajectoryError: if the motion is not periodic, or the cost to go does not settle.
    """
    trajectory.require_model(model)
    if not trajectory.provenance.get('periodic', False):
        raise TrajectoryError('the trajectory is not periodic; no cost to go repeats itself')
    weights = weights or Weights()
    design = without_dry_friction(planning_model(model))
    slope, phases = trajectory.provenance.get('slope', 0.0), trajectory.phases
    jumps = [
        jump_matrix(design, phase, phases[(k + 1) % len(phases)], slope, restarts)
        for k, phase in enumerate(phases)
    ]
    S = weights.Q(phases[0].stance)
    for _ in range(SWEEPS):
        before, found = S, []
        for phase, jump in zip(reversed(phases), reversed(jumps), strict=True):
            gains, costs = riccati(
                design, phase, weights.Q(phase.stance), weights.R, jump.T @ S @ jump
            )
            found.append(replace(phase, gains=gains, cost_to_go=costs))
            S = costs[0]
        size = np.abs(S).max()
        if not np.isfinite(size):
            break
        if np.abs(S - before).max() <= SETTLED * size:
            return trajectory.with_phases(tuple(reversed(found)), weights=vars(weights))
    raise TrajectoryError(f'the cost to go does not settle within {SWEEPS} periods')


def riccati(
    design: Model, phase: Phase, Q: np.ndarray, R: np.ndarray, S: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(RIC) backward along one phase from S at its end.

    Args:
        design: Model to linearise.
        phase: With n knots.
        Q: Shape (nx, nx).
        R: Shape (1, 1).
        S: At the end of the phase, shape (nx, nx).

    Returns:
        Gains K, shape (n, nx), and costs to go S, shape (n, nx, nx), at the knots.
    """
    h = np.diff(phase.time)
    first, second = (_between(phase, share) for share in GAUSS)
    x = np.vstack([first[0], second[0], phase.states])
    u = np.concatenate([first[1], second[1], phase.torque])
    A, B = linearised(design, phase.stance, x, u)
    n, nx = len(h), x.shape[1]
    flows = hamiltonian_flows(
        h, A[: 2 * n].reshape(2, n, nx, nx), B[: 2 * n].reshape(2, n, nx, 1), Q, R
    )
    costs = costs_backward(flows, S)
    gains = (np.linalg.inv(R) @ B[2 * n :].transpose(0, 2, 1) @ costs)[:, 0, :]
    return gains, costs


def hamiltonian_flows(
    h: np.ndarray, A: np.ndarray, B: np.ndarray, Q: np.ndarray, R: np.ndarray
) -> np.ndarray:
    """exp(-Omega) of (MAG4) for every interval, shape (n, 2m, 2m).

    Args:
        h: Lengths of the intervals, s, shape (n,).
        A: At both Gauss points of each, shape (2, n, m, m).
        B: As A, shape (2, n, m, 1).
        Q: Shape (m, m), or one each as A.
        R: Shape (1, 1).
    """
    m = A.shape[-1]
    H = np.empty((*A.shape[:2], 2 * m, 2 * m))
    H[..., :m, :m] = A
    H[..., :m, m:] = -(B @ np.linalg.inv(R)) @ B.swapaxes(-1, -2)
    H[..., m:, :m] = -Q
    H[..., m:, m:] = -A.swapaxes(-1, -2)
    return exponentials(-magnus(h, H))


def magnus(h: np.ndarray, H: np.ndarray) -> np.ndarray:
    """Omega of (MAG4), shape (n, m, m), from H at both Gauss points, shape (2, n, m, m)."""
    step = h[:, None, None]
    commutator = H[0] @ H[1] - H[1] @ H[0]
    return step / 2 * (H[0] + H[1]) - math.sqrt(3) / 12 * step**2 * commutator


def costs_backward(flows: np.ndarray, S: np.ndarray) -> np.ndarray:
    """Costs to go at the n + 1 knots, shape (n + 1, m, m), from S at the last one.

    Args:
        flows: Of the n intervals, as `hamiltonian_flows` gives them.
        S: Shape (m, m).
    """
    n, m = len(flows), flows.shape[-1] // 2
    costs = np.empty((n + 1, m, m))
    costs[n] = S
    constant, linear = flows[:, :, :m].copy(), flows[:, :, m:].copy()
    for k in range(n - 1, -1, -1):
        XY = constant[k] + linear[k] @ S
        # LAPACK itself: numpy's checks take longer than four equations.
        S = dgesv(XY[:m].T, XY[m:].T)[2]
        costs[k] = S = (S + S.T) / 2
    return costs


def _between(phase: Phase, share: float) -> tuple[np.ndarray, np.ndarray]:
    """States and torques at one share of every interval."""
    h = np.diff(phase.time)[:, None]
    s, r = share, 1 - share
    x0, x1, d0, d1 = phase.states[:-1], phase.states[1:], phase.rates[:-1], phase.rates[1:]
    x = (1 + 2 * s) * r**2 * x0 + (1 + 2 * r) * s**2 * x1 + h * s * r * (r * d0 - s * d1)
    return x, r * phase.torque[:-1] + s * phase.torque[1:]


def linearised(
    design: Model, stance: str, x: np.ndarray, u: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """A (n, nx, nx) and B (n, nx, 1) at n states (n, nx) and torques (n,)."""
    setup = Setup(stance=stance)
    function = _mapped(compile_model(design, setup), len(x))
    A, B = function(x.T, u[None, :], parameter_vector(design, setup))
    n, nx = x.shape
    # Columns stand side by side, one state's matrix after the other.
    A = np.asarray(A).reshape(nx, n, nx).transpose(1, 0, 2)
    return A, np.asarray(B).T.reshape(n, nx, 1)


@functools.cache
def _mapped(compiled: CompiledModel, n: int) -> ca.Function:
    e = compiled.equations
    by_x, by_u = ca.jacobian(e.rates, e.x), ca.jacobian(e.rates, e.u)
    dense = list(ca.cse([ca.densify(by_x), ca.densify(by_u)]))
    x, u = ca.MX.sym('x', compiled.nx, n), ca.MX.sym('u', compiled.nu, n)
    p = ca.MX.sym('p', compiled.np)
    A, B = ca.Function('AB', [e.x, e.u, e.p], dense).map(n)(x, u, ca.repmat(p, 1, n))
    return ca.Function('along', [x, u, p], [A, B])


def exponentials(a: np.ndarray) -> np.ndarray:
    """Exp of each matrix of a stack (n, m, m): Pade of order 5 with scaling and squaring."""
    norm = np.abs(a).sum(axis=-1).max()
    # Below a norm of 0.25 the approximant of order 5 errs by less than 1e-13.
    squarings = max(0, math.ceil(math.log2(max(norm, 1e-300) / 0.25)))
    a = a / 2**squarings
    identity = np.eye(a.shape[-1])
    a2 = a @ a
    a4 = a2 @ a2
    odd = a @ (a4 + 420 * a2 + 15120 * identity)
    even = 30 * a4 + 3360 * a2 + 30240 * identity
    result = np.linalg.solve(even - odd, even + odd)
    for _ in range(squarings):
        result = result @ result
    return result


def impact_derivative(model: Model, before: Phase) -> np.ndarray:
    """D of (SALT), shape (4, 4): how the state after an impact follows the state before."""
    x = before.states[-1]
    function = _impact_jacobian(impact_function(model, before.stance))
    by_q, by_v = function(x[:2], x[2:], parameter_vector(model, Setup(stance=before.stance)))
    D = np.eye(4)
    D[2:, :2], D[2:, 2:] = np.asarray(by_q), np.asarray(by_v)
    return D


@functools.cache
def _impact_jacobian(function: ca.Function) -> ca.Function:
    q, v, p = (ca.SX.sym(name, function.size1_in(i)) for i, name in enumerate('qvp'))
    v_plus = function(q, v, p)[0]
    return ca.Function('impact_jacobian', [q, v, p],
                       [ca.jacobian(v_plus, q), ca.jacobian(v_plus, v)])  # fmt: skip


def jump_matrix(
    model: Model, before: Phase, after: Phase, slope: float = 0.0, restarts: bool = False
) -> np.ndarray:
    """(SALT), shape (4, 4), at the impact between two phases.

    Args:
        model: Of the impact.
        before: The phase that ends.
        after: The phase that begins.
        slope: Of the ground, rad.
        restarts: The clock of what follows starts at the impact, whenever that is: deviations
            are compared at the impact itself, and f+ has no part, walking.md, (RESTART).
    """
    D = impact_derivative(model, before)
    normal = guard_gradient(before.stance, before.states[-1], slope)
    f_minus, f_plus = before.rates[-1], after.rates[0]
    approach = normal @ f_minus
    if not approach < 0:
        raise TrajectoryError(
            f'the swing foot does not come down at {before.end:.3f} s; its impact has no instant'
        )
    moved_on = np.zeros(4) if restarts else f_plus
    return D + np.outer(moved_on - D @ f_minus, normal) / approach


def guard_gradient(stance: str, x: np.ndarray, slope: float = 0.0) -> np.ndarray:
    """Gradient of the height of the swing foot, (GUARD), over the leg length: shape (4,)."""
    st, tangent = STANCES.index(stance), math.tan(slope)
    normal = np.zeros(4)
    normal[st] = -math.sin(x[st]) + tangent * math.cos(x[st])
    normal[1 - st] = math.sin(x[1 - st]) - tangent * math.cos(x[1 - st])
    return normal
