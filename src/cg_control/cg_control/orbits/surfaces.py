"""Transversal surfaces along a motion: theory.md, "Transverse coordinates".

Through each point x0(s) of a motion goes a plane n(s)'(x - x0(s)) = 0; the phase of a robot is
the s whose plane holds its state, whatever the clock says. Where a foot lands or has just landed
the plane is the impact surface itself, so that a robot lands exactly at the end of its phase. In
between planes turn, and where they turn they meet: at the distance

    r = n'x0' / |n_s|   in the plane, in units of the states                          (TUBE)

from the motion. Nor does the phase of a robot advance anywhere: up to r = n'x0' / |A'n| it does,
to first order. The widest surfaces make the least of both radii large, (WIDE).
"""

import math
from dataclasses import dataclass, fields, replace

import casadi as ca
import numpy as np

from cg_control.trajectories.collocation import planning_model
from cg_control.trajectories.trajectory import Phase, Trajectory, TrajectoryError
from cg_control.trajectories.tvlqr import linearised
from cg_dynamics.linearise import without_dry_friction
from cg_dynamics.model import Model

# Deviations that weigh alike: 0.1 rad and 0.3 rad/s, as in the planner.
UNITS = np.array([0.1, 0.1, 0.3, 0.3])
TORQUE = 40.0  # N m that weigh as much: what the motor gives
IMPACT = np.array([1.0, 1.0, 0.0, 0.0])  # gradient of the impact surface on even ground
METHODS = ('widest', 'flow')
SLOW = 1.0  # units per second, below which a motion has no direction that a plane could follow
CLOSED = 1e-3  # rad off the impact surface that a plan may leave: above what collocation errs
APART = 0.02  # rad between the legs, below which they pass each other
NODES = 25  # at which planes may begin to turn otherwise
NEWTON, INSTANT = 20, 1e-12  # steps of Newton's method, and what they settle to, s
ROUNDS, SETTLED = 20, 2e-3  # of the search for the widest surfaces; share of the radius


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
    model: Model,
    method: str = 'widest',
    last: np.ndarray | None = None,
    units: np.ndarray = UNITS,
    torque: float = TORQUE,
) -> Trajectory:
    """The trajectory with normals at its knots.

    Where the motion is slower than SLOW, as one that begins or ends at rest may be, it has no
    direction: normals are zero there, and the phase goes with the clock. An interval has surfaces
    if both its knots have.

    Args:
        trajectory: Any; on ground of the slope that its provenance states.
        model: The one it was planned for.
        method: 'widest': the radii (TUBE) as large as they can be, impact surfaces at the
            ends; 'flow': normal to the motion in the metric of `units`, at the ends too.
        last: Normal at the very end, of any length, shape (4,), where the motion joins another
            one; None: the impact surface if both feet are on the ground there, else free.
        units: Deviations that weigh alike, shape (4,), rad and rad/s.
        torque: Off the nominal one that weighs as much, N m; less of it for a motion that begins
            at rest, where torque is what moves the robot.

    Raises:
        TrajectoryError: if the motion does not cross a surface that is given, or no planes
            turn from one end to the other.
    """
    if method not in METHODS:
        raise ValueError(f'method is {method!r}; allowed are {", ".join(METHODS)}')
    trajectory.require_model(model)
    design = design_of(trajectory, model)
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
            normals[part] = _normals(design, phase, part, method, given, units, torque)
        phases.append(replace(phase, normals=normals))
    return trajectory.with_phases(tuple(phases), surfaces=method)


@dataclass(frozen=True)
class Tube:
    """(TUBE) at the knots of a phase, in units; infinite where there are no surfaces.

    Attributes:
        well_posed: Up to here every state of the surface lies on no other one near it, shape (n,).
        advancing: Up to here its phase advances under the nominal torque, n'f > 0, to first
            order, shape (n,).
        torque: Up to so much off the nominal one it advances on the motion itself, N m, (n,).
    """

    well_posed: np.ndarray
    advancing: np.ndarray
    torque: np.ndarray


def tube(trajectory: Trajectory, model: Model, units: np.ndarray = UNITS) -> tuple[Tube, ...]:
    """The tube of each phase.

    Args:
        trajectory: With surfaces.
        model: The one it was planned for.
        units: As in `with_surfaces`.
    """
    design = design_of(trajectory, model)
    tubes = []
    for phase in trajectory.phases:
        well_posed, advancing, torque = np.full((3, len(phase.time)), math.inf)
        for first, last in with_planes(phase):
            for share, shift in ((0.0, 0), (0.5, 0), (0.5, 1), (1.0, 1)):
                points = between(phase, share).cut(slice(first, last))
                at = slice(first + shift, last + shift)
                radii = _radius(points.normals, points.rates, points.turning, units)
                well_posed[at] = np.minimum(well_posed[at], radii)
            part = slice(first, last + 1)
            A, B = linearised(design, phase.stance, phase.states[part], phase.torque[part])
            normals = phase.normals[part]
            pulled = np.einsum('kji,kj->ki', A, normals)
            advancing[part] = _radius(normals, phase.rates[part], pulled, units)
            with np.errstate(divide='ignore'):
                torque[part] = 1 / np.abs((normals * B[:, :, 0]).sum(axis=1))
        tubes.append(Tube(well_posed, advancing, torque))
    return tuple(tubes)


def _radius(normals, rates, gradient, units) -> np.ndarray:
    """Distance in the surface, in units, at which gradient'd takes n'x0' away, shape (n,)."""
    n, g = normals * units, gradient * units
    g = g - (g * n).sum(axis=1, keepdims=True) / (n**2).sum(axis=1, keepdims=True) * n
    with np.errstate(divide='ignore'):
        return (normals * rates).sum(axis=1) / np.linalg.norm(g, axis=1)


def phase_of(phase: Phase, x: np.ndarray, near: float) -> float:
    """The instant s whose surface holds a state: n(s)'(x - x0(s)) = 0, by Newton's method.

    Args:
        phase: With surfaces.
        x: Shape (4,).
        near: Instant from which to search, s; a state may lie on more than one surface.

    Returns:
        The instant, within the phase: a state beyond the last surface is on the last one. Where
        there are no surfaces, or they meet before x, `near` itself.
    """
    time, states, rates, normals = phase.time, phase.states, phase.rates, phase.normals
    s = min(max(near, phase.start), phase.end)
    for _ in range(NEWTON):
        k = min(int(np.searchsorted(time, s, side='right')), len(time) - 1) - 1
        h = time[k + 1] - time[k]
        late = (s - time[k]) / h
        early = 1 - late
        change = states[k + 1] - states[k]
        # As `between` has it, written so that x0(s) costs little.
        state = states[k] + late * (
            late * (1 + 2 * early) * change + h * early * (early * rates[k] - late * rates[k + 1])
        )
        rate = (
            6 * late * early / h * change
            + early * (1 - 3 * late) * rates[k]
            + late * (1 - 3 * early) * rates[k + 1]
        )
        normal, turning = normals[k], (normals[k + 1] - normals[k]) / h
        if not (normals[k].any() and normals[k + 1].any()):
            return near
        normal = normal + late * h * turning
        deviation = x - state
        fall = normal.dot(rate) - turning.dot(deviation)
        if not fall > 0:
            return near
        before = s
        s = min(max(s + float(normal.dot(deviation) / fall), phase.start), phase.end)
        if abs(s - before) < INSTANT:
            break
    return s


def design_of(trajectory: Trajectory, model: Model) -> Model:
    """What feedback is designed on: the model as it is planned on, less dry friction."""
    friction = trajectory.provenance.get('friction') == 'planned'
    return without_dry_friction(planning_model(model, friction))


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


def _normals(design, phase, part, method, given, units, torque) -> np.ndarray:
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
        A, B = linearised(design, phase.stance, phase.states[part], phase.torque[part])
        y = Widest(
            phase.time[part], flow, A * units / units[:, None], B[:, :, 0] * torque / units, ends
        ).solve()
    normals = y / units
    return normals / (normals * phase.rates[part]).sum(axis=1, keepdims=True)


class Widest:
    """(WIDE): directions y at the knots, linear in between at most NODES of them.

    With the ratio of each knot,

        g = max(|dy/ds|, |(A'y - mu y, b'y)|) / y'flow,   the inverse of its least radius (TUBE),

    the sum of the largest and the mean g is made small, by convex programs in y, a and t

        min t + mean t_k   subject to   g y'flow <= a,  t_k <= t,   a = rho y'flow + t_k w

    in which w is the crossing y'flow of the last round, and mu makes A'y - mu y orthogonal to the
    y of the last round (after Dinkelbach 1967). The best y is kept, so that there are surfaces
    even where the solver gives up.

    Args:
        time: Knots, shape (n,), s.
        flow: dx0/dt in units, shape (n, 4), 1/s.
        A: df/dx in units, shape (n, 4, 4), 1/s.
        b: df/du in units, shape (n, 4), 1/s.
        ends: Given normals in units at the first and last knot, or None.
    """

    def __init__(
        self,
        time: np.ndarray,
        flow: np.ndarray,
        A: np.ndarray,
        b: np.ndarray,
        ends: list[np.ndarray | None],
    ):
        speed = np.linalg.norm(flow, axis=1).max()
        # One unit of time moves by at most one unit of the state.
        self.flow, self.A, self.b, time = flow / speed, A / speed, b / speed, time * speed
        nodes = np.unique(np.linspace(0, len(time) - 1, NODES).round().astype(int))
        self.weights = np.array([np.interp(time, time[nodes], row) for row in np.eye(len(nodes))])
        self.h = np.diff(time[nodes])
        # Interval and knot of each row: a knot at a node belongs to two intervals.
        self.rows = np.array([
            (j, k) for j in range(len(self.h)) for k in range(nodes[j], nodes[j + 1] + 1)
        ])  # fmt: skip
        self.guess = flow[nodes] / np.linalg.norm(flow[nodes], axis=1, keepdims=True)
        at = (time[nodes] - time[0]) / (time[-1] - time[0])
        for node, normal in zip((0, -1), ends, strict=True):
            if normal is not None:
                near = np.clip(1 - 4 * np.abs(at - at[node]), 0, 1)[:, None]
                self.guess = (1 - near) * self.guess + near * normal / np.linalg.norm(normal)
        self._build(ends)

    def _build(self, ends: list[np.ndarray | None]) -> None:
        m, n = len(self.guess), len(self.flow)
        y, a, t = ca.SX.sym('y', 4, m), ca.SX.sym('a', n), ca.SX.sym('t')
        rho, w, mu = ca.SX.sym('rho'), ca.SX.sym('w', n), ca.SX.sym('mu', n)
        turning = ca.sum1((y[:, 1:] - y[:, :-1]) ** 2).T / self.h**2
        knots = ca.mtimes(y, ca.sparsify(ca.DM(self.weights)))
        pulled = ca.horzcat(*(ca.DM(self.A[k].T) @ knots[:, k] for k in range(n)))
        pulled -= knots * ca.repmat(mu.T, 4)
        push = ca.sum1(knots * self.b.T).T
        crossing = ca.sum1(knots * self.flow.T).T
        slack = (a - rho * crossing) / w
        interval, knot = self.rows.T.tolist()
        above = [
            a[knot] - turning[interval] / a[knot],
            a - (ca.sum1(pulled**2).T + push**2) / a,
            t - slack,
            1.5 * w - crossing,  # or else y would grow for the sake of the mean
        ]
        zero = []
        # With y every multiple of it is a solution: the first end that is given sets the length.
        given = [node for node, normal in zip((0, m - 1), ends, strict=True) if normal is not None]
        for node in given:
            direction = self.guess[node]
            if node == given[0]:
                zero.append(y[:, node] - direction)
            else:
                zero.append(ca.DM(np.linalg.svd(direction[None])[2][1:]) @ y[:, node])
                above.append(ca.dot(direction, y[:, node]))
        if not given:
            zero.append(ca.dot(self.guess[0], y[:, 0]) - 1)
        rows, equal = ca.vertcat(*above), ca.vertcat(*zero)
        self.lower = np.zeros(rows.numel() + equal.numel())
        self.upper = np.append(np.full(rows.numel(), math.inf), np.zeros(equal.numel()))
        self.least = np.concatenate([np.full(4 * m, -math.inf), np.full(n, 1e-6), [-math.inf]])
        self.solver = ca.nlpsol(
            'widest', 'ipopt',
            {'x': ca.vertcat(ca.vec(y), a, t), 'p': ca.vertcat(rho, w, mu),
             'g': ca.vertcat(rows, equal), 'f': t + ca.sum1(slack) / n},
            {'print_time': False,
             'ipopt': {'print_level': 0, 'sb': 'yes', 'max_iter': 100, 'tol': 1e-5}},
        )  # fmt: skip

    def ratios(self, y: np.ndarray) -> np.ndarray:
        """Ratios g at the knots, shape (n,); infinite where the motion is not crossed."""
        knots = self.weights.T @ y
        crossing = (knots * self.flow).sum(axis=1)
        turning = np.linalg.norm(np.diff(y, axis=0), axis=1) / self.h
        size = np.linalg.norm(np.column_stack([
            self._pulled(knots, self._along(knots)), (knots * self.b).sum(axis=1)
        ]), axis=1)  # fmt: skip
        interval, knot = self.rows.T
        np.maximum.at(size, knot, turning[interval])
        with np.errstate(divide='ignore'):
            return np.where(crossing > 0, size / crossing, math.inf)

    def _pulled(self, knots: np.ndarray, mu: np.ndarray) -> np.ndarray:
        return np.einsum('kji,kj->ki', self.A, knots) - mu[:, None] * knots

    def _along(self, knots: np.ndarray) -> np.ndarray:
        """The mu at which A'y - mu y is orthogonal to y."""
        return (self._pulled(knots, np.zeros(len(knots))) * knots).sum(axis=1) / (
            (knots**2).sum(axis=1)
        )

    def solve(self) -> np.ndarray:
        """Directions at the knots, shape (n, 4)."""
        y = best = self.guess
        ratios = self.ratios(y)
        least = ratios.max() + ratios.mean()
        for _ in range(ROUNDS):
            knots = self.weights.T @ y
            crossing = np.maximum((knots * self.flow).sum(axis=1), 0.01)
            rho = min(ratios.max(), 100.0)
            found = self.solver(
                x0=np.concatenate([y.ravel(), rho * crossing + 0.01, [0.1]]),
                p=np.concatenate([[rho], crossing, self._along(knots)]),
                lbg=self.lower, ubg=self.upper, lbx=self.least,
            )  # fmt: skip
            y = np.asarray(found['x']).ravel()[: y.size].reshape(y.shape)
            ratios = self.ratios(y)
            before, sum_of_both = least, ratios.max() + ratios.mean()
            if sum_of_both < least:
                best, least = y, sum_of_both
            if not sum_of_both < before * (1 - SETTLED):
                break
        if math.isinf(least):
            raise TrajectoryError('no surfaces turn from one end of a phase to the other')
        return self.weights.T @ best
