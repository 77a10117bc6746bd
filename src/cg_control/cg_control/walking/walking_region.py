"""The states of robots that are pushed while they walk, for a tree to grow from.

A point of an orbit is drawn, and a deviation from it: in the roles of the legs, from a box that is
shrunk by a factor drawn with each, so that small pushes are as many as large ones. Pushes at the
hip change the rates alone; the box holds angles as well, as a robot is rarely on its orbit.
"""

import hashlib
from dataclasses import dataclass

import numpy as np

from cg_control.following.nodes import Nodes
from cg_control.trees.growth import Region, in_coordinates
from cg_control.walking.walking_tree import buried


class OrbitPoints:
    """The points of all orbits of a tree.

    Args:
        nodes: The tree.

    Attributes:
        stance: Leg that stands, index into STANCES, of each piece, shape (n,).
        span: Duration of each piece in s, shape (n,).
    """

    def __init__(self, nodes: Nodes):
        on = np.flatnonzero(nodes.orbiting & ~nodes.impact)
        if not len(on):
            raise ValueError('the tree has no orbit; plan_walk makes one that has')
        self.stance, self.span = nodes.stance[on], nodes.span[on]
        self._edges = nodes.edges[on][:, :, 1 : 1 + nodes.x0.shape[1]]

    def __repr__(self) -> str:
        """What a checkpoint says of them: other orbits have another one."""
        parts = (self.stance, self.span, self._edges)
        digest = hashlib.sha256(b''.join(np.ascontiguousarray(part).tobytes() for part in parts))
        return f'{len(self.span)} pieces of orbits, {digest.hexdigest()[:12]}'

    def draw(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Stance legs (count,) and states (count, nx), evenly in time along all orbits."""
        piece = rng.choice(len(self.span), count, p=self.span / self.span.sum())
        powers = (rng.random(count) * self.span[piece])[:, None] ** np.arange(4.0)
        return self.stance[piece], np.einsum('nk,nki->ni', powers, self._edges[piece])


@dataclass(frozen=True)
class WalkingRegion(Region):
    """As `Region`, but most of the states are those of robots that walk.

    Attributes:
        orbits: That they walk on.
        around: Half the edges of the box of deviations, as `half`, shape (4,).
        share: Of the states that are drawn around orbits.
    """

    orbits: OrbitPoints | None = None
    around: np.ndarray | None = None
    share: float = 0.75

    def draw(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """As `Region.draw`; those around orbits come first."""
        walking = int(self.walking(count).sum())
        leg, x = self.draw_walking(rng, walking)
        still = super().draw(rng, count - walking)
        return np.append(leg, still[0]), np.vstack([x, still[1]])

    def draw_walking(self, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
        """As `draw`, around orbits alone.

        Where the swing foot would be ahead and in the ground it has landed before: none of these.
        """
        assert self.orbits is not None
        assert self.around is not None
        legs, states, missing = [], [], count
        while missing:
            leg, x = self.orbits.draw(rng, missing)
            roles = rng.uniform(-1.0, 1.0, (missing, 4)) * self.around
            x = x + in_coordinates(leg, roles * rng.random((missing, 1)))
            above = ~buried(x, leg)
            legs.append(leg[above])
            states.append(x[above])
            missing -= int(above.sum())
        return np.concatenate(legs or [np.empty(0, int)]), np.vstack(states or [np.empty((0, 4))])

    def walking(self, count: int) -> np.ndarray:
        """Which of so many states are those of robots that walk, shape (count,)."""
        return np.arange(count) < round(self.share * count)
