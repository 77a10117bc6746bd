"""Ways from home to home: standing, and walking at each of the speeds of a tree.

A branch that begins on a home and leads to another one is a *departure*: a step in from upright,
a change of speed, a stop. What begins where is seen from the states, so a tree needs no list of
them. Between distant speeds the way leads over those between, and to an orbit that no other way
reaches over upright.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cg_control.following.nodes import Nodes

UPRIGHT = -1  # the number of that home; orbits have those of `Nodes.orbit_of`
SAME = 1e-6  # rad and rad/s: a branch that begins as near to a node of a home begins at it


@dataclass(frozen=True)
class Departure:
    """Where a branch leaves a home.

    Attributes:
        home: That it leaves: UPRIGHT or the number of an orbit.
        node: Of the home, at which it does.
        entry: First node of the branch.
        onto: The home that it leads to.
    """

    home: int
    node: int
    entry: int
    onto: int


@dataclass(frozen=True)
class Routes:
    """The departures of a tree.

    Attributes:
        departures: All of them.
        speeds: Of the orbits in m/s, in the order of their numbers.
    """

    departures: tuple[Departure, ...]
    speeds: tuple[float, ...] = ()

    @classmethod
    def of(cls, nodes: Nodes, speeds: Sequence[float] | np.ndarray = ()) -> 'Routes':
        """Find them.

        Args:
            nodes: The tree.
            speeds: Of its orbits, m/s.

        Raises:
            ValueError: There are not as many speeds as orbits.
        """
        count = int(nodes.orbit_of.max()) + 1
        if len(speeds) != count:
            raise ValueError(f'{len(speeds)} speeds are given; the tree has {count} orbits')
        homes = np.flatnonzero(nodes.home & ~nodes.impact)
        found = []
        for entry in nodes.entries[~nodes.home[nodes.entries]]:
            away = np.abs(nodes.x0[homes] - nodes.x0[entry]).max(axis=1)
            away[nodes.stance[homes] != nodes.stance[entry]] = np.inf
            nearest = int(away.argmin()) if len(homes) else 0
            if not len(homes) or away[nearest] > SAME:
                continue
            node = int(homes[nearest])
            home, onto = int(nodes.orbit_of[node]), int(nodes.orbit_of[entry])
            if home != onto:
                found.append(Departure(home, node, int(entry), onto))
        return cls(tuple(found), tuple(map(float, speeds)))

    def home_at(self, speed: float) -> int:
        """The home whose speed is nearest to a demanded one; upright has speed zero."""
        homes = [UPRIGHT, *range(len(self.speeds))]
        return min(homes, key=lambda home: abs(speed - self.speed_of(home)))

    def speed_of(self, home: int) -> float:
        """In m/s."""
        return 0.0 if home == UPRIGHT else self.speeds[home]

    def towards(self, home: int, wanted: int) -> dict[int, int]:
        """Node of a home -> branch to take there, on the ways of fewest changes to another home.

        Empty where no way leads, or where the robot is there. On an orbit the robot comes by
        every node; where it stands it stays on its leg, and takes the best way from there.
        """
        far = self._changes(wanted)
        if home == wanted:
            return {}
        if home not in far and home != UPRIGHT and wanted != UPRIGHT:
            return self.towards(home, UPRIGHT)
        found: dict[int, Departure] = {}
        for d in self.departures:
            if d.home != home or d.onto not in far or d.onto == UPRIGHT != wanted:
                continue
            nearer = home == UPRIGHT or far[d.onto] < far[home]
            if nearer and (d.node not in found or far[d.onto] < far[found[d.node].onto]):
                found[d.node] = d
        return {node: d.entry for node, d in found.items()}

    def _changes(self, wanted: int) -> dict[int, int]:
        """How many branches it takes from each home to the wanted one, never over upright.

        To stop and step in again may be fewer changes than from speed to speed, but nobody asked
        for a stop.
        """
        far, front = {wanted: 0}, {wanted}
        while front:
            through = front if wanted == UPRIGHT else front - {UPRIGHT}
            front = {d.home for d in self.departures if d.onto in through} - far.keys()
            far |= dict.fromkeys(front, max(far.values()) + 1)
        return far
