"""Growing a tree by falsification: trees.md, "Growth".

    1. Draw a state. The tree claims it if it lies in the funnel of a node, rho >= cost.
    2. A claim is simulated, from the node at which the state is least deep. If the robot comes
       home, the state is covered.
    3. If it does not, the claim was false, and so were those of all nodes that the robot came by
       in vain: their levels are cut (levels.py), and the state is looked up again.
    4. A state that nobody claims is planned for. The motion found ends anywhere on the tree, and
       its nodes join it with funnels that are infinite until they are cut.

After Reist, Preiswerk and Tedrake 2016 (simulation-based LQR-trees), with hybrid motions as in the
thesis, 4.6. New funnels are also tried with states drawn around their nodes: an infinite funnel
would draw every later sample to itself until it is cut.

States are drawn and simulated a round at a time, and a round is the same whoever computes it: a
tree depends on its seed, not on the number of workers, nor on being interrupted.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cg_control.following.nodes import Nodes, Way
from cg_control.following.tracking import TrackingSettings
from cg_control.trajectories.trajectory import Trajectory
from cg_control.trees.levels import Levels
from cg_control.trees.lookup import Lookup
from cg_control.trees.preview import AT_HOME, LANDING, Preview
from cg_control.trees.rollouts import Outcome, Rollouts, follow
from cg_control.trees.tree import Tree
from cg_dynamics.model import Model
from cg_dynamics.rollout.vector_code import WIDTH
from cg_dynamics.walking.hybrid import WalkOptions

MOST_CLAIMS = 12  # of one state, after which it counts as unclaimed
MOST_LANDINGS = 6  # of a robot whose foot lands where no impact is planned
PROBE_SHELLS = 8
VISITS = 512  # nodes that a rollout may come by


@dataclass(frozen=True)
class Region:
    """The states that are drawn: a box in the roles of the legs, one for both stance legs.

    Attributes:
        half: Half its edges: lean of the stance leg, angle of the swing leg to it, and their
            rates, in rad and rad/s, shape (4,); of another mechanism its coordinates, (nx,).
        legs: How many legs can stand.
        near: Share of the states that is drawn from a box shrunk about upright, by a factor drawn
            with each: where pushes lead is a small part of the box.
    """

    half: np.ndarray
    legs: int = 2
    near: float = 0.0

    def draw(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Stance legs (count,) and states (count, nx), in the order of the coordinates."""
        leg = rng.integers(0, self.legs, count)
        roles = rng.uniform(-1.0, 1.0, (count, len(self.half))) * self.half
        if self.near:
            shrunk = rng.random(count) < self.near
            roles[shrunk] *= rng.random((int(shrunk.sum()), 1))
        return leg, in_coordinates(leg, roles) if len(self.half) == 4 else roles

    def walking(self, count: int) -> np.ndarray:
        """Which of so many states are those of robots that walk, (count,): none here."""
        return np.zeros(count, bool)


def in_coordinates(leg: np.ndarray, roles: np.ndarray) -> np.ndarray:
    """(q_inner, q_outer) and rates (n, 4) of leans, angles to them, and rates (n, 4)."""
    lean, angle, lean_rate, rate = roles.T
    x = np.column_stack([lean, lean + angle, lean_rate, lean_rate + rate])
    return np.where((np.asarray(leg) == 1)[:, None], x[:, [1, 0, 3, 2]], x)


@dataclass(frozen=True)
class Branch:
    """A motion that ends on the tree.

    Attributes:
        trajectory: With gains, and the cost to go of the tree at its end.
        onto: Node at which it ends,
        elapsed: or so much later, s.
        funnels: Forms F of the funnels at the knots of each phase, shapes (n, nx, nx).
    """

    trajectory: Trajectory
    onto: int
    elapsed: float = 0.0
    funnels: tuple[np.ndarray, ...] | None = None


@dataclass(frozen=True)
class GivenUp:
    """In place of a branch: planning for this state hung, or ended its process."""


@dataclass(frozen=True)
class GrowthOptions:
    """How a tree is grown.

    Attributes:
        seed: Of everything that is drawn.
        round_size: States drawn at a time.
        falsifiers: So many times as many states are drawn besides, whose claims are tried too, but
            which are not planned for: a claim is tried a hundred times faster than planned.
        dense: The first so many states are planned for unless a funnel holds them, later ones
            only if no entry brings them home either: branches that begin close by bring home more.
        at_once: States planned for before the others of a round are looked up again.
        probes: States drawn around each node of a new branch.
        probe_costs: Least and largest cost at which they are drawn.
        tolerated: Share of failures that a funnel may hold (levels.py).
    """

    seed: int = 0
    round_size: int = 512
    falsifiers: int = 2
    dense: int = 8192
    at_once: int = 8
    probes: int = 16
    probe_costs: tuple[float, float] = (1e-2, 1e2)
    tolerated: float = 0.01


@dataclass
class Counts:
    """What growing came to so far. All are sums over states."""

    samples: int = 0
    covered: int = 0
    false_claims: int = 0
    unclaimed: int = 0
    previewed: int = 0
    planned: int = 0
    grown: int = 0
    rejected: int = 0
    rollouts: int = 0
    given_up: int = 0


Extend = Callable[[Nodes, np.ndarray, np.ndarray], Sequence[Branch | GivenUp | None]]


@dataclass
class Grower:
    """A tree while it grows.

    Attributes:
        model: The robot.
        tree: So far.
        region: Where states are drawn.
        extend: (nodes, legs (n,), states (n, nx)) -> for each state a branch, None if there is
            none, or that it was given up.
        options: How.
        settings: The law that follows the tree.
        simulation: Options of the rollouts.
        threads: Of the rollouts; the tree is the same with any number.
        turns: Displacements under which a state is the same, as those of `Lookup`, shape (m, nx);
            None: there are none. Previews know of none.
        counts: So far.
        rounds: Finished.
    """

    model: Model
    tree: Tree
    region: Region
    extend: Extend
    options: GrowthOptions = field(default_factory=GrowthOptions)
    settings: TrackingSettings = field(default_factory=TrackingSettings)
    simulation: WalkOptions = LANDING
    threads: int = 1
    turns: np.ndarray | None = None
    counts: Counts = field(default_factory=Counts)
    rounds: int = 0

    def __post_init__(self):
        self.levels = Levels.of(self.options.tolerated, self.tree.nodes.rho)
        self._lookup = Lookup(self.tree.nodes, self.turns)
        self._first = 0

    @property
    def nodes(self) -> Nodes:
        """Of the tree so far."""
        return self.tree.nodes

    def round(self) -> Counts:
        """Draw a round of states, and do what each calls for; returns the counts of this round."""
        before = replace(self.counts)
        rng = np.random.default_rng([self.options.seed, self.rounds])
        if not self.rounds:
            self._probe(np.flatnonzero(np.isinf(self.nodes.rho) & ~self.nodes.home), rng)
        leg, x = self.region.draw(rng, self.options.round_size)
        walking = self.region.walking(len(leg))
        still = np.flatnonzero(~walking)
        open_ = still[self.look_up(leg[still], x[still])]
        if walking.any():
            # A claim may lead upright, and who walks shall walk on: previews say where it leads.
            self._falsify(leg[walking], x[walking])
            open_ = np.union1d(open_, np.flatnonzero(walking))
        self.counts.samples += len(leg)
        self.counts.unclaimed += len(open_)
        dense = self.counts.samples <= self.options.dense
        if not dense:
            open_ = self._not_brought_home(open_, leg, x, walking)
        while len(open_):
            now, open_ = open_[: self.options.at_once], open_[self.options.at_once :]
            last = int(self.nodes.branch.max())
            grown = self._plan_for(leg[now], x[now], rng)
            if not grown or not len(open_):
                continue
            if dense:
                open_ = open_[self.look_up(leg[open_], x[open_])]
            else:
                entries = self.nodes.entries
                new = entries[self.nodes.branch[entries] > last]
                open_ = self._not_brought_home(open_, leg, x, walking, new)
        for _ in range(self.options.falsifiers):
            self._falsify(*self.region.draw(rng, self.options.round_size))
        self.rounds += 1
        return Counts(**{k: v - getattr(before, k) for k, v in vars(self.counts).items()})

    def _not_brought_home(
        self,
        rows: np.ndarray,
        leg: np.ndarray,
        x: np.ndarray,
        walking: np.ndarray,
        entries: np.ndarray | None = None,
    ) -> np.ndarray:
        """Those of the rows that a preview brings home from none of its entries, or of these.

        Home for those that walk is an orbit.
        """  # fmt: skip
        preview = Preview(
            self.tree, self.model, self.settings, self.simulation, nearest=2 * WIDTH,
            threads=self.threads,
        )  # fmt: skip
        found = preview.choose(leg[rows], x[rows], entries, walking=bool(walking.any()))
        upright = self.nodes.ways[found] == Way.UPRIGHT
        home = (found >= 0) & ~(walking[rows] & upright)
        self.counts.previewed += int(home.sum())
        return rows[~home]

    def _falsify(self, leg: np.ndarray, x: np.ndarray) -> None:
        """Try what the tree claims of states that are not planned for, or not for that."""
        covered = self.counts.covered
        self.look_up(leg, x)
        self.counts.covered = covered  # of the states that are planned for

    def look_up(self, leg: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Simulate what is claimed, cut what was claimed falsely; rows that nobody claims."""
        open_ = np.arange(len(leg))
        failed: list[list[int]] = [[] for _ in leg]
        for _ in range(MOST_CLAIMS):
            but = [failed[i] for i in open_]
            node, depth = self._lookup.best_of_many(leg[open_], x[open_], but)
            claimed = np.flatnonzero(depth <= 1.0)
            if not len(claimed):
                break
            at = self._lookup.turned(node[claimed], x[open_[claimed]])
            home = self.bring_home(node[claimed], at)
            self.counts.covered += int(home.sum())
            self.counts.false_claims += int((~home).sum())
            for k in claimed[~home]:
                failed[open_[k]].append(int(node[k]))
            open_ = np.delete(open_, claimed[home])
        return open_

    def bring_home(self, node: np.ndarray, x: np.ndarray, learn: bool = True) -> np.ndarray:
        """Let robots follow the tree: who came home, shape (B,).

        A robot whose foot lands where no impact is planned is looked up again and goes on, as the
        live controller does.

        Args:
            node: Where each begins, shape (B,).
            x: Their states, shape (B, nx).
            learn: Count at the nodes how they fared, and set the levels accordingly.
        """
        home = np.zeros(len(node), bool)
        robot, legs = np.arange(len(node)), None
        came_by: list[tuple[np.ndarray, ...]] = []
        for _ in range(MOST_LANDINGS):
            done = self.roll_out(node, x)
            assert done.visits is not None
            seen = (done.visits.node >= 0) & np.isfinite(done.visits.cost)
            rows = np.broadcast_to(robot[:, None], seen.shape)[seen]
            came_by.append((rows, done.visits.node[seen], done.visits.cost[seen]))
            home[robot] = done.outcome == Outcome.ARRIVED
            left = done.outcome == Outcome.LEFT
            robot, legs, x = robot[left], done.stance[left], done.state[left]
            if not len(robot):
                break
            node, depth = self._lookup.best_of_many(legs, x)
            held = depth <= 1.0
            robot, node, x = robot[held], node[held], x[held]
            if not len(robot):
                break
        if not learn:
            return home
        rows, nodes, costs = (np.concatenate(parts) for parts in zip(*came_by, strict=True))
        self.levels.add(nodes, costs, home[rows])
        touched = np.unique(nodes)
        # The tube of an orbit is known.
        touched = touched[~self.nodes.late[touched] & ~self.nodes.orbiting[touched]]
        self.nodes.rho[touched] = self.levels.rho(touched)
        self._lookup.refresh()
        return home

    def roll_out(self, node: np.ndarray, x: np.ndarray) -> Rollouts:
        """The exact hybrid robot under the law, each from its node."""
        self.counts.rollouts += len(node)
        return follow(
            self.nodes,
            self.model,
            node,
            x,
            self.nodes.to_go[node] + AT_HOME,
            goal=self.tree.goal,
            settings=self.settings,
            options=self.simulation,
            visits=VISITS,
            threads=self.threads,
        )

    def _plan_for(self, leg: np.ndarray, x: np.ndarray, rng: np.random.Generator) -> bool:
        """Plan for states, and take over the branches that hold what they promise."""
        self.counts.planned += len(leg)
        grown = False
        for row, branch in enumerate(self.extend(self.nodes, leg, x)):
            if isinstance(branch, GivenUp):
                self.counts.given_up += 1
            elif branch is not None and self._grow(branch, x[row]):
                self._probe(np.arange(self._first, len(self.nodes)), rng)
                self.counts.grown += 1
                grown = True
        return grown

    def _grow(self, branch: Branch, x: np.ndarray) -> bool:
        """Graft a branch, if it brings home the state that it was planned for."""
        before = self.tree, self.levels
        nodes = self.nodes.grafted(
            branch.trajectory, self.model, branch.onto, branch.elapsed, funnels=branch.funnels
        )
        self._take(nodes)
        first = np.array([nodes.first])
        if self.bring_home(first, self._lookup.turned(first, x[None]))[0]:
            return True
        self.tree, self.levels = before
        self._lookup = Lookup(self.nodes, self.turns)
        self.counts.rejected += 1
        return False

    def _take(self, nodes: Nodes) -> None:
        self._first = len(self.nodes)
        self.tree = replace(self.tree, nodes=nodes)
        self.levels = self.levels.extended(len(nodes))
        self._lookup = Lookup(nodes, self.turns)

    def _probe(self, new: np.ndarray, rng: np.random.Generator) -> None:
        """Try the funnels of nodes that nothing has cut with states drawn around them."""
        nodes, count = self.nodes, self.options.probes
        new = new[~nodes.late[new] & (nodes.span[new] > 0)]
        node = np.repeat(new, count)
        if not len(node):
            return
        low, high = np.log(self.options.probe_costs)
        direction = rng.standard_normal((len(node), nodes.x0.shape[1]))
        direction /= np.linalg.norm(direction, axis=1)[:, None]
        # x - x0 = sqrt(c) L^-T d has the cost c, with F = L L'.
        root = np.linalg.cholesky(_definite(nodes.F[node]))
        offset = np.linalg.solve(root.transpose(0, 2, 1), direction[:, :, None])[:, :, 0]
        cost = np.exp(rng.uniform(low, high, len(node)))
        x = nodes.x0[node] + np.sqrt(cost)[:, None] * offset
        order = np.argsort(cost, kind='stable')
        # From the inside out: what an inner failure has cut away need not be tried.
        for rows in np.array_split(order, PROBE_SHELLS):
            rows = rows[cost[rows] <= nodes.rho[node[rows]]]
            if len(rows):
                self.bring_home(node[rows], x[rows])


def _definite(F: np.ndarray) -> np.ndarray:
    """F, kept from being singular: along a direction that costs nothing nobody is drawn far."""
    trace = np.trace(F, axis1=1, axis2=2) / F.shape[1]
    return F + 1e-6 * trace[:, None, None] * np.eye(F.shape[1])
