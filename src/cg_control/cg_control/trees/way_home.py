"""The way from a node of a tree to its home, to look at: knots, and where hip and feet go."""

from dataclasses import dataclass

import numpy as np

from cg_control.following.nodes import Nodes


@dataclass(frozen=True)
class WayHome:
    """The active branch: what the robot is to do from a node on.

    Attributes:
        nodes: Indices, in order: knots of the plan, shape (n,).
        time: From the first one on in s, shape (n,); equal on both sides of an impact.
        stance: Leg that stands, index into STANCES, shape (n,).
        states: (q_inner, q_outer) and rates, shape (n, 4).
        rates: dx/dt, shape (n, 4).
        torque: Nominal, N m, shape (n,).
    """

    nodes: np.ndarray
    time: np.ndarray
    stance: np.ndarray
    states: np.ndarray
    rates: np.ndarray
    torque: np.ndarray

    @classmethod
    def along(cls, nodes: Nodes, node: int) -> 'WayHome':
        """The way from a node to rest, or once round an orbit; links, which take no time, not."""
        if not 0 <= node < len(nodes):
            raise ValueError(f'node is {node}; there are nodes 0 to {len(nodes) - 1}')
        planned, jumps = nodes.planned, nodes.impact | nodes.late
        found, time, t = [], [], 0.0
        passed: set[int] = set()
        while node >= 0 and node not in passed:
            passed.add(node)
            if nodes.span[node] > 0:
                found.append(node)
                time.append(t)
            t += 0.0 if jumps[node] or planned[node] < 0 else float(nodes.span[node])
            node = int(planned[node])
        rows = np.array(found)
        return cls(
            rows, np.array(time), nodes.stance[rows], nodes.x0[rows], nodes.rates[rows],
            nodes.u0[rows],
        )  # fmt: skip

    def points(self, leg_length: float, foot: float = 0.0) -> dict[str, np.ndarray]:
        """Where hip and feet go, in the plane of the motion on level ground.

        Args:
            leg_length: In m.
            foot: Where the foot stands at the beginning, m ahead.

        Returns:
            'hip', 'inner_foot' and 'outer_foot' -> (x ahead, z up) in m, shape (n, 2).
        """
        up = self._legs(leg_length)
        stands = np.column_stack([self.feet(leg_length, foot), np.zeros(len(up))])
        hip = stands + up[np.arange(len(up)), self.stance]
        return {'hip': hip, 'inner_foot': hip - up[:, 0], 'outer_foot': hip - up[:, 1]}

    def feet(self, leg_length: float, foot: float = 0.0) -> np.ndarray:
        """Where the foot that stands is, m ahead, shape (n,); arguments as `points`."""
        up, rows = self._legs(leg_length), np.arange(len(self.states))
        # A step carries the stance foot to where the swing foot has landed.
        stride = (up[rows, 1 - self.stance] - up[rows, self.stance])[:, 0]
        steps = np.flatnonzero(np.diff(self.stance)) + 1
        moved = np.zeros(len(rows))
        moved[steps] = stride[steps]
        return foot + np.cumsum(moved)

    def _legs(self, leg_length: float) -> np.ndarray:
        """From each foot to the hip, shape (n, leg, 2)."""
        q = self.states[:, :2]
        return leg_length * np.stack([np.sin(q), np.cos(q)], axis=-1)
