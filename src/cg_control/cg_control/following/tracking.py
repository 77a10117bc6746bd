"""Following nodes: u = u0(s) - K(s) (x - x0(s)), and what happens around an impact.

The clock of TVLQR is its weakness (thesis, 4.5): gains and reference belong to an instant, and
if the robot lands earlier or later they belong to the wrong leg. The remedies differ in s:

    clock   s = t, whatever leg stands: the plain controller; it can meet positive feedback
    blank   s = t, no feedback within `window` of a nominal impact: the thesis's remedy
    event   the phase is that of the leg that stands; at the impact s jumps to the nominal one.
            Until a late impact the reference goes on as the model would
    phase   as event, and s follows the robot: it runs faster or slower towards the point of the
            reference on whose transversal surface the robot is

`event` and `phase` are one law, (FOL) of trajectories.md, which is written twice: here for
one robot that lives, and in rollouts.c for thousands that are simulated.
"""

import math
from dataclasses import dataclass

import numpy as np

from cg_control.following.nodes import LATE, Nodes
from cg_control.friction import FrictionCompensation
from cg_control.trajectories.trajectory import Trajectory
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_interfaces.settings import Settings, setting

REMEDIES = ('clock', 'blank', 'event', 'phase')
LEAST_TURN = 0.2  # of 1 - n_s'(x - x0), which is 0 where surfaces meet: there no phase is defined


@dataclass(frozen=True)
class TrackingSettings(Settings):
    """How a trajectory is followed."""

    remedy: str = setting(
        'event', 'what is done about impacts off their time', choices=REMEDIES, live=True
    )
    window: float = setting(
        0.08, 'blank: time before and after a nominal impact without feedback', unit='s',
        minimum=0.0, maximum=1.0, live=True,
    )  # fmt: skip
    late: float = setting(
        LATE, 'event, phase: how long the reference goes on while an impact is late', unit='s',
        minimum=0.0, maximum=1.0, live=True,
    )  # fmt: skip
    pull: float = setting(
        5.0, 'phase: rate at which the phase is drawn to the surface that holds the state',
        unit='1/s', minimum=0.0, maximum=1000.0, live=True,
    )  # fmt: skip
    fastest: float = setting(
        2.0, 'phase: largest rate of the phase, and the inverse of the least', minimum=1.0,
        maximum=10.0, live=True,
    )  # fmt: skip
    feedback: bool = setting(True, 'off: the nominal torque alone, played back', live=True)

    @property
    def by_clock(self) -> bool:
        """Whether the phase goes on with time alone, whatever leg stands."""
        return self.remedy in ('clock', 'blank') or not self.feedback

    @property
    def pulled(self) -> float:
        """The pull of (FOL), 1/s: `event` is `phase` without any."""
        return self.pull if self.remedy == 'phase' else 0.0


# Orbits are followed so: the phase is the projection on the surfaces, within what a robot can be
# faster or slower.
WALKING = TrackingSettings(remedy='phase', pull=500.0, fastest=10.0)


class Tracker:
    """Nodes under feedback. The same object runs in the nodes, the benches and the tests.

    Args:
        nodes: What is followed.
        model: The robot as the controller knows it: its torque limit and its friction.
        settings: May be replaced between steps.
        start: Node to begin at; None takes the first of the trajectory that came last.

    Attributes:
        node: The reference is on the way from this node to the next,
        elapsed: since so many seconds.
    """

    def __init__(
        self,
        nodes: Nodes,
        model: Model,
        settings: TrackingSettings | None = None,
        start: int | None = None,
    ):
        self.nodes, self.settings = nodes, settings or TrackingSettings()
        self.limit = model.torque_limit
        self._friction = FrictionCompensation(model) if nodes.compensate else None
        self._edges, self._nx = nodes.edges, nodes.x0.shape[1]
        # Python's own numbers: a step looks at a handful, and numpy's take long to get at.
        self._span, self._next = nodes.span.tolist(), nodes.next.tolist()
        self._landing, self._stance = nodes.landing.tolist(), nodes.stance.tolist()
        self._planned, self._impact = nodes.planned.tolist(), nodes.impact.tolist()
        self.begin(nodes.first if start is None else start)

    def begin(self, node: int, elapsed: float = 0.0) -> None:
        """Begin anew at the next step.

        Args:
            node: Where the reference is then,
            elapsed: or so much later on the way to the next node, s.
        """
        if not 0 <= node < len(self.nodes):
            raise ValueError(f'node is {node}; there are nodes 0 to {len(self.nodes) - 1}')
        if not 0.0 <= elapsed < math.inf:
            raise ValueError(f'elapsed is {elapsed} s; it must be a number and not negative')
        self.node, self.elapsed = node, elapsed
        self._last: float | None = None
        self._since_impact = math.inf

    @property
    def done(self) -> bool:
        """Whether a root has been reached: what goes on is the balance controller."""
        return self._planned[self.node] < 0

    @property
    def s(self) -> float:
        """Instant of the reference on the clock of its trajectory, s."""
        return float(self.nodes.time[self.node]) + self.elapsed

    def left(self, stance: str) -> bool:
        """Whether the leg that stands belongs to another plan: it landed where none was planned.

        The torque is zero then.
        """
        return STANCES[self._stance[self.node]] != stance and not self.settings.by_clock

    def torque(self, t: float, stance: str, x: np.ndarray) -> float:
        """Hip torque in N m; zero for a state that is not finite, or when the plan is left.

        Args:
            t: Any clock in s; the first call is the start.
            stance: The leg that stands.
            x: (q_inner, q_outer) and rates, shape (nx,) or longer.
        """
        x = np.asarray(x, float)[: self._nx]
        if not math.isfinite(x.sum()):
            return 0.0
        elapsed = 0.0 if self._last is None else t - self._last
        self._last = t
        self._advance(elapsed, STANCES.index(stance), x)
        if self.left(stance):
            return 0.0
        reference = self._reference()
        wanted = reference.item(0)
        if self._friction:
            wanted += self._friction.taken(x.item(0) - x.item(1), x.item(2) - x.item(3))
        if self.done or (self.settings.feedback and not self._blanked()):
            nx = self._nx
            wanted -= reference[1 + nx :].dot(x - reference[1 : 1 + nx]).item()
        return min(max(wanted, -self.limit), self.limit)

    def _reference(self) -> np.ndarray:
        """(u0, x0, K) at the point of the reference, shape (1 + 2 nx,)."""
        s = self.elapsed
        return np.array((1.0, s, s * s, s * s * s)).dot(self._edges[self.node])

    def _advance(self, elapsed: float, leg: int, x: np.ndarray) -> None:
        """Move the reference on by the time since the last step."""
        node = self.node
        if self.settings.by_clock:
            self._since_impact += elapsed
            self.elapsed += elapsed
            while self._impact[node] or self.elapsed >= self._span[node]:
                if self._planned[node] < 0:
                    break
                if self._impact[node]:
                    self._since_impact = self.elapsed
                else:
                    self.elapsed -= self._span[node]
                node = self._planned[node]
        elif leg != self._stance[node]:
            if self._landing[node] >= 0:
                node, self.elapsed = self._landing[node], 0.0
        else:
            self.elapsed += self._rate(x, elapsed) * elapsed
        while self.elapsed >= self._span[node]:
            self.elapsed -= self._span[node]
            node = self._next[node]
        self.node = node

    def _rate(self, x: np.ndarray, elapsed: float) -> float:
        """ds/dt that brings the reference to the surface on which the robot is, limited."""
        pull = self.settings.pulled
        if pull == 0.0:
            return 1.0
        s, nx = self.elapsed, self._nx
        powers = np.array((1.0, s, s * s, s * s * s))
        deviation = x - powers.dot(self._edges[self.node][:, 1 : 1 + nx])
        normal, turn = self.nodes.surfaces[self.node]
        ahead = (normal + s * turn).dot(deviation).item()
        ahead /= max(1.0 - turn.dot(deviation).item(), LEAST_TURN)
        fastest = self.settings.fastest
        # By now the robot should be ahead of where the reference was by as much time as is over.
        return min(max(1.0 + pull * (ahead - elapsed), 1 / fastest), fastest)

    def _blanked(self) -> bool:
        if self.settings.remedy != 'blank':
            return False
        until, node = -self.elapsed, self.node
        while until <= self.settings.window and not self._impact[node]:
            until += self._span[node]
            node = self._planned[node]
            if node < 0:
                return self._since_impact <= self.settings.window
        return min(until, self._since_impact) <= self.settings.window


def wrong_leg(trajectory: Trajectory, stance: str, at: float | None = None) -> str:
    """Why a trajectory cannot begin while this leg stands; empty if it can.

    Args:
        trajectory: The motion.
        stance: The leg.
        at: Instant on the clock of the trajectory, s; None: its start.
    """
    if stance not in STANCES:
        return f'stance is {stance!r}; allowed are {", ".join(STANCES)}'
    leg = trajectory.modes[0 if at is None else trajectory.index_at(at)]
    if stance != leg:
        return f'the trajectory begins on the {leg} leg, but {stance} stands'
    return ''
