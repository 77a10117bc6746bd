"""Which nodes of a tree claim a state, and which claims it best: one product of a matrix.

The cost of a deviation in a funnel is a quadratic form, linear in the monomials of the state,

    (x - x0)' F (x - x0) = c . m(x),   m(x) = (x_i x_j for i <= j, x_i, 1)             (LIFT)

so that the costs of all nodes on a leg are one matrix times m(x): 15 numbers a node. The *depth*
of a state at a node is its cost over the level of the funnel, cost / rho: inside if 1 or less. The
best node is the one at which the state is least deep.

Nodes from which nothing is claimed (rho is zero: late references, funnels cut to nothing) take no
part.

A joint without stops is the same after a whole turn, and the tree is one in its unrolled angle: a
state is then looked up at every *turn*, and claimed at the one at which it is least deep.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cg_control.following.nodes import Nodes, triangles
from cg_dynamics.rig import STANCES

UNCUT = 1e6  # level that stands for an infinite one: 100 times the cost at which robots fall


@dataclass(frozen=True)
class Claim:
    """Where a state is held.

    Attributes:
        node: Best node, -1 where no node stands on that leg.
        depth: Cost over rho there; inside the funnel if 1 or less.
    """

    node: int
    depth: float


def monomials(x: np.ndarray) -> np.ndarray:
    """m(x) of (LIFT) for states (..., nx): shape (..., (nx + 1) (nx + 2) / 2)."""
    x = np.asarray(x, float)
    i, j = np.triu_indices(x.shape[-1])
    return np.concatenate([x[..., i] * x[..., j], x, np.ones((*x.shape[:-1], 1))], axis=-1)


def lifted(x0: np.ndarray, F: np.ndarray) -> np.ndarray:
    """Coefficients c of (LIFT) for nodes x0 (n, nx) and F (n, nx, nx): shape (n, features)."""
    Fx = np.einsum('nij,nj->ni', F, x0)
    return np.column_stack([triangles(F), -2.0 * Fx, np.einsum('ni,ni->n', x0, Fx)])


class Lookup:
    """The funnels of a tree, leg by leg.

    Args:
        nodes: The tree. Its rho may be written afterwards; `refresh` takes it over.
        turns: Displacements under which a state is the same, zero left out, shape (m, nx); None:
            there are none. `best` looks at a state where it is.
    """

    def __init__(self, nodes: Nodes, turns: np.ndarray | None = None):
        self.nodes = nodes
        nx = nodes.x0.shape[1]
        self.turns = np.zeros((0, nx)) if turns is None else turns
        self._i, self._j = np.triu_indices(nx)
        self._features = np.ones(len(self._i) + nx + 1)
        self._squares, self._linear = len(self._i), slice(len(self._i), len(self._i) + nx)
        self._all = lifted(nodes.x0, nodes.F)
        self.refresh()

    def refresh(self) -> None:
        """Take over the levels of the funnels."""
        nodes, self._index, self._matrix, self._costs = self.nodes, [], [], []
        rho = np.minimum(nodes.rho, UNCUT)
        for leg in range(len(STANCES)):
            index = np.flatnonzero((nodes.stance == leg) & (rho > 0) & (nodes.span > 0))
            self._index.append(index)
            # Over rho: the product is the depth itself. One column a node: 15 long rows are gone
            # through twice as fast as thousands of short ones.
            self._matrix.append(np.ascontiguousarray((self._all[index] / rho[index, None]).T))
            self._costs.append(np.empty(len(index)))

    def best(self, leg: int, x: np.ndarray) -> Claim:
        """The node at which a state is least deep; some microseconds per thousand nodes.

        Args:
            leg: Leg that stands, index into STANCES.
            x: State, shape (nx,) or longer.
        """
        index = self._index[leg]
        if not len(index):
            return Claim(-1, math.inf)
        nx, m = self._linear.stop - self._linear.start, self._features
        x = x[:nx]
        np.multiply(x[self._i], x[self._j], out=m[: self._squares])
        m[self._linear] = x
        depths = np.dot(m, self._matrix[leg], out=self._costs[leg])
        row = depths.argmin()
        return Claim(int(index[row]), max(float(depths[row]), 0.0))

    def best_of_many(
        self, leg: np.ndarray, x: np.ndarray, but: Sequence[Sequence[int]] = ()
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `best`, for many states, at every turn of them.

        Args:
            leg: Shape (B,).
            x: Shape (B, nx).
            but: Nodes that are out of the question, of each state; none if empty.

        Returns:
            Nodes (B,), -1 for none, and depths (B,).
        """
        node, depth = self._best_where_they_are(leg, x, but)
        for turn in self.turns:
            other, less = self._best_where_they_are(leg, x + turn, but)
            node, depth = np.where(less < depth, other, node), np.minimum(less, depth)
        return node, depth

    def turned(self, node: np.ndarray, x: np.ndarray) -> np.ndarray:
        """States (B, nx), each at the turn at which it is least deep at its node (B,)."""
        if not len(self.turns):
            return x
        at = np.concatenate([x[:, None], x[:, None] + self.turns], axis=1)
        away = at - self.nodes.x0[node][:, None]
        costs = np.einsum('bti,bij,btj->bt', away, self.nodes.F[node], away)
        return at[np.arange(len(x)), costs.argmin(axis=1)]

    def _best_where_they_are(
        self, leg: np.ndarray, x: np.ndarray, but: Sequence[Sequence[int]]
    ) -> tuple[np.ndarray, np.ndarray]:
        """As `best_of_many`, at no turn but their own."""
        node, depth = np.full(len(leg), -1), np.full(len(leg), math.inf)
        for number, (index, matrix) in enumerate(zip(self._index, self._matrix, strict=True)):
            rows = np.flatnonzero(leg == number)
            if len(rows) and len(index):
                depths = monomials(x[rows, : self.nodes.x0.shape[1]]) @ matrix
                for k, row in enumerate(rows):
                    if but and but[int(row)]:
                        depths[k, np.isin(index, but[int(row)])] = math.inf
                best = depths.argmin(axis=1)
                node[rows] = index[best]
                depth[rows] = np.maximum(depths[np.arange(len(rows)), best], 0.0)
        return node, depth
