"""The exact motion from knot to knot, and how it depends on where and how it starts.

From a knot x under a torque that is linear from u to u+ over h seconds, with s = t/h,

    dx/ds = h f(x, (1 - s) u + s u+)                                               (FLOW)
    dX/ds = h (A - B K) X + h B (0, 1 - s, s, 0) + f (0, 0, 0, 1)

X are the derivatives of x by the start, by u, by u+ and by h. K is the gain of a feedback
u - K (x - x0), linear between knots as well. Both equations are solved together, for all intervals
of a phase at once, by extrapolating the midpoint rule in h^2 (Gragg, Bulirsch and Stoer): with
steps of h/2, h/4 ... h/16 that is of order 16, and errs by rounding for intervals of 0.2 s.
"""

import functools
from dataclasses import dataclass

import casadi as ca
import numpy as np

from cg_control.trajectories.trajectory import Phase
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import CompiledModel, compile_model

SUBSTEPS = np.arange(2, 17, 2)


@dataclass(frozen=True)
class Flow:
    """Where n knots get to.

    Attributes:
        end: States, shape (n, 4).
        by_state: Derivative of the end by the start, shape (n, 4, 4).
        by_torque: By the torque at the start and at the end, shape (n, 4, 2).
        by_duration: By the duration, the torque being linear in the share of it, shape (n, 4).
    """

    end: np.ndarray
    by_state: np.ndarray
    by_torque: np.ndarray
    by_duration: np.ndarray


def phase_flow(model: Model, phase: Phase, feedback: bool = False) -> Flow:
    """From each knot of a phase but the last to the time of the next one.

    Args:
        model: In four states.
        phase: With n + 1 knots.
        feedback: Derivatives are those under the gains of the phase.
    """
    pairs = np.column_stack([phase.torque[:-1], phase.torque[1:]])
    gains = np.stack([phase.gains[:-1], phase.gains[1:]], axis=1) if feedback else None
    return flow(model, phase.stance, phase.states[:-1], pairs, np.diff(phase.time), gains)


def flow(
    model: Model,
    stance: str,
    x: np.ndarray,
    u: np.ndarray,
    h: np.ndarray,
    gains: np.ndarray | None = None,
) -> Flow:
    """(FLOW) from n states.

    Args:
        model: In four states, without delays.
        stance: Leg that stands.
        x: States, shape (n, 4).
        u: Torques at the start and at the end, shape (n, 2), N m.
        h: Durations in s, shape (n,).
        gains: K at the start and at the end, shape (n, 2, 4); None: no feedback.
    """
    n, setup = len(x), Setup(stance=stance)
    derivatives = _derivatives(compile_model(model, setup), n)
    p, step = parameter_vector(model, setup), h[:, None, None]

    def rates(s: float, y: np.ndarray) -> np.ndarray:
        shares = np.array([1 - s, s])
        f, A, B = derivatives(y[:, :, 0].T, (u @ shares)[None, :], p)
        f = np.asarray(f).T
        # Columns stand side by side, one state's matrix after the other.
        A = np.asarray(A).reshape(4, n, 4).transpose(1, 0, 2)
        B = np.asarray(B).T[:, :, None]
        by_x = A if gains is None else A - B @ (shares @ gains)[:, None, :]
        dy = np.empty_like(y)
        dy[:, :, 0] = f
        dy[:, :, 1:] = by_x @ y[:, :, 1:]
        dy[:, :, 5:7] += B * shares
        dy *= step
        dy[:, :, 7] += f
        return dy

    start = np.zeros((n, 4, 8))
    start[:, :, 0], start[:, :, 1:5] = x, np.eye(4)
    first = rates(0.0, start)
    row: list[np.ndarray] = []
    for j, count in enumerate(SUBSTEPS):
        before, y = start, start + first / count
        for k in range(1, count):
            before, y = y, before + 2 / count * rates(k / count, y)
        # Neville's scheme, in place: row[i] becomes the value of order 2 (j - i + 1).
        new = [y]
        for i in range(j):
            ratio = (count / SUBSTEPS[j - 1 - i]) ** 2
            new.append(new[i] + (new[i] - row[i]) / (ratio - 1))
        row = new
    y = row[-1]
    return Flow(y[:, :, 0], y[:, :, 1:5], y[:, :, 5:7], y[:, :, 7])


def state_rates(model: Model, stance: str, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """dx/dt, shape (n, 4), at n states (n, 4) and torques (n,)."""
    setup = Setup(stance=stance)
    f, _, _ = _derivatives(compile_model(model, setup), len(x))(
        x.T, u[None, :], parameter_vector(model, setup)
    )
    return np.asarray(f).T


@functools.cache
def _derivatives(compiled: CompiledModel, n: int) -> ca.Function:
    """(x, u, p) -> f, A, B, side by side for n states."""
    e = compiled.equations
    results = [e.rates, ca.jacobian(e.rates, e.x), ca.jacobian(e.rates, e.u)]
    dense = list(ca.cse([ca.densify(result) for result in results]))
    x, u = ca.MX.sym('x', compiled.nx, n), ca.MX.sym('u', compiled.nu, n)
    p = ca.MX.sym('p', compiled.np)
    outputs = ca.Function('fAB', [e.x, e.u, e.p], dense).map(n)(x, u, ca.repmat(p, 1, n))
    return ca.Function('flow', [x, u, p], list(outputs))
