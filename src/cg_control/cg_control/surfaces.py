"""Transversal surfaces along a motion: docs/theory.md, "Transverse coordinates".

Through each point x0(s) of a motion goes a plane n(s)'(x - x0(s)) = 0; the phase of a robot is
the s whose plane holds its state, whatever the clock says. Where a foot lands or has just landed
the plane is the impact surface itself, so that a robot lands exactly at the end of its phase. In
between planes turn, and where they turn they meet: at the distance

    r = n'x0' / |n_s|   in the plane, in units of the states                          (TUBE)

from the motion. The widest surfaces make the least r as large as it can be.
"""

import math
from dataclasses import dataclass, fields, replace

import casadi as ca
import numpy as np

from cg_control.trajectory import Phase, Trajectory, TrajectoryError

# Deviations that weigh alike: 0.1 rad and 0.3 rad/s, as in the planner.
UNITS = np.array([0.1, 0.1, 0.3, 0.3])
IMPACT = np.array([1.0, 1.0, 0.0, 0.0])  # gradient of the impact surface on even ground
METHODS = ('widest', 'flow')
SLOW = 1.0  # units per second, below which a motion has no direction that a plane could follow
CLOSED = 1e-3  # rad off the impact surface that a plan may leave: above what collocation errs
APART = 0.02  # rad between the legs, below which they pass each other
FLATTEST = 0.2  # least cosine between flow and normal, in units, where the plane is free
EVEN = 1e-3  # weight of the mean of squared turning beside the largest one: it makes planes unique


@dataclass(frozen=True)
class Points:
    """A motion and its surfaces at several instants.

    Attributes:
        states: x0, shape (n, nx).
        rates: dx0/ds, shape (n, nx).
        torque: u0, shape (n,), N m.
        normals: n, shape (n, nx).
        turning: dn/ds, shape (n, nx).
    """

    states: np.ndarray
    rates: np.ndarray
    torque: np.ndarray
    normals: np.ndarray
    turning: np.ndarray

    def cut(self, part: slice) -> 'Points':
        """Some of them."""
        return Points(**{f.name: getattr(self, f.name)[part] for f in fields(self)})


def between(phase: Phase, share: float) -> Points:
    """A phase at one share of every interval, 0 its beginning and 1 its end."""
    h = np.diff(phase.time)[:, None]
    s, r = share, 1 - share
    x0, x1, d0, d1 = phase.states[:-1], phase.states[1:], phase.rates[:-1], phase.rates[1:]
    n0, n1 = phase.normals[:-1], phase.normals[1:]
    return Points(
        (1 + 2 * s) * r**2 * x0 + (1 + 2 * r) * s**2 * x1 + h * s * r * (r * d0 - s * d1),
        6 * s * r / h * (x1 - x0) + r * (1 - 3 * s) * d0 + s * (1 - 3 * r) * d1,
        r * phase.torque[:-1] + s * phase.torque[1:],
        r * n0 + s * n1,
        (n1 - n0) / h,
    )


def with_surfaces(
    trajectory: Trajectory,
    method: str = 'widest',
    last: np.ndarray | None = None,
    units: np.ndarray = UNITS,
) -> Trajectory:
    """The trajectory with normals at its knots.

    Where the motion is slower than SLOW, as one that begins or ends at rest may be, it has no
    direction: normals are zero there, and the phase goes with the clock. An interval has surfaces
    if both its knots have.

    Args:
        trajectory: Any; on ground of the slope that its provenance states.
        method: 'widest': the least radius (TUBE) as large as it can be, impact surfaces at the
            ends; 'flow': normal to the motion in the metric of `units`, at the ends too.
        last: Normal at the very end, of any length, shape (4,), where the motion joins another
            one; None: the impact surface if both feet are on the ground there, else free.
        units: Deviations that weigh alike, shape (4,), rad and rad/s.

    Raises:
        TrajectoryError: if the motion does not cross a surface that is given, or no planes
            turn from one end to the other.
    """
    if method not in METHODS:
        raise ValueError(f'method is {method!r}; allowed are {", ".join(METHODS)}')
    slope = trajectory.provenance.get('slope', 0.0)
    phases = []
    for number, phase in enumerate(trajectory.phases):
        ends = [IMPACT if in_double_support(x, slope) else None for x in phase.states[[0, -1]]]
        if last is not None and number == len(trajectory.phases) - 1:
            ends[1] = np.array(last, float)
        normals = np.zeros_like(phase.states)
        for first, end in moving(phase, units):
            part = slice(first, end + 1)
            given = (
                ends[0] if first == 0 else None,
                ends[1] if end == len(phase.time) - 1 else None,
            )
            normals[part] = _normals(phase, part, method, given, units)
        phases.append(replace(phase, normals=normals))
    return trajectory.with_phases(tuple(phases), surfaces=method)


def in_double_support(x: np.ndarray, slope: float) -> bool:
    """Whether both feet are on the ground and apart: (GUARD) is zero, shape (4,)."""
    return abs(x[0] + x[1] - 2 * slope) < CLOSED and abs(x[0] - x[1]) > APART


def moving(phase: Phase, units: np.ndarray = UNITS) -> list[tuple[int, int]]:
    """First and last knot of each stretch that is fast enough to have surfaces."""
    return _runs(np.linalg.norm(phase.rates / units, axis=1) >= SLOW)


def with_planes(phase: Phase) -> list[tuple[int, int]]:
    """First and last knot of each stretch that has surfaces."""
    return _runs((phase.normals != 0).any(axis=1))


def _runs(yes: np.ndarray) -> list[tuple[int, int]]:
    """First and last index of the runs of at least two."""
    padded = np.concatenate([[False], yes, [False]])
    edges = np.flatnonzero(padded[1:] != padded[:-1])
    return [(int(a), int(b) - 1) for a, b in edges.reshape(-1, 2) if b - a >= 2]


def _normals(phase, part, method, given, units) -> np.ndarray:
    """Normals (n, 4) of one stretch, n'x0' = 1 at each knot."""
    flow = phase.rates[part] / units
    if method == 'flow':
        y = flow
    else:
        ends = [None if normal is None else normal * units for normal in given]
        for end, normal, f in zip(('begins', 'ends'), ends, flow[[0, -1]], strict=True):
            if normal is not None and not normal @ f > 0:
                raise TrajectoryError(
                    f'the {phase.stance} phase {end} on a surface that it does not cross upward: '
                    f"n'dx0/dt is {normal @ f:.3g}"
                )
        y = _widest(np.diff(phase.time[part]), flow, ends)
    normals = y / units
    return normals / (normals * phase.rates[part]).sum(axis=1, keepdims=True)


def _widest(h: np.ndarray, flow: np.ndarray, ends: list[np.ndarray | None]) -> np.ndarray:
    """Directions y (n + 1, 4) that minimise the largest |dy/ds| / y'flow, as (WIDE) says."""
    n = len(h)
    speed = np.linalg.norm(flow, axis=1).max()
    flow, h = flow / speed, h * speed  # lengths of the motion in units, for the solver's sake
    y, rho = ca.MX.sym('y', 4, n + 1), ca.MX.sym('rho')
    turning = ca.sum1((y[:, 1:] - y[:, :-1]) ** 2).T / h**2
    crossing = ca.sum1(y * flow.T).T
    rows, lower, upper = [], [], []

    def add(row, low, high):
        rows.append(row)
        lower.extend([low] * row.numel())
        upper.extend([high] * row.numel())

    add(rho**2 * crossing[:-1] ** 2 - turning, 0.0, math.inf)
    add(rho**2 * crossing[1:] ** 2 - turning, 0.0, math.inf)
    # A given end may be flatter, but must be crossed.
    along = flow / np.linalg.norm(flow, axis=1, keepdims=True)
    for k in range(0 if ends[0] is None else 1, n + 1 if ends[1] is None else n):
        add(y[:, k].T @ along[k], 0.0, math.inf)
        add((y[:, k].T @ along[k]) ** 2 - FLATTEST**2 * ca.sumsqr(y[:, k]), 0.0, math.inf)
    add(crossing[[0, n]], 0.0, math.inf)
    guess = along
    length = np.concatenate([[0.0], np.cumsum(h)]) / h.sum()
    # Along with y every multiple is a solution: the first end, or any, gets a length.
    if ends[0] is None and ends[1] is None:
        add(y[:, 0].T @ guess[0], 1.0, 1.0)
    for column, normal in ((0, ends[0]), (n, ends[1])):
        if normal is None:
            continue
        normal = normal / np.linalg.norm(normal)
        near = np.clip(1 - 4 * np.abs(length - length[column]), 0, 1)[:, None]
        guess = (1 - near) * guess + near * normal
        if column == 0 or ends[0] is None:
            add(y[:, column] - normal, 0.0, 0.0)
        else:
            # Of any length, along the normal: orthogonal to what is orthogonal to it.
            add(ca.DM(np.linalg.svd(normal[None])[2][1:]) @ y[:, column], 0.0, 0.0)
    change = np.sum(np.diff(guess, axis=0) ** 2, axis=1) / h**2
    cross = np.maximum((guess * flow).sum(axis=1), 0.1)
    start = math.sqrt((change / np.minimum(cross[1:], cross[:-1]) ** 2).max())
    solver = ca.nlpsol(
        'widest', 'ipopt',
        {'x': ca.vertcat(ca.vec(y), rho), 'g': ca.vertcat(*rows),
         'f': rho**2 + EVEN * ca.dot(turning, h) / h.sum()},
        {'print_time': False, 'ipopt': {'print_level': 0, 'sb': 'yes', 'max_iter': 300}},
    )  # fmt: skip
    found = solver(
        x0=np.append(guess.ravel(), start), lbg=lower, ubg=upper,
        lbx=[-math.inf] * guess.size + [0.0],
    )  # fmt: skip
    if not solver.stats()['success']:
        raise TrajectoryError(
            'no surfaces turn from one end of a phase to the other: '
            f'{solver.stats()["return_status"]}'
        )
    return np.asarray(found['x']).ravel()[:-1].reshape(n + 1, 4)
