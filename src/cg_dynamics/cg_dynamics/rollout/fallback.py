"""Rollouts on CasADi's virtual machine: what rollout.c does, where there is no C compiler.

One Runge-Kutta step of the state, and one of the variational equations by all initial states, all
free parameters and the delay, are CasADi functions; `mapaccum` chains them over a chunk of steps.
The sensitivities that a caller asks for follow by the chain rule. Arguments and results are
those of NativeRollout, arrays that are filled included.
"""

import functools
from dataclasses import dataclass

import casadi as ca
import numpy as np

from cg_dynamics.assemble import Equations
from cg_dynamics.rollout.accuracy import HALVINGS, Accuracy

CHUNK = 128
# As in rollout.c, which gets them from here.
STATE_LIMIT = 1e6  # of any state; beyond, the motion has run away
STABLE = 2.5  # step times rate of decay; the method's limit is 2.785
EASY = 0.03  # of the tolerance: a step of fourth order twice as long errs 16 times as much


@dataclass(frozen=True)
class Simulated:
    """A record as a model goes along it.

    Attributes:
        outputs: At the rows before the state ran away, shape (done, ny).
        states: Shape (n, nx), of which so many rows count.
        steps: Of each row, for the sensitivities of NativeRollout.
    """

    outputs: np.ndarray
    states: np.ndarray
    steps: np.ndarray


class InterpretedRollout:
    """The functions of NativeRollout for one set of equations.

    Args:
        equations: The model.
        free: Names of the parameters with sensitivities.
    """

    def __init__(self, equations: Equations, free: tuple[str, ...]):
        e = self.equations = equations
        self.nx, self.nu, self.ny = e.x.shape[0], e.u.shape[0], e.outputs.shape[0]
        self.nf = len(free)
        where = [e.parameter_names.index(name) for name in free]
        self._free = ca.vertcat(*(e.p[i] for i in where)) if where else ca.SX(0, 1)
        self._f = ca.Function('f', [e.x, e.u, e.p], [e.rates])
        self._h = ca.Function('h', [e.x, e.u, e.p], [e.outputs])

    # --- the interface of NativeRollout -----------------------------------------------------

    def cgm_advance(self, x, u, p, h: float, n: int) -> None:
        """N Runge-Kutta steps of h seconds, in place."""
        steps = np.full(n, h)
        path = self._chain(self._step, x, np.repeat(u[:, None], n, 1), p, steps)
        if n:
            x[:] = path[:, -1]

    def cgm_simulate(
        self, n: int, dt, longest: float, tolerance: float, halvings: int, u, x0, p, X, most, steps
    ) -> int:
        """States at all rows; the number of rows before the state ran away."""
        path, row, _ = self._paced(dt, u, p, x0, Accuracy(longest, tolerance, halvings), None)
        X[:] = path[row]
        return _sane_rows(X)

    def cgm_outputs(self, n: int, time, u, p, X, delay, Y) -> None:
        """Outputs of given states, late by the delays."""
        Y[:] = np.asarray(self._h(X.T, u.T, p)).T
        if not (delay > 0).any():
            return
        ends = [np.asarray(self._f(x.T, v.T, p)).T for x, v in ((X, u), (X[1:], u[:-1]))]
        for j in np.flatnonzero(delay > 0):
            at, late = _interpolate(time, time - delay[j], X, *ends)
            Y[:, j] = np.asarray(self._h(late.T, u[at].T, p))[j]

    def cgm_follow(self, n, time, accuracy: Accuracy, u, x0, p, delay) -> Simulated:
        """The states and outputs of a record, up to where the state runs away."""
        states = np.empty((n, self.nx))
        done = self.cgm_simulate(
            n, np.diff(time), *accuracy, u, x0, p, states, 0, None
        )  # fmt: skip
        y = np.empty((done, self.ny))
        self.cgm_outputs(done, time[:done], u[:done], p, states[:done], delay, y)
        return Simulated(y, states, np.zeros((n, 0), np.int32))

    def cgm_normal(
        self, simulated, n, time, accuracy: Accuracy, u, du, delay_column, x0, S0, p, nc, column,
        measured, weight, delay, delay_to, H, g, Jacobian,
    ) -> None:  # fmt: skip
        """Normal equations of the simulation error (Eq. 4.13)."""
        nx, ny = self.nx, self.ny
        width = nx + self.nf + 1
        # Columns of the full variational equations: initial state, free parameters, delay.
        chain = np.zeros((width, nc))
        chain[:nx] = S0
        for f in np.flatnonzero(column >= 0):
            chain[nx + f, column[f]] += 1
        if delay_column >= 0:
            chain[-1, delay_column] += 1
        start = np.concatenate([x0, np.eye(nx, width).ravel(order='F')])
        _, row, steps = self._paced(np.diff(time), u, p, x0, accuracy, self._decay)
        held = np.repeat(np.hstack([u, du])[:-1], np.diff(row), axis=0).T
        path = self._chain(self._sensitive_step, start, held, p, steps)
        rows = np.hstack([start[:, None], path])[:, row].T
        states = np.ascontiguousarray(rows[:, :nx])
        good = _sane_rows(states)
        states = states[:good]
        S = _matrices(rows[:good, nx:], nx, width) @ chain
        time, u, du, measured = time[:good], u[:good], du[:good], measured[:good]
        y, J = self._sensitive_outputs(states, S, u, p, column)
        slopes = None
        for j in range(ny):
            if delay[j] <= 0 and delay_to[j] < 0:
                continue
            if slopes is None:
                fixed = (delay_column, p, column)
                # The input of a row is held up to the next, so it gives the slope there too.
                slopes = self._slopes(states, S, u, du, *fixed)
                ends = self._slopes(states[1:], S[1:], u[:-1], du[:-1], *fixed)
            t = time - delay[j]
            at, late = _interpolate(time, t, states, slopes[0], ends[0])
            _, late_S = _interpolate(time, t, S, slopes[1], ends[1])
            late_y, late_J = self._sensitive_outputs(late, late_S, u[at], p, column)
            y[:, j], J[:, j] = late_y[:, j], late_J[:, j]
            if delay_to[j] >= 0:
                e = 1e-6
                moving = np.asarray(self._f(late.T, u[at].T, p)).T
                straight = (t <= time[0]) | (at == good - 1)
                moving[straight] = slopes[0][at[straight]]
                ahead = late + e * moving
                value = np.asarray(self._h(ahead.T, u[at].T, p))[j]
                J[:, j, delay_to[j]] -= (value - late_y[:, j]) / e
        if Jacobian is not None:
            Jacobian[:good] = J
        there = ~np.isnan(measured)
        residual = np.where(there, y - measured, 0.0) * weight
        weighted = np.where(there[:, :, None], J, 0.0) * weight[:, None]
        weighted = weighted.reshape(-1, nc)
        g += weighted.T @ residual.ravel()
        H += weighted.T @ weighted

    # --- CasADi functions, built when first needed --------------------------------------------

    @functools.cached_property
    def _step(self) -> ca.Function:
        e = self.equations
        u, h = ca.SX.sym('u', self.nu), ca.SX.sym('h')
        x = _runge_kutta(lambda y: self._f(y, u, e.p), e.x, h)
        return _accumulate(e.x, u, e.p, h, x)

    @functools.cached_property
    def _sensitive_step(self) -> ca.Function:
        e, width = self.equations, self.nx + self.nf + 1
        derivatives = ca.Function(
            'fs',
            [e.x, e.u, e.p],
            [
                e.rates,
                ca.jacobian(e.rates, e.x),
                ca.jacobian(e.rates, e.u),
                ca.jacobian(e.rates, self._free),
            ],
        )
        u, du, h = ca.SX.sym('u', self.nu), ca.SX.sym('du', self.nu), ca.SX.sym('h')
        state = ca.SX.sym('state', self.nx * (1 + width))

        def rates(y):
            S = ca.reshape(y[self.nx :], self.nx, width)
            f, A, B, P = derivatives(y[: self.nx], u, e.p)
            forcing = ca.horzcat(ca.SX.zeros(self.nx, self.nx), P, ca.mtimes(B, du))
            return ca.vertcat(f, ca.vec(ca.mtimes(A, S) + forcing))

        return _accumulate(state, ca.vertcat(u, du), e.p, h, _runge_kutta(rates, state, h))

    @functools.cached_property
    def _probe(self) -> ca.Function:
        """State after a step, and the step's error."""
        e = self.equations
        u, h = ca.SX.sym('u', self.nu), ca.SX.sym('h')
        y, k4 = _last_stage(lambda x: self._f(x, u, e.p), e.x, h)
        scale = ca.DM(e.state_scales) * ca.fmax(1, ca.fabs(e.x))
        error = ca.mmax(ca.fabs(h / 6 * (k4 - self._f(y, u, e.p))) / scale)
        return ca.Function('probe', [e.x, u, e.p, h], [ca.cse(y), error])

    @functools.cached_property
    def _decay(self) -> ca.Function:
        """Rate at which the sum of all modes decays."""
        e = self.equations
        return ca.Function('decay', [e.x, e.u, e.p], [-ca.trace(ca.jacobian(e.rates, e.x))])

    def _paced(self, dt, u, p, x0, accuracy: Accuracy, decay):
        """Steps halved where they err or, with `decay`, are not stable: `follow` in rollout.c.

        Returns:
            States before and after all steps (steps + 1, nx), where the rows are among them (n,),
            and the lengths of the steps.
        """
        path, lengths, row = [np.array(x0, float)], [], [0]
        halved, whole = 0, 1 << HALVINGS
        for held, interval in zip(u[:-1], dt, strict=True):
            pieces = max(1, int(np.ceil(interval / accuracy.longest * (1 - 1e-9))))
            for _ in range(pieces):
                done = 0
                while done < whole:
                    h, size, x = interval / pieces / (1 << halved), whole >> halved, path[-1]
                    if decay and halved < HALVINGS and h * float(decay(x, held, p)) > STABLE:
                        halved += 1
                        continue
                    y, error = self._probe(x, held, p, h)
                    error = float(error) / accuracy.tolerance
                    if error > 1 and halved < accuracy.halvings:
                        halved += 1
                        continue
                    done += size
                    if error < EASY and halved and done % (2 * size) == 0:
                        halved -= 1
                    path.append(np.asarray(y).ravel())
                    lengths.append(h)
            row.append(len(lengths))
        return np.array(path), np.array(row), np.array(lengths)

    @functools.cached_property
    def _hs(self) -> ca.Function:
        e = self.equations
        return ca.Function(
            'hs',
            [e.x, e.u, e.p],
            [
                e.outputs,
                ca.densify(ca.vec(ca.jacobian(e.outputs, e.x))),
                ca.densify(ca.vec(ca.jacobian(e.outputs, self._free))),
            ],
        )

    @functools.cached_property
    def _fs(self) -> ca.Function:
        e = self.equations
        return ca.Function(
            'fs',
            [e.x, e.u, e.p],
            [
                e.rates,
                ca.densify(ca.vec(ca.jacobian(e.rates, e.x))),
                ca.densify(ca.vec(ca.jacobian(e.rates, e.u))),
                ca.densify(ca.vec(ca.jacobian(e.rates, self._free))),
            ],
        )

    def _chain(self, function, x, inputs, p, steps) -> np.ndarray:
        """States after each of the fine steps, shape (n, steps)."""
        done, x = [], np.array(x, float)
        for begin in range(0, len(steps), CHUNK):
            part = slice(begin, begin + CHUNK)
            size = len(steps[part])
            # Steps of no length fill the last chunk: one function serves all lengths.
            u = np.zeros((inputs.shape[0], CHUNK))
            h = np.zeros((1, CHUNK))
            u[:, :size], h[0, :size] = inputs[:, part], steps[part]
            path = np.asarray(function(x, u, p, h))[:, :size]
            done.append(path)
            x = path[:, -1]
        return np.hstack(done) if done else np.zeros((len(x), 0))

    def _sensitive_outputs(self, states, S, u, p, column):
        y, C, D = (np.asarray(a) for a in self._hs(states.T, u.T, p))
        n = len(states)
        J = _matrices(C.T, self.ny, self.nx) @ S
        self._place(J, _matrices(D.T, self.ny, self.nf), column)
        return y.T.copy().reshape(n, self.ny), J

    def _slopes(self, states, S, u, du, delay_column, p, column):
        f, A, B, P = (np.asarray(a) for a in self._fs(states.T, u.T, p))
        dS = _matrices(A.T, self.nx, self.nx) @ S
        self._place(dS, _matrices(P.T, self.nx, self.nf), column)
        if delay_column >= 0:
            B = _matrices(B.T, self.nx, self.nu)
            dS[:, :, delay_column] += np.einsum('kij,kj->ki', B, du)
        return f.T, dS

    @staticmethod
    def _place(J, by_free, column) -> None:
        for f in np.flatnonzero(column >= 0):
            J[:, :, column[f]] += by_free[:, :, f]


def _runge_kutta(rates, x, h):
    return _last_stage(rates, x, h)[0]


def _last_stage(rates, x, h):
    """Where a step leads, and the slope of its last stage."""
    k1 = rates(x)
    k2 = rates(x + h / 2 * k1)
    k3 = rates(x + h / 2 * k2)
    k4 = rates(x + h * k3)
    return x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4), k4


def _accumulate(x, u, p, h, x_next) -> ca.Function:
    step = ca.Function('step', [x, u, p, h], [ca.cse(x_next)])
    chain = step.mapaccum('chain', CHUNK)
    # mapaccum wants p once per step; hand it one column and repeat it inside.
    X0, U = ca.MX.sym('x', x.shape[0]), ca.MX.sym('u', u.shape[0], CHUNK)
    P, steps = ca.MX.sym('p', p.shape[0]), ca.MX.sym('h', 1, CHUNK)
    return ca.Function('chain', [X0, U, P, steps], [chain(X0, U, ca.repmat(P, 1, CHUNK), steps)])


def _sane_rows(states) -> int:
    bad = ~(np.abs(states) < STATE_LIMIT).all(axis=1)
    bad[0] = False
    return int(np.argmax(bad)) if bad.any() else len(states)


def _matrices(columns, rows: int, width: int) -> np.ndarray:
    """Rows of column-major matrices, (n, rows * width), as an array (n, rows, width)."""
    return columns.reshape(len(columns), width, rows).transpose(0, 2, 1)


def _interpolate(time, t, X, slopes, ends):
    """Row that is before each t, and the cubic Hermite value there; straight on outside.

    Args:
        time: Stamps, shape (n,).
        t: Where to interpolate, one for each row.
        X: Values, shape (n, ...).
        slopes: Rates right after each row, shape (n, ...).
        ends: Rates right before each row but the first, shape (n - 1, ...).
    """
    n = len(time)
    at = np.clip(np.searchsorted(time, t, side='right') - 1, 0, n - 1)
    interval = np.minimum(at, n - 2)
    shape = (n, *(1,) * (X.ndim - 1))
    past = (t - time[at]).reshape(shape)
    if n == 1:
        return at, X + past * slopes
    outside = ((at == n - 1) | (t <= time[0])).reshape(shape)
    h = np.where(outside, 1.0, (time[interval + 1] - time[interval]).reshape(shape))
    s = np.where(outside, 0.0, past / h)
    r = 1 - s
    value = np.where(outside, past * slopes[at], 0.0) + (
        (1 + 2 * s) * r**2 * X[at]
        + (1 + 2 * r) * s**2 * X[interval + 1]
        + h * s * r**2 * slopes[at]
        - h * r * s**2 * ends[interval]
    )
    return at, value
