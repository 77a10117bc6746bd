"""The levels of funnels, from simulated robots that came by: trees.md, "Levels".

A funnel holds what its node brings home. Its level rho is infinite until a robot that came by
fails, and then the largest cost below which at most a share `tolerated` of those that came by
failed. With a tolerance of zero that is the rule of Reist and Tedrake: just below the least cost
that failed. With one of a percent a single odd failure among hundreds does not cut away a funnel;
how many claims turn out false is measured on other states (coverage.py).

Costs are counted in bins of a logarithmic scale, so that a node needs no more room however many
come by.
"""

from dataclasses import dataclass, field

import numpy as np

FINEST, COARSEST, PER_DECADE = 1e-4, 1e6, 8
BINS = round(np.log10(COARSEST / FINEST)) * PER_DECADE
EDGES = FINEST * 10.0 ** (np.arange(BINS + 1) / PER_DECADE)  # upper edges of the bins


@dataclass
class Levels:
    """What came by the nodes of a tree.

    Attributes:
        tolerated: Share of failures that a funnel may hold.
        home: Robots that came home, by node and bin, shape (n, BINS + 1).
        failed: Those that did not.
    """

    tolerated: float
    home: np.ndarray = field(default_factory=lambda: np.zeros((0, BINS + 1), np.int32))
    failed: np.ndarray = field(default_factory=lambda: np.zeros((0, BINS + 1), np.int32))

    @classmethod
    def of(cls, tolerated: float, rho: np.ndarray) -> 'Levels':
        """As if one robot had failed just beyond each level that is known, (n,).

        So a level is kept until more is known: what comes by later counts with it.
        """
        levels = cls(tolerated).extended(len(rho))
        cut = np.flatnonzero(rho <= EDGES[-2])
        levels.failed[cut, np.searchsorted(EDGES, rho[cut] * (1 + 1e-9))] = 1
        return levels

    def extended(self, count: int) -> 'Levels':
        """With room for so many nodes."""
        rows = count - len(self.home)
        more = np.zeros((rows, BINS + 1), np.int32)
        return Levels(self.tolerated, np.vstack([self.home, more]), np.vstack([self.failed, more]))

    def add(self, node: np.ndarray, cost: np.ndarray, home: np.ndarray) -> None:
        """Count robots that came by: nodes, costs there, whether they came home, all (m,)."""
        bins = np.searchsorted(EDGES, cost).clip(0, BINS)
        np.add.at(self.home, (node[home], bins[home]), 1)
        np.add.at(self.failed, (node[~home], bins[~home]), 1)

    def rho(self, node: np.ndarray) -> np.ndarray:
        """The levels of these nodes, shape (m,)."""
        failed = np.cumsum(self.failed[node], axis=1)
        came = failed + np.cumsum(self.home[node], axis=1)
        holds = failed <= self.tolerated * came
        # The largest bin that holds; what is beyond the last failure is no limit.
        last = BINS - np.argmax(holds[:, ::-1], axis=1)
        level = np.where(holds.any(axis=1), EDGES[last], 0.0)
        return np.where(holds[:, -1], np.inf, level)
