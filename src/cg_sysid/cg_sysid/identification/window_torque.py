"""What the joints do in the mean of a window of a measured motion, beside that at its mean motion.

    <tau(x(t), u(t), p)> - tau(<x>, <u>, p)                                             (WINDOW)

Friction turns where a joint does, and a motor clips where its torque is large: of a window in
which that happens, the mean rate and the mean torque tell neither. Each torque is averaged with
the weights with which the window averages the acceleration (measured_motion.py), so that both
sides of (TE) have seen the same.
"""

from collections.abc import Sequence

import casadi as ca
import numpy as np

from cg_dynamics.assemble import Equations
from cg_sysid.identification.along_motion import Samples
from cg_sysid.identification.along_rows import AlongRows
from cg_sysid.identification.measured_motion import Motion

SPACING_S = 0.008  # between the points of a window at which torques are worked out


class WindowTorque:
    """(WINDOW) of all windows of a motion, for ever other p.

    Args:
        e: Equations without states.
        torques: What is averaged, an expression of their x, u and p, (m, 1).
        motion: What was measured.
        moved: Places of the parameters by which it is differentiated.
    """

    def __init__(self, e: Equations, torques: ca.SX, motion: Motion, moved: Sequence[int]):
        by = ca.jacobian(torques, ca.vertcat(ca.SX(0, 1), *(e.p[k] for k in moved)))
        self._row, self._column = (np.array(i, int) for i in by.sparsity().get_triplet())
        self._shape = by.shape
        self._told = np.array(ca.which_depends(torques, e.p, 1, False), bool)
        points = [points_of(samples) for samples in motion.records]
        self._edges = np.cumsum([len(x) for x, _ in points])[:-1]
        begins = np.flatnonzero(motion.first)
        counts = np.diff([*begins, len(motion.first)])
        self._windows = [
            (*weights_of(samples), count)
            for samples, count in zip(motion.records, counts, strict=True)
        ]
        x, u = (np.vstack(arrays) for arrays in zip(*points, strict=True))
        # What a controller chatters is averaged as here, so that what is linear in it is nothing.
        mean = np.hstack([motion.position, motion.rate]), self._averages(u)
        self._torques, self._slope = (
            _Twice(e, values, (x, u), mean) for values in (ca.densify(torques), _nonzeros(by))
        )

    def __call__(self, p: np.ndarray) -> np.ndarray:
        """Of each window, shape (k, m)."""
        return self._beside_mean(self._torques, p)

    def slope(self, p: np.ndarray) -> np.ndarray:
        """Its derivative by the parameters, shape (k, m, moved)."""
        found = self._beside_mean(self._slope, p)
        slope = np.zeros((len(found), *self._shape))
        slope[:, self._row, self._column] = found
        return slope

    def _beside_mean(self, values: '_Twice', p: np.ndarray) -> np.ndarray:
        asked = p[self._told].tobytes()
        if values.known is None or asked != values.known[0]:  # else others moved, of the bodies
            at_points, at_mean = values(p)
            values.known = asked, self._averages(at_points) - at_mean
        return values.known[1]

    def _averages(self, values: np.ndarray) -> np.ndarray:
        """Of values at the points, those of the windows of all records."""
        records = np.split(values, self._edges)
        return np.vstack([
            averaged(own, *windows) for own, windows in zip(records, self._windows, strict=True)
        ])  # fmt: skip


def _nonzeros(matrix: ca.SX) -> ca.SX:
    """In one column, in the order of its sparsity."""
    return ca.SX(ca.Sparsity.dense(matrix.nnz(), 1), matrix.nz[:])


class _Twice:
    """An expression of x, u and p, (c, 1), at the points and at the mean motion of the windows.

    Attributes:
        known: Parameters that were asked for last, and what came of them.

    Args:
        e: The equations.
        values: The expression.
        at: x and u of the points, and of the windows.
    """

    def __init__(self, e: Equations, values: ca.SX, *at: tuple[np.ndarray, np.ndarray]):
        self._made: list[AlongRows] | None = None
        self._given = e, values, at
        self.known: tuple[bytes, np.ndarray] | None = None

    def __call__(self, p: np.ndarray) -> list[np.ndarray]:
        """Shapes (points, c) and (windows, c)."""
        e, values, at = self._given
        if self._made is None:  # many are asked for one of torques and slopes only
            self._made = [AlongRows(e, values, x, u, np.zeros((len(x), e.coordinates)))
                          for x, u in at]  # fmt: skip
        return [function(p)[:, :, 0] for function in self._made]


def points_of(samples: Samples) -> tuple[np.ndarray, np.ndarray]:
    """Motion and inputs at the points of a record, shapes (points, 2 m) and (points, nu).

    A point is the mean of the intervals that a few samples begin. The last window may end beyond
    the record: what follows is as its end.
    """
    together = _together(samples)
    x = np.hstack([samples.position, samples.rate])
    middle = (x + np.vstack([x[1:], x[-1:]])) / 2
    points = -(-(len(x) + len(samples.weights)) // together)
    x, u = (
        np.pad(values, ((0, points * together - len(values)), (0, 0)), 'edge')
        .reshape(points, together, -1).mean(axis=1)
        for values in (middle, samples.inputs)
    )  # fmt: skip
    return x, u


def weights_of(samples: Samples) -> tuple[np.ndarray, int]:
    """Weights of the points of a window, and points from one window to the next."""
    together = _together(samples)
    weights = np.pad(samples.weights, (0, -len(samples.weights) % together))
    return weights.reshape(-1, together).sum(axis=1), samples.stride // together


def averaged(values: np.ndarray, weights: np.ndarray, stride: int, count: int) -> np.ndarray:
    """Averages of so many windows of the columns of one record, shape (count, columns)."""
    found = [np.correlate(column, weights, 'valid')[::stride][:count] for column in values.T]
    return np.column_stack(found) if found else np.empty((count, 0))


def _together(samples: Samples) -> int:
    """Samples that make one point: each window begins with one."""
    most = max(1, round(SPACING_S / samples.spacing))
    return max(n for n in range(1, most + 1) if samples.stride % n == 0)
