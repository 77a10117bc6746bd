r"""Trajectories as nodes in flat arrays: a tree that a robot can follow from anywhere.

A node is a knot of a trajectory. From node i the reference moves to `next[i]` within `span[i]`
seconds, on the same leg; when the foot lands it jumps to `landing[i]`, which is where the next
impact ahead leads. Between two nodes the state is the cubic of trajectory.py, torque, gain and
cost to go are linear. A trajectory that ends on another one is grafted there, by a link: a node
whose span is zero. Every way ends at a home: a root, where the reference rests and the gain is
that of the balance controller, or an orbit, on which it goes round for ever. What the reference
does while an impact is late are nodes too, but no state is claimed by them.

    x0 ----> x1 ----> x2 (impact) - - > late - - > late, rests      next, on the first leg
     \________\________\___________________/
                  landing: x3 ----> x4 -link-> root, rests          on the other leg
"""

import enum
import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cg_control.trajectories.collocation import planning_model
from cg_control.trajectories.task import Stretch
from cg_control.trajectories.trajectory import Phase, Trajectory, TrajectoryError
from cg_control.trajectories.transcription import PIECES
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.compiled import compile_model

STILL = 1e-3  # at rest every point is equally close: this much of trace(F) counts against that
LATE = 0.3  # s for which the reference goes on while an impact is late
LATE_KNOT = 0.01  # s between its knots
FALLING = 1.0  # rad at which it ends
SLOWEST = 0.05  # rad/s across a surface: more slowly it says nothing about the phase


class Way(enum.IntEnum):
    """Where the plan leads from a node."""

    UPRIGHT = 0
    TO_ORBIT = 1
    ORBIT = 2  # the node is on it


@dataclass(frozen=True)
class Nodes:
    """A tree of trajectories. Growing it returns a new one in which old nodes keep their index.

    Attributes:
        stance: Leg that stands, index into STANCES, shape (n,).
        x0: Nominal states, (q_inner, q_outer) and rates, shape (n, nx).
        rates: dx0/dt, shape (n, nx).
        u0: Nominal torque in N m, shape (n,).
        K: Gains of u = u0 - K (x - x0), shape (n, nx).
        S: Cost to go of a deviation, shape (n, nx, nx).
        F: Form of the funnel, shape (n, nx, nx): S, unless another one was given. At an orbit the
            tube (x - x0)' F (x - x0) <= 1 is home.
        normal: n of the transversal surface n'(x - x0) = 0, with n'dx0/dt = 1, shape (n, nx);
            zero where none was designed: `surfaces` says what counts there.
        span: Time to `next` in s; 0 is a link, infinite is rest: shape (n,).
        next: Successor in time on the same leg, -1 at rest, shape (n,).
        landing: Where the reference goes when the foot lands, -1 where no impact is ahead: (n,).
        late: Whether the node lies beyond a late impact, shape (n,).
        time: Instant on the clock of its trajectory in s, shape (n,).
        branch: Number of the trajectory that brought it, 0 is a home, shape (n,).
        rho: Level of the funnel, x claimed by a node if (x - x0)' F (x - x0) <= rho: infinite
            until cut. 0, which claims nothing, beyond a late impact and at a planned one: there
            the foot is on the ground, and it depends on rounding whether it has landed. Shape
            (n,); the one array that may be written.
        model_hash: Of the model that all trajectories are planned for.
        compensate: The controller adds the friction that the trajectories were planned without.
    """

    stance: np.ndarray
    x0: np.ndarray
    rates: np.ndarray
    u0: np.ndarray
    K: np.ndarray
    S: np.ndarray
    F: np.ndarray
    normal: np.ndarray
    span: np.ndarray
    next: np.ndarray
    landing: np.ndarray
    late: np.ndarray
    time: np.ndarray
    branch: np.ndarray
    rho: np.ndarray
    model_hash: str
    compensate: bool = False

    @classmethod
    def root(
        cls,
        stance: str,
        gain: np.ndarray,
        cost_to_go: np.ndarray,
        model_hash: str,
        compensate: bool = False,
        rho: float = math.inf,
        funnel: np.ndarray | None = None,
    ) -> 'Nodes':
        """A tree of one node: the equilibrium at zero on one leg, held by its balance controller.

        Args:
            stance: The leg.
            gain: K of u = -K x, shape (nx,).
            cost_to_go: S there, shape (nx, nx).
            model_hash: Of the model.
            compensate: As the attribute.
            rho: Level of the funnel.
            funnel: Its form F, shape (nx, nx); None takes S.
        """
        K = np.array(gain, float).ravel()
        nx = len(K)
        S = np.array(cost_to_go, float)
        if S.shape != (nx, nx):
            raise ValueError(f'cost_to_go has shape {S.shape}, the gain has {nx} entries')
        F = S if funnel is None else np.array(funnel, float)
        if F.shape != (nx, nx):
            raise ValueError(f'funnel has shape {F.shape}, the gain has {nx} entries')
        whole, zero = np.zeros(1, np.int32), np.zeros(1)
        return cls(
            whole + STANCES.index(stance), np.zeros((1, nx)), np.zeros((1, nx)), zero, K[None],
            S[None], F[None], np.zeros((1, nx)), zero + math.inf, whole - 1, whole - 1,
            np.zeros(1, bool),
            zero.copy(), whole, zero + rho, model_hash, compensate,
        )  # fmt: skip

    @classmethod
    def of(
        cls,
        trajectory: Trajectory,
        model: Model,
        balance: np.ndarray | None = None,
        late: float = LATE,
    ) -> 'Nodes':
        """One trajectory that ends in balance; its first node is `first`.

        Args:
            trajectory: With gains.
            model: The robot that it was planned for.
            balance: Gain on the last leg after the end, shape (nx,); None takes the last gain.
            late: As in `grafted`.
        """
        last = trajectory.phases[-1]
        gain = last.gains[-1] if balance is None else balance
        compensate = trajectory.provenance.get('friction') == 'to be compensated'
        root = cls.root(last.stance, gain, last.cost_to_go[-1], trajectory.model_hash, compensate)
        return root.grafted(trajectory, model, 0, late=late)

    @classmethod
    def orbit(
        cls,
        trajectory: Trajectory,
        model: Model,
        tubes: Sequence[np.ndarray] | None = None,
        late: float = LATE,
    ) -> 'Nodes':
        """A periodic motion: when its last foot has landed, the reference goes on at its start.

        Args:
            trajectory: Periodic, with gains.
            model: The robot that it was planned for.
            tubes: Forms F of its tube at the knots of each phase, shapes (n, nx, nx); None: S.
            late: As in `grafted`.

        Raises:
            TrajectoryError: for another model, or a motion that is not periodic.
        """
        trajectory.require_model(model)
        if not trajectory.provenance.get('periodic') or len(trajectory.phases) % 2:
            raise TrajectoryError('an orbit needs a periodic motion of an even number of steps')
        first = trajectory.phases[0]
        frame = cls.root(
            first.stance, first.gains[0], first.cost_to_go[0], trajectory.model_hash,
            trajectory.provenance.get('friction') == 'to be compensated',
        )  # fmt: skip
        nodes = _concatenated(_chained(trajectory, model, frame, 0, 0, 0, tubes, late))
        if tubes is not None:
            nodes.rho[np.isinf(nodes.rho)] = 1.0
        return nodes

    def __len__(self) -> int:
        return len(self.stance)

    @property
    def first(self) -> int:
        """First node of the trajectory that was grafted last."""
        return int(np.argmax(self.branch == self.branch.max()))

    def require_consistency(self) -> None:
        """Refuse arrays that are no tree; those that `root` and `grafted` make always are one.

        Raises:
            TrajectoryError: naming the array, the node and what is allowed.
        """
        n, nx = len(self), self.x0.shape[-1]
        tails: dict[str, tuple[int, ...]] = dict.fromkeys(('x0', 'rates', 'K', 'normal'), (nx,))
        tails |= {'S': (nx, nx), 'F': (nx, nx)}
        for name in ARRAYS:
            array, shape = getattr(self, name), (n, *tails.get(name, ()))
            if np.shape(array) != shape:
                raise TrajectoryError(f'{name} has shape {np.shape(array)}, expected {shape}')
            finite = name not in ('span', 'rho')
            if np.isnan(array).any() or (finite and not np.isfinite(array).all()):
                raise TrajectoryError(f'{name} must be finite numbers')
        rests = self.next < 0
        follow, land = np.maximum(self.next, 0), np.maximum(self.landing, 0)
        rules = {
            f'stance must be 0 to {len(STANCES) - 1}':
                (self.stance < 0) | (self.stance >= len(STANCES)),
            f'next must be -1 to {n - 1}': (self.next < -1) | (self.next >= n),
            f'landing must be -1 to {n - 1}': (self.landing < -1) | (self.landing >= n),
            'span must be infinite where next is -1, finite and not negative elsewhere':
                (self.span < 0) | (np.isinf(self.span) != rests),
            'rho must not be negative': self.rho < 0,
        }  # fmt: skip
        for rule, broken in rules.items():
            if broken.any():
                raise TrajectoryError(f'node {np.argmax(broken)}: {rule}')
        rules = {
            'next must be on the same leg': ~rests & (self.stance[follow] != self.stance),
            'landing must be on the other leg':
                (self.landing >= 0) & (self.stance[land] == self.stance),
            # So that no reference runs round for ever in no time.
            'a link must lead to an older branch':
                (self.span == 0) & (self.branch[follow] >= self.branch),
        }  # fmt: skip
        for rule, broken in rules.items():
            if broken.any():
                raise TrajectoryError(f'node {np.argmax(broken)}: {rule}')

    def locate(self, s: float) -> tuple[int, float]:
        """Node and time since for an instant on the clock of the last trajectory, s."""
        mine = np.flatnonzero((self.branch == self.branch.max()) & ~self.late)
        if not self.time[mine[0]] <= s <= self.time[mine[-1]]:
            raise ValueError(
                f's is {s} s; the trajectory goes from {self.time[mine[0]]} to '
                f'{self.time[mine[-1]]} s'
            )
        node = int(mine[np.searchsorted(self.time[mine], s, side='right') - 1])
        return node, s - float(self.time[node])

    def grafted(
        self,
        trajectory: Trajectory,
        model: Model,
        onto: int,
        elapsed: float = 0.0,
        late: float = LATE,
        funnels: Sequence[np.ndarray] | None = None,
    ) -> 'Nodes':
        """This tree and a trajectory that ends on it.

        Args:
            trajectory: With gains, whose cost to go at the end is that of the tree there.
            model: The robot: the motion beyond a late impact is its own.
            onto: Node at which it ends.
            elapsed: Or so much later, at most that node's span, s: between two nodes the tree
                gets one more.
            late: How long the reference goes on while an impact is late, s.
            funnels: Forms F at the knots of each phase, shapes (n, nx, nx); None takes S.

        Raises:
            TrajectoryError: for another model, another leg or another way to treat friction.
        """
        trajectory.require_model(model)
        if trajectory.model_hash != self.model_hash:
            raise TrajectoryError('trajectory and tree were planned for different models')
        if not 0 <= onto < len(self):
            raise TrajectoryError(f'node is {onto}; the tree has nodes 0 to {len(self) - 1}')
        leg = STANCES[self.stance[onto]]
        if trajectory.modes[-1] != leg:
            raise TrajectoryError(
                f'the trajectory ends on the {trajectory.modes[-1]} leg, node {onto} stands on '
                f'the {leg} leg'
            )
        if (trajectory.provenance.get('friction') == 'to be compensated') != self.compensate:
            raise TrajectoryError(
                'friction is planned in one of trajectory and tree, and compensated in the other'
            )
        tree, place = self._opened(onto, elapsed)
        blocks = _chained(
            trajectory, model, tree, int(tree.branch.max()) + 1, len(tree),
            int(tree.landing[place]), funnels, late, place,
        )  # fmt: skip
        return _concatenated([tree, *blocks])

    def joined(self, other: 'Nodes') -> 'Nodes':
        """Both trees, the nodes of the other one behind those of this one."""
        if (self.model_hash, self.compensate) != (other.model_hash, other.compensate):
            raise TrajectoryError('trees of different models, or of different ways with friction')
        n = len(self)
        moved = replace(
            other,
            next=np.where(other.next < 0, -1, other.next + n).astype(np.int32),
            landing=np.where(other.landing < 0, -1, other.landing + n).astype(np.int32),
            branch=np.where(other.branch == 0, 0, other.branch + self.branch.max()).astype(
                np.int32
            ),
        )
        return _concatenated([self, moved])

    def pruned(self, branches: np.ndarray) -> tuple['Nodes', np.ndarray]:
        """The roots, these branches and those they end on: the tree, and where its nodes went.

        Returns:
            The smaller tree, and the new index of each node, -1 for those that are gone, (n,).
        """
        keep = np.isin(self.branch, branches) | (self.branch == 0)
        while True:
            # Where a kept node leads, by time or by landing, is kept with its whole branch.
            led = np.concatenate([self.next[keep], self.landing[keep]])
            more = keep | np.isin(self.branch, self.branch[led[led >= 0]])
            if (more == keep).all():
                break
            keep = more
        place = np.where(keep, np.cumsum(keep) - 1, -1)
        rows = self._rows(np.flatnonzero(keep))
        then, landing = (
            np.where(old < 0, -1, place[old]).astype(np.int32) for old in (rows.next, rows.landing)
        )
        return replace(rows, next=then, landing=landing), place

    @functools.cached_property
    def branches(self) -> int:
        """How many trajectories there are; pruned trees keep the numbers of those they keep."""
        return len(np.unique(self.branch[self.branch > 0]))

    @functools.cached_property
    def entries(self) -> np.ndarray:
        """The homes and the first node of every trajectory: where motions begin, shape (m,)."""
        _, first = np.unique(self.branch, return_index=True)
        return np.union1d(first, np.flatnonzero(self.home & ~self.impact))

    @property
    def impact(self) -> np.ndarray:
        """Whether an impact is planned at a node, shape (n,)."""
        ends = (self.next < 0) | self.late[self.next]
        return (self.landing >= 0) & ends & ~self.late

    @property
    def planned(self) -> np.ndarray:
        """Successor along the plan: `landing` where an impact is planned, -1 at a root: (n,)."""
        return np.where(self.impact | self.late, self.landing, self.next)

    @functools.cached_property
    def orbiting(self) -> np.ndarray:
        """Whether a node lies on an orbit, shape (n,): the plan leads from there back to it."""
        at = np.where(self.planned < 0, np.arange(len(self)), self.planned)
        # Each round looks twice as far ahead; in the end only roots and orbits are left.
        for _ in range(len(self).bit_length()):
            at = at[at]
        found = np.zeros(len(self), bool)
        found[at] = True
        return found & (self.planned >= 0)

    @property
    def home(self) -> np.ndarray:
        """Whether a node is a root or lies on an orbit, shape (n,)."""
        return (self.planned < 0) | self.orbiting

    @functools.cached_property
    def orbit_of(self) -> np.ndarray:
        """Number of the orbit that a node lies on or leads to, in the order of their first nodes.

        -1 where it leads to a root, shape (n,).
        """
        number = np.full(len(self), -1)
        count = 0
        for node in np.flatnonzero(self.orbiting):
            if number[node] >= 0:
                continue
            while number[node] < 0:
                number[node], node = count, self.planned[node]
            count += 1
        return number[self._end]

    def phase_starts(self, orbit: int) -> np.ndarray:
        """The nodes of an orbit to which impacts lead, right after them: shape (phases,)."""
        on = self.orbiting & (self.orbit_of == orbit)
        return np.unique(self.landing[on & self.impact])

    @functools.cached_property
    def root_of(self) -> np.ndarray:
        """The root of each stance leg, -1 for none, shape (2,)."""
        roots = np.flatnonzero(self.planned < 0)
        found = np.full(len(STANCES), -1)
        found[self.stance[roots]] = roots
        return found

    @functools.cached_property
    def ways(self) -> np.ndarray:
        """A `Way` of each node, shape (n,)."""
        return np.where(self.orbiting, Way.ORBIT, np.where(self.orbit_of >= 0, Way.TO_ORBIT, 0))

    @functools.cached_property
    def to_go(self) -> np.ndarray:
        """Nominal time until home in s, shape (n,)."""
        return self._along(np.where(self.impact | self.late, 0.0, self.span))

    @functools.cached_property
    def steps(self) -> np.ndarray:
        """Impacts that are planned between a node and its home, shape (n,)."""
        return self._along((self.impact | self.late).astype(float))

    def _along(self, step: np.ndarray) -> np.ndarray:
        """Sum of what each node of the plan adds, from there to its home."""
        total, at = np.where(self.home, 0.0, step), self._ahead
        for _ in range(len(self).bit_length()):
            total, at = total + total[at], at[at]
        return total

    @functools.cached_property
    def _ahead(self) -> np.ndarray:
        """`planned`, but a home stays where it is."""
        return np.where(self.home, np.arange(len(self)), self.planned)

    @functools.cached_property
    def _end(self) -> np.ndarray:
        """The first node of its home that the plan leads to, shape (n,)."""
        at = self._ahead
        for _ in range(len(self).bit_length()):
            at = at[at]
        return at

    @functools.cached_property
    def edges(self) -> np.ndarray:
        """(u0, x0, K) on the way to `next`, as powers of the time since: (n, 4, 1 + 2 nx)."""
        nx, h = self.x0.shape[1], self.span[:, None]
        moves = np.isfinite(self.span) & (self.span > 0)
        then = np.where(moves, self.next, 0)
        h = np.where(moves[:, None], h, 1.0)
        found = np.zeros((len(self), 4, 1 + 2 * nx))
        linear = np.column_stack([self.u0, self.K])
        columns = [0, *range(1 + nx, 1 + 2 * nx)]
        found[:, 0, columns] = linear
        found[:, 1, columns] = (linear[then] - linear) / h
        rise, d0, d1 = (self.x0[then] - self.x0) / h, self.rates, self.rates[then]
        states = slice(1, 1 + nx)
        found[:, 0, states] = self.x0
        found[:, 1, states] = d0
        found[:, 2, states] = (3 * rise - 2 * d0 - d1) / h
        found[:, 3, states] = (d0 + d1 - 2 * rise) / h**2
        found[~moves, 1:] = 0.0
        return found

    @functools.cached_property
    def costs(self) -> np.ndarray:
        """F on the way to `next`: its value and what it grows by in a second: (n, 2, nx, nx)."""
        moves = np.isfinite(self.span) & (self.span > 0)
        then = np.where(moves, self.next, 0)
        h = np.where(moves, self.span, 1.0)[:, None, None]
        slope = np.where(moves[:, None, None], (self.F[then] - self.F) / h, 0.0)
        return np.stack([self.F, slope], axis=1)

    @functools.cached_property
    def surfaces(self) -> np.ndarray:
        """Normals on the way to `next`: value and what they grow by in a second: (n, 2, nx).

        Where no surface was designed x0 is the point that is closest in the metric of F, and
        n = F t / (t'F t + 0.001 tr F) with t = dx0/dt: at rest every point is equally close.
        """
        along = np.einsum('nij,nj->ni', self.F, self.rates)
        trace = np.trace(self.F, axis1=1, axis2=2)
        length = np.einsum('ni,ni->n', along, self.rates) + STILL * trace
        designed = np.asarray(self.normal.any(axis=1))[:, None]
        found = np.where(designed, self.normal, along / length[:, None])
        moves = np.isfinite(self.span) & (self.span > 0)
        then = np.where(moves, self.next, 0)
        h = np.where(moves, self.span, 1.0)[:, None]
        return np.stack([found, np.where(moves[:, None], (found[then] - found) / h, 0.0)], axis=1)

    @functools.cached_property
    def forms(self) -> np.ndarray:
        """`costs` as coefficients of x_i x_j, i <= j, row by row: (n, 2, nx (nx + 1) / 2)."""
        return triangles(self.costs)

    def cost_to_go(self, node: int, elapsed: float, x: np.ndarray) -> float:
        """(x - x0)' F (x - x0) at a point of the tree, for a state (nx,)."""
        nx = self.x0.shape[1]
        reference = elapsed ** np.arange(4.0) @ self.edges[node]
        F = self.costs[node, 0] + elapsed * self.costs[node, 1]
        deviation = x - reference[1 : 1 + nx]
        return float(deviation @ F @ deviation)

    def at(self, node: int, elapsed: float) -> np.ndarray:
        """Cost to go S at a point of the tree, shape (nx, nx): linear between nodes."""
        share = elapsed / self.span[node] if 0 < self.span[node] < math.inf else 0.0
        return (1 - share) * self.S[node] + share * self.S[max(self.next[node], 0)]

    def stretch(self, first: int, pieces: int = PIECES, form: np.ndarray | None = None) -> Stretch:
        """The stretch from a node on, as far as the next impact or the root.

        Args:
            first: Node at which it begins, not beyond a late impact.
            pieces: At most so many nodes are followed, over links.
            form: As the attribute of `Stretch`.

        Raises:
            ValueError: if the reference goes nowhere from that node.
        """
        found: list[int] = []
        at = first
        while len(found) < pieces and not self.late[at] and math.isfinite(self.span[at]):
            if self.span[at] > 0:
                if self.impact[at]:
                    break
                found.append(at)
            at = int(self.next[at])
        if not found:
            raise ValueError(
                f'no stretch begins at node {first}: the robot rests there or lands, '
                'or its impact is late'
            )
        edges = self.edges[found][:, :, :5]
        return Stretch(STANCES[self.stance[first]], np.array(found), self.span[found], edges, form)

    def _opened(self, onto: int, elapsed: float) -> tuple['Nodes', int]:
        """The tree with a node at a point, and that node's index."""
        span = float(self.span[onto])
        if not 0.0 <= elapsed <= span:
            raise TrajectoryError(f'elapsed is {elapsed} s; node {onto} spans 0 to {span} s')
        if elapsed == 0.0 or math.isinf(span):
            return self, onto
        if self.late[onto] or self.impact[onto]:
            raise TrajectoryError(f'what follows node {onto} is the reference of a late impact')
        if elapsed == span:
            return self, int(self.next[onto])
        nx = self.x0.shape[1]
        powers = elapsed ** np.arange(4.0)
        slopes = np.array([0.0, 1.0, 2 * elapsed, 3 * elapsed**2])
        u0, x0, K = np.split(powers @ self.edges[onto], [1, 1 + nx])
        one = self._rows(np.array([onto]))
        point = replace(
            one, x0=x0[None], u0=u0, K=K[None],
            rates=(slopes @ self.edges[onto])[None, 1 : 1 + nx],
            S=self.at(onto, elapsed)[None],
            normal=self._normal_at(onto, elapsed)[None],
            F=(self.costs[onto, 0] + elapsed * self.costs[onto, 1])[None],
            span=one.span - elapsed, time=one.time + elapsed, rho=np.full(1, math.inf),
        )  # fmt: skip
        return _concatenated([self, point]), len(self)

    def _normal_at(self, node: int, elapsed: float) -> np.ndarray:
        """Normal of the designed surface at a point of the tree; zero where there is none."""
        if not self.normal[node].any() or not self.normal[self.next[node]].any():
            return np.zeros_like(self.normal[node])
        return self.surfaces[node, 0] + elapsed * self.surfaces[node, 1]

    def _rows(self, rows: np.ndarray) -> 'Nodes':
        return replace(self, **{name: getattr(self, name)[rows] for name in ARRAYS})


ARRAYS = (
    'stance', 'x0', 'rates', 'u0', 'K', 'S', 'F', 'normal', 'span', 'next', 'landing', 'late',
    'time', 'branch', 'rho',
)  # fmt: skip


def triangles(forms: np.ndarray) -> np.ndarray:
    """Symmetric matrices (..., n, n) as coefficients of x_i x_j, i <= j: (..., n (n + 1) / 2)."""
    i, j = np.triu_indices(forms.shape[-1])
    return np.ascontiguousarray(forms[..., i, j] * np.where(i == j, 1.0, 2.0))


def _concatenated(parts: list[Nodes]) -> Nodes:
    arrays: dict[str, Any] = {
        name: np.concatenate([getattr(part, name) for part in parts]) for name in ARRAYS
    }
    return replace(parts[0], **arrays)


def _chained(
    trajectory: Trajectory,
    model: Model,
    tree: Nodes,
    number: int,
    place: int,
    landing: int,
    forms: Sequence[np.ndarray] | None,
    late: float,
    onto: int | None = None,
) -> list[Nodes]:
    """The nodes of each phase; the first gets index `place`.

    Without a node `onto` that it ends on, the last phase ends with an impact, as the others do.
    `landing` is where an impact in the last phase leads.
    """  # fmt: skip
    last = len(trajectory.phases) - 1
    blocks = []
    for i, phase in enumerate(trajectory.phases):
        lands = i < last or onto is None
        beyond = _beyond(phase, model, tree, late if lands else 0.0)
        form = phase.cost_to_go if forms is None else forms[i]
        block = _block(phase, number, tree, form, *beyond)
        if lands:
            block.rho[len(phase.time) - 1] = 0.0
        blocks.append(block)
    starts = place + np.cumsum([0, *map(len, blocks)])
    for i, block in enumerate(blocks):
        block.next[:-1] += starts[i]
        block.landing[:] = starts[i + 1] if i < last else landing
    if onto is not None:
        blocks[last].next[-1], blocks[last].span[-1] = onto, 0.0
    return blocks


def _block(
    phase: Phase,
    number: int,
    tree: Nodes,
    funnel: np.ndarray,
    time: np.ndarray,
    states: np.ndarray,
    rates: np.ndarray,
) -> Nodes:
    """The nodes of a phase and of what follows while its impact is late; `next` is from 0 on."""
    m, n = len(phase.time), len(phase.time) + len(time)
    instants = np.concatenate([phase.time, time])
    late = np.arange(n) >= m
    held = np.minimum(np.arange(n), m - 1)
    return replace(
        tree,
        stance=np.full(n, STANCES.index(phase.stance), np.int32),
        x0=np.vstack([phase.states, states]),
        rates=np.vstack([phase.rates, rates]),
        u0=phase.torque[held],
        K=phase.gains[held],
        S=phase.cost_to_go[held],
        F=funnel[held],
        normal=np.vstack([phase.normals, _scaled(phase.normals[-1], rates)]),
        span=np.append(np.diff(instants), math.inf),
        next=np.append(np.arange(1, n), -1).astype(np.int32),
        landing=np.full(n, -1, np.int32),
        late=late,
        time=instants,
        branch=np.full(n, number, np.int32),
        rho=np.where(late, 0.0, math.inf),
    )


def _scaled(normal: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """The surface of an impact while it is late: one normal (nx,), n'dx0/dt = 1: (n, nx)."""
    speed = rates @ normal
    moves = speed > SLOWEST * np.linalg.norm(normal)
    return np.where(moves[:, None], normal / np.where(moves, speed, 1.0)[:, None], 0.0)


def _beyond(
    phase: Phase, model: Model, tree: Nodes, late: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Instants, states and rates after a phase, as the model moves on under its last torque."""
    nx = phase.states.shape[1]
    states = [np.zeros((0, nx))]
    planned, setup = planning_model(model, not tree.compensate), Setup(stance=phase.stance)
    compiled, p = compile_model(planned, setup), parameter_vector(planned, setup)
    x, u = phase.states[-1].copy(), np.array([phase.torque[-1]])
    for _ in range(math.ceil(late / LATE_KNOT)):
        compiled.advance(x, u, p, LATE_KNOT / 5, 5)
        if np.abs(x[:2]).max() > FALLING:
            break
        states.append(x.copy()[None])
    found = np.vstack(states)
    n = len(found)
    rates = np.asarray(compiled.f(found.T, u, p)).T if n else found
    return phase.end + LATE_KNOT * np.arange(1, n + 1), found, rates
