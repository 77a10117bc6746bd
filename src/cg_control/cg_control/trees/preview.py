"""Look before following: the motions of a tree that bring a robot home, found by simulating them.

A funnel is a small ellipsoid inside a large and crooked region. A node brings home far more states
than its funnel holds, and one of a dozen entries brings home nearly every state that any node
does. A rollout of two seconds takes less than a tenth of a millisecond. So a state that no funnel
holds is *previewed*: the robot is simulated, on the model as it is known, from a few entries of
the tree, and follows the first of them that brings it home. They are those at which the state is
least deep, and the *champions* of the leg that stands: chosen one after the other, each brings
home most of the states of a sample that those before it do not. Eight are simulated at a time, and
who falls falls soon: a state that nothing brings home takes some two milliseconds.

What is previewed is as true as the model. With another model, of a payload say, the same tree
promises other things without being grown again.
"""

from dataclasses import dataclass, field, replace

import numpy as np

from cg_control.following.nodes import Way
from cg_control.following.tracking import TrackingSettings
from cg_control.trees.levels import FINEST
from cg_control.trees.lookup import UNCUT, lifted, monomials
from cg_control.trees.rollouts import Outcome, follow
from cg_control.trees.routes import Routes
from cg_control.trees.tree import Tree
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_dynamics.rollout.vector_code import WIDTH
from cg_dynamics.walking.hybrid import WalkOptions

NEAREST = 4
CHAMPIONS = 60  # of each leg
WALKERS = 40  # of each leg, that lead to an orbit
# A robot that leans or swings its leg further counts as lost; plans swing it to 1.5 rad.
LANDING = WalkOptions(
    sample_time=0.002, step=0.002, minimum_step=0.1, fall_angle=0.6, swing_angle=2.0
)
AT_HOME = 3.0  # s that the balance controller may take beyond the end of a motion


@dataclass
class Preview:
    """Simulates where a tree would lead.

    Attributes:
        tree: The motions, and the levels of their funnels as they are now.
        known: The robot as it is known.
        settings: The law that follows the tree.
        simulation: Options of the rollouts.
        nearest: How many of the entries at which a state is least deep are tried.
        threads: Of the rollouts; results are the same with any number.
    """

    tree: Tree
    known: Model
    settings: TrackingSettings | None = None
    simulation: WalkOptions = LANDING
    nearest: int = NEAREST
    threads: int = 1
    _entries: np.ndarray = field(init=False, repr=False)
    _depths: np.ndarray = field(init=False, repr=False)

    def __post_init__(self):
        nodes = self.tree.nodes
        entries = nodes.entries
        level = np.clip(nodes.rho[entries], FINEST, UNCUT)
        costs = lifted(nodes.x0[entries], nodes.F[entries])
        self._entries = entries
        self._depths = costs / level[:, None]

    def choose(
        self,
        leg: np.ndarray,
        x: np.ndarray,
        entries: np.ndarray | None = None,
        walking: bool = False,
    ) -> np.ndarray:
        """An entry that brings each state home, the first that does; -1 for none: shape (B,).

        Args:
            leg: Leg that stands, index into STANCES, shape (B,).
            x: States, shape (B, nx).
            entries: These in place of the `candidates`, shape (m,).
            walking: An orbit is wanted, and upright is second best.
        """
        if entries is None:
            tried = self.candidates(leg, x, walking)
        else:
            fits = self.tree.nodes.stance[entries] == np.asarray(leg)[:, None]
            tried = np.where(fits, entries, -1)
        found = np.full(len(x), -1)
        # A register full at a time: who is home needs no more of them.
        for first in range(0, tried.shape[1], WIDTH):
            some = tried[:, first : first + WIDTH]
            row, column = np.nonzero((found < 0)[:, None] & (some >= 0))
            home = np.zeros(some.shape, bool)
            home[row, column] = self.brings_home(some[row, column], x[row])
            rows = np.flatnonzero(home.any(axis=1))
            found[rows] = some[rows, home[rows].argmax(axis=1)]
        return found

    def candidates(self, leg: np.ndarray, x: np.ndarray, walking: bool = False) -> np.ndarray:
        """Entries to try, in order: the least deep ones, the champions.

        Where the robot is to walk the least deep nodes of orbits come first, then what else leads
        to an orbit. Arguments as `choose`. Shape (B, m), -1 where there are no more.
        """
        nodes, leg = self.tree.nodes, np.asarray(leg)
        depth = monomials(x[:, : nodes.x0.shape[1]]) @ self._depths.T
        depth[nodes.stance[self._entries] != leg[:, None]] = np.inf
        tried = np.hstack([self._least_deep(depth), self.tree.champions[leg]])
        if not walking:
            return tried
        # A branch that nothing has cut seems less deep than any tube: orbits for themselves.
        depth[:, ~nodes.orbiting[self._entries]] = np.inf
        tried = np.hstack([self._least_deep(depth), tried])
        last = (tried < 0) | (nodes.ways[tried] == Way.UPRIGHT)
        return np.take_along_axis(tried, np.argsort(last, axis=1, kind='stable'), axis=1)

    def _least_deep(self, depth: np.ndarray) -> np.ndarray:
        """The entries of least depth: (B, nearest), -1 where it is infinite."""
        order = np.argsort(depth, axis=1, kind='stable')[:, : self.nearest]
        away = np.isinf(np.take_along_axis(depth, order, axis=1))
        return np.where(away, -1, self._entries[order])

    def brings_home(
        self, node: np.ndarray, x: np.ndarray, elapsed: np.ndarray | None = None
    ) -> np.ndarray:
        """Whether robots that follow the tree from these nodes come home, shape (B,).

        Args:
            node: Shape (B,).
            x: States, shape (B, nx).
            elapsed: Time since the nodes in s, shape (B,); None: none.
        """
        nodes = self.tree.nodes
        x = x[:, : nodes.x0.shape[1]]  # effects with states begin at rest
        done = follow(
            nodes, self.known, node, x, nodes.to_go[node] + AT_HOME, elapsed=elapsed,
            goal=self.tree.goal, settings=self.settings, options=self.simulation,
            threads=self.threads,
        )  # fmt: skip
        return done.outcome == Outcome.ARRIVED


def pruned(tree: Tree, most: int | None = None) -> Tree:
    """A tree without the branches that begin at no champion and lead to no other home.

    Args:
        tree: With champions.
        most: So many of the champions of each leg stay, the first ones; None: all.
    """
    named, leave = tree.champions[:, :most], Routes.of(tree.nodes, tree.speeds.tolist()).departures
    kept = np.append(named[named >= 0], [d.entry for d in leave]).astype(int)
    nodes, place = tree.nodes.pruned(np.unique(tree.nodes.branch[kept]))
    moved = np.where(named < 0, -1, place[named]).astype(np.int32)
    return replace(tree, nodes=nodes, champions=moved)


def champions(
    preview: Preview,
    leg: np.ndarray,
    x: np.ndarray,
    count: int = CHAMPIONS,
    entries: np.ndarray | None = None,
) -> np.ndarray:
    """The entries that together bring most states home: shape (2, count), -1 for no more.

    Args:
        preview: Of a tree.
        leg: Legs that stand, of a sample of states, shape (B,).
        x: The sample, shape (B, nx).
        count: How many of each leg.
        entries: Of these, shape (m,); None: of all.
    """
    nodes = preview.tree.nodes
    entries = nodes.entries if entries is None else entries
    chosen = np.full((len(STANCES), count), -1)
    for number in range(len(STANCES)):
        own, mine = entries[nodes.stance[entries] == number], x[leg == number]
        home = np.zeros((len(mine), len(own)), bool)
        for column, entry in enumerate(own):
            home[:, column] = preview.brings_home(np.full(len(mine), entry), mine)
        open_ = home.any(axis=1)
        for k in range(min(count, len(own))):
            # What brings more states home at all decides between equals.
            gain = home[open_].sum(axis=0) + home.mean(axis=0)
            best = int(gain.argmax())
            if gain[best] == 0.0:
                break
            chosen[number, k] = own[best]
            open_ &= ~home[:, best]
            home[:, best] = False
    return chosen
