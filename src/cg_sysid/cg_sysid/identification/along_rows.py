"""Functions of a model's equations, worked out for all rows of a measured motion at once."""

import casadi as ca
import numpy as np

from cg_dynamics.assemble import Equations


class AlongRows:
    """A function of (x, u, a, p) along given rows, for ever other p.

    It reads and writes these arrays in place: to hand matrices over would take longer than to
    work them out.

    Args:
        e: Equations without states.
        result: Expression of their symbols, dense, (r, c).
        x: Coordinates and rates, shape (k, 2 m).
        u: Inputs, shape (k, nu); columns beyond those of the equations are left out.
        a: Accelerations, shape (k, m).
    """

    def __init__(self, e: Equations, result: ca.SX, x: np.ndarray, u: np.ndarray, a: np.ndarray):
        k = len(x)
        every = ca.Function('along_rows', [e.x, e.u, e.acceleration, e.p], [ca.cse(result)]).map(k)
        self._p = np.empty((k, e.p.shape[0]))
        self._result = np.empty((k, result.shape[1], result.shape[0]))
        # casadi counts by columns, so that each row here is one of its columns.
        self._given = [
            np.ascontiguousarray(values) for values in (x, u[:, : e.u.shape[0]], a, self._p)
        ]
        self._buffer, self._run = every.buffer()
        for i, array in enumerate(self._given):
            self._buffer.set_arg(i, array.data)  # type: ignore[call-arg]
        if self._result.size:
            self._buffer.set_res(0, self._result.data)  # type: ignore[call-arg]

    def __call__(self, p: np.ndarray) -> np.ndarray:
        """Of each row, shape (k, r, c); it holds until the next call."""
        self._p[:] = p
        self._run()
        return self._result.transpose(0, 2, 1)
