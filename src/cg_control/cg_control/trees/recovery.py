"""Following a tree live: recovery from wherever it brings the robot home, then balance or walking.

At every measurement, in this order:

    0. Where a branch leads from the home that the robot is at towards the one that is wanted, it
       takes that: upright when the balance controller holds it there, from an orbit when it comes
       by, inside the tube. Wanted is what the speed says.                             (DEPART)
    1. On a way to upright, in the goal region of the leg that stands, the robot balances. Once it
       has been out of the basin of the balance controller for `patience`, or for the less the
       further out it is, it leaves for what brings it home, or for lack of that at a depth of
       `hold`.                                                                           (HOME)
    2. It follows its node as long as the funnel there holds it. It goes over to the node at
       which its state is least deep, if it has left its funnel, or if it is so much less deep
       there and home is not further.                                                    (SWITCH)
    3. Where no funnel holds it, the tree is previewed (preview.py): the robot stays on its way
       if that brings it home in simulation, or goes over to an entry that does. The entries
       are tried over as many samples as it takes, so that none is answered late. Where the
       robot is to walk, those that lead to an orbit come before those to upright.     (PREVIEW)
    4. Where nothing brings it home there is no torque, until something does.          (OUTSIDE)

Nothing is planned meanwhile: what a push does to the state is answered by another node. A foot
that lands where no impact was planned is a state like any other.

*Hysteresis.* A robot is in a funnel, or in the basin, until its depth there is `hold`; it enters
at 1. A rival must be less deep by `margin`. The torque ends when nothing has held the state for
`patience`. So noise at the edge of a funnel, or between two nodes, changes nothing. Nor does noise
of the rates at home: it throws the state out of the basin at one sample or two. `hold` and
`patience` are more than that: who comes by a node further out than rho often comes home, for rho
is where one in a hundred does not, and from node to node it is ragged (levels.py). With previews
funnels need neither `hold` nor `margin`: the way that the robot is on is simulated first.
"""

import collections
import math
import time
from dataclasses import dataclass, replace

import numpy as np

from cg_control.balancing.balance import (
    BALANCING,
    IDLE,
    BalanceController,
    BalanceSettings,
    Command,
)
from cg_control.following.nodes import Way
from cg_control.following.tracking import Tracker, TrackingSettings
from cg_control.trees.lookup import Claim, Lookup
from cg_control.trees.preview import LANDING, Preview
from cg_control.trees.routes import UPRIGHT, Routes
from cg_control.trees.tree import Tree
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_dynamics.rollout.vector_code import WIDTH
from cg_interfaces.settings import setting

FOLLOWING, OUTSIDE = 'following', 'outside'
KEPT = 5000  # look-ups whose time is remembered
CALM = 0.1  # depth in the goal region up to which a robot that stands begins to walk
STAY, NOWHERE = -1, -2  # in place of a node to go over to
NONE: np.ndarray = np.empty(0, int)  # no nodes


@dataclass(frozen=True)
class RecoverySettings(BalanceSettings):
    """Parameters of the controller that follows a tree."""

    fall_angle: float = setting(
        LANDING.fall_angle, 'lean of the stance leg beyond which nothing is followed', unit='rad',
        minimum=0.05, maximum=1.5, live=True,
    )  # fmt: skip
    largest_swing: float = setting(
        LANDING.swing_angle, 'angle of the swing leg beyond which nothing is followed', unit='rad',
        minimum=0.1, maximum=3.1, live=True,
    )  # fmt: skip
    remedy: str = setting(
        'tree', 'what is done about impacts off their time; tree: what the tree was made for',
        choices=('tree', 'event', 'phase'), live=True,
    )  # fmt: skip
    pull: float = setting(
        5.0, 'phase: rate at which the phase is drawn to the surface that holds the state',
        unit='1/s', minimum=0.0, maximum=1000.0, live=True,
    )  # fmt: skip
    fastest: float = setting(
        2.0, 'phase: largest rate of the phase, and the inverse of the least', minimum=1.0,
        maximum=10.0, live=True,
    )  # fmt: skip
    hold: float = setting(
        4.0, 'depth at which the robot leaves the basin that it is in, though nothing brings it '
        'home, and, without previews, the funnel; it enters at 1', minimum=1.0, maximum=1e6,
        live=True,
    )  # fmt: skip
    patience: float = setting(
        0.03, 'time for which nothing has held the state after which the torque ends, and for '
        'which the state has been out of the basin, divided by the depth there, after which the '
        'robot leaves it', unit='s', minimum=0.0, maximum=1.0, live=True,
    )  # fmt: skip
    margin: float = setting(
        2.0, 'by how much less deep a state must be elsewhere for the robot to go over',
        minimum=0.0, maximum=1e6, live=True,
    )  # fmt: skip
    preview: bool = setting(
        True, 'simulate where the tree leads from states that no funnel holds, and follow what '
        'brings the robot home', live=True,
    )  # fmt: skip
    preview_period: float = setting(
        0.01, 'for how long a preview counts', unit='s', minimum=0.001, maximum=1.0, live=True
    )

    speed: float = setting(
        0.0, 'at which the robot is to walk; it takes the orbit that is nearest, 0 is to stand',
        unit='m/s', minimum=0.0, maximum=2.0, live=True,
    )  # fmt: skip
    steps: int = setting(
        0, 'after which the robot is to stand; 0: it walks on', minimum=0, maximum=1_000_000,
        live=True,
    )  # fmt: skip

    def law(self, tree: Tree) -> TrackingSettings:
        """How a tree is followed."""
        if self.remedy == 'tree':
            return tree.law
        return TrackingSettings(remedy=self.remedy, pull=self.pull, fastest=self.fastest)


@dataclass(frozen=True)
class ReadyTree:
    """A tree and what following it takes, made ahead: no answer to a state waits for it.

    Attributes:
        tree: The tree.
        lookup: Of its funnels.
        tracker: Of its nodes.
        preview: Of its entries, on the robot as it is known.
        routes: From home to home.
    """

    tree: Tree
    lookup: Lookup
    tracker: Tracker
    preview: Preview
    routes: Routes

    @classmethod
    def of(cls, tree: Tree, model: Model, sample_time: float = LANDING.sample_time) -> 'ReadyTree':
        """Make everything.

        Args:
            tree: The tree.
            model: The robot as it is known, which may be more than when the tree was grown.
            sample_time: Over which the torque is held, s: in previews as on the robot.

        Raises:
            ValueError: The robot cannot be previewed: it has an input delay, say.
        """
        nodes = tree.nodes
        preview = Preview(tree, model, simulation=replace(LANDING, sample_time=sample_time))
        routes = Routes.of(nodes, tree.speeds)
        ready = cls(tree, Lookup(nodes), Tracker(nodes, model), preview, routes)
        # What is worked out once, when it is first asked for; the rollouts are compiled.
        _ = nodes.costs, nodes.surfaces, nodes.to_go, nodes.steps, nodes.ways
        try:
            preview.choose(nodes.stance[:1], nodes.x0[:1])
        except ValueError as error:
            raise ValueError(f'{model.name!r} cannot be previewed: {error}') from None
        return ready


class TreeController:
    """Brings a robot home along a tree. The same object runs in the node, benches and tests.

    Args:
        balance: Of both legs; engages in the goal regions of the tree.
        settings: May be replaced between steps by `adopt`; those of `balance` are its own.

    Attributes:
        mode: 'idle' (not armed, or no tree), 'balancing', 'following' or 'outside'.
        node: That is followed, -1 while none is.
        entered: Node at which it went over to where it is now, -1 while none is followed.
        depth: Of the last state: in the basin while balancing, in the funnel otherwise, NaN
            where none is said (an impact is due). Inside if 1 or less.
        demand: Speed that is wanted in place of that of the settings, m/s; None: theirs.
        steps_taken: Impacts since it was told at which speed to walk.
        switches: How often the robot has gone over to another node while it followed one.
        lookup_times: Of the last look-ups, s.
        preview_times: Of previews at the last samples that had one, s.
    """

    def __init__(self, balance: BalanceController, settings: RecoverySettings):
        self.balance, self.settings = balance, settings
        self.mode, self.node, self.entered = IDLE, -1, -1
        self.depth, self.switches, self.steps_taken = math.inf, 0, 0
        self.demand: float | None = None
        self.lookup_times: collections.deque[float] = collections.deque(maxlen=KEPT)
        self._ready: ReadyTree | None = None
        self.preview_times: collections.deque[float] = collections.deque(maxlen=KEPT)
        self._stance, self._torque = '', 0.0
        self._held_ns = self._home_ns = self._asked_ns = 0
        self._previewed_ns: int | None = None
        self._verdict, self._untried = NOWHERE, NONE

    @property
    def tree(self) -> Tree | None:
        """What is followed."""
        return self._ready.tree if self._ready else None

    @property
    def torque_limit(self) -> float:
        """Largest torque commanded, N m."""
        return self.balance.torque_limit

    @property
    def wanted(self) -> int:
        """The home that is wanted: an orbit of the tree, or routes.UPRIGHT."""
        made = self.settings.steps and self.steps_taken >= self.settings.steps
        if made or self._ready is None:
            return UPRIGHT
        speed = self.settings.speed if self.demand is None else self.demand
        return self._ready.routes.home_at(speed)

    @property
    def speed(self) -> float:
        """Of the home that the robot is at or on its way to, m/s."""
        if self.mode != FOLLOWING or self._ready is None:
            return 0.0
        nodes = self._ready.tree.nodes
        return self._ready.routes.speed_of(int(nodes.orbit_of[self._ready.tracker.node]))

    @property
    def way(self) -> Way:
        """Where the node leads that is followed; upright while none is."""
        if self.mode != FOLLOWING or self._ready is None:
            return Way.UPRIGHT
        return Way(self._ready.tree.nodes.ways[self._ready.tracker.node])

    @property
    def to_go(self) -> float:
        """Nominal time until upright in s: 0 while balancing, infinite outside every funnel."""
        if self.mode != FOLLOWING or self._ready is None:
            return 0.0 if self.mode == BALANCING else math.inf
        tracker = self._ready.tracker
        return max(float(tracker.nodes.to_go[tracker.node]) - tracker.elapsed, 0.0)

    @property
    def branch(self) -> int:
        """Number of the trajectory that is followed, -1 while none is."""
        return -1 if self.node < 0 or self.tree is None else int(self.tree.nodes.branch[self.node])

    def adopt(self, settings: RecoverySettings) -> None:
        """New settings from the next step on."""
        if (settings.speed, settings.steps) != (self.settings.speed, self.settings.steps):
            self.steps_taken = 0
        self.settings = settings
        if self._ready is not None:
            self.take(self._ready)

    def take(self, ready: ReadyTree | None) -> None:
        """Follow another tree from the next step on, or none."""
        if self.mode == FOLLOWING and self._ready is not ready:
            self._rest(IDLE)
        if self._ready is not ready:
            self._search_anew()
        self._ready = ready
        if ready is not None:
            ready.tracker.settings = ready.preview.settings = self.settings.law(ready.tree)
            # Beyond these angles nothing is followed, so nothing is promised either.
            ready.preview.simulation = replace(
                ready.preview.simulation, fall_angle=self.settings.fall_angle,
                swing_angle=self.settings.largest_swing,
            )  # fmt: skip

    def interrupt(self) -> None:
        """States were missing: what was known of the motion is void."""
        self._rest(IDLE)
        self._search_anew()

    def step(self, stamp_ns: int, stance: str, x: np.ndarray) -> Command:
        """The torque for a state; arguments as `BalanceController.step`."""
        x = np.asarray(x, float)
        landed, self._stance = stance != self._stance, stance
        if landed:
            self._search_anew()
        reason, mode = self._doubt(), IDLE
        if not reason:
            reason, mode = self._nowhere(stance, x), OUTSIDE
        if reason:
            self._rest(mode)
            self._search_anew()
            return Command(0.0, mode, reason)
        self.steps_taken += landed and self.mode == FOLLOWING
        best = self._best(stance, x)
        self._depart(stamp_ns, stance, x)
        if self._at_home(stamp_ns, stance, x, landed):
            self._search_anew()
            command = self._balanced(stamp_ns, stance, x)
            if command:
                return command
        return self._followed(stamp_ns, stance, x, best)

    def _doubt(self) -> str:
        if not self.settings.armed:
            return 'not armed'
        return '' if self._ready else 'no tree'

    def _nowhere(self, stance: str, x: np.ndarray) -> str:
        """Why no funnel is asked."""
        if stance not in STANCES:
            return f'stance is {stance!r}; allowed are {", ".join(STANCES)}'
        if not math.isfinite(x.sum()):
            return 'the state is not finite'
        standing = STANCES.index(stance)
        lean, swing = x[standing], x[1 - standing]
        if abs(lean) > self.settings.fall_angle or abs(swing) > self.settings.largest_swing:
            return f'leaning by {lean:.3g} rad, swing leg at {swing:.3g} rad'
        return ''

    def _depart(self, stamp_ns: int, stance: str, x: np.ndarray) -> None:
        """Begin a way towards the wanted home, if one leaves the present one here: (DEPART)."""
        assert self._ready is not None
        ready, nodes = self._ready, self._ready.tree.nodes
        tracker, leg = ready.tracker, STANCES.index(stance)
        if self.mode == BALANCING:
            home, here, elapsed = UPRIGHT, int(nodes.root_of[leg]), 0.0
        elif self.way == Way.ORBIT and nodes.stance[tracker.node] == leg:
            here, elapsed = tracker.node, tracker.elapsed
            home = int(nodes.orbit_of[here])
        else:
            return
        if home == self.wanted:
            return
        entry = ready.routes.towards(home, self.wanted).get(here)
        if entry is None or not self._ready_to_leave(stamp_ns, stance, x, entry):
            return
        self.mode, self.entered = FOLLOWING, entry
        tracker.begin(entry, elapsed)
        self._search_anew()

    def _ready_to_leave(self, stamp_ns: int, stance: str, x: np.ndarray, entry: int) -> bool:
        """Whether the robot is calm enough to take a way to another home."""
        assert self._ready is not None
        if self.mode != BALANCING:
            return self._depth_here(stance, x) <= 1.0
        if self._depth_in_goal(stance, x) > CALM:
            return False
        if 0 <= stamp_ns - self._asked_ns < 1e9 * self.settings.preview_period:
            return False
        self._asked_ns = stamp_ns
        return bool(self._ready.preview.brings_home(np.array([entry]), x[None])[0])

    def _at_home(self, stamp_ns: int, stance: str, x: np.ndarray, landed: bool) -> bool:
        """Whether (HOME) asks for nothing but the balance controller."""
        if self.way != Way.UPRIGHT:
            return False
        entering = self.mode != BALANCING or landed
        self.depth = (self._depth_in_goal if entering else self._depth_in_basin)(stance, x)
        if self.depth <= 1.0:
            self._home_ns = stamp_ns
            return True
        # One sample far out may be noise: it takes the more of them the less they say.
        out = 1e-9 * (stamp_ns - self._home_ns) * self.depth
        return not entering and out < self.settings.patience

    def _balanced(self, stamp_ns: int, stance: str, x: np.ndarray) -> Command | None:
        """The balance controller's answer, unless it refuses."""
        if self.mode != BALANCING:
            torque = self._torque
            if self.mode == FOLLOWING:
                # What dies out is what the laws differ by, not what the state has changed by.
                assert self._ready is not None
                torque = self._ready.tracker.torque(stamp_ns * 1e-9, stance, x)
            self.balance.take_over(torque)
        command = self.balance.step(stamp_ns, stance, x)
        if command.mode != BALANCING:
            return None
        self.mode, self._torque = BALANCING, command.torque
        self.node = self.entered = -1
        return command

    def _depth_in_goal(self, stance: str, x: np.ndarray) -> float:
        assert self._ready is not None
        form = self._ready.tree.goal[STANCES.index(stance)]
        motion = x[: len(form)]
        depth = float(motion @ form @ motion)
        return depth if depth == depth else math.inf  # this leg is no goal

    def _depth_in_basin(self, stance: str, x: np.ndarray) -> float:
        """Squared, as a depth in a funnel is: both grow as a cost does."""
        if self.balance.basins is None:
            return self._depth_in_goal(stance, x)
        return self.balance.basins[stance].depth_to_leave(x) ** 2

    def _followed(self, stamp_ns: int, stance: str, x: np.ndarray, best: Claim) -> Command:
        """The torque of the node that is followed after (SWITCH)."""
        assert self._ready is not None
        tracker = self._ready.tracker
        torque, here = 0.0, math.inf
        if self.mode == FOLLOWING:
            torque = tracker.torque(stamp_ns * 1e-9, stance, x)
            here = self._depth_here(stance, x)
        onto = self._onto(stamp_ns, stance, x, best, here)
        if onto == NOWHERE and self.mode == BALANCING:
            # While entries are still being tried, any torque that holds is better than none.
            held = len(self._untried) > 0 or self.depth <= self.settings.hold
            command = self._balanced(stamp_ns, stance, x) if held else None
            if command:
                return command
        if onto == NOWHERE and self._waited(stamp_ns, here):
            self._rest(OUTSIDE)
            self.depth = best.depth
            return Command(0.0, OUTSIDE, f'outside every funnel: depth {best.depth:.3g}')
        if onto != NOWHERE:
            self._held_ns = stamp_ns
        if onto >= 0:
            self.switches += self.mode == FOLLOWING
            self.balance.stop()
            tracker.begin(onto)
            self.entered = onto
            torque = tracker.torque(stamp_ns * 1e-9, stance, x)
            here = self._depth_here(stance, x)
        self.mode, self.node, self.depth = FOLLOWING, tracker.node, here
        limit = self.torque_limit
        self._torque = min(max(torque, -limit), limit)
        return Command(self._torque, FOLLOWING)

    def _onto(self, stamp_ns: int, stance: str, x: np.ndarray, best: Claim, here: float) -> int:
        """The node to go over to, STAY or NOWHERE, by (SWITCH) and (PREVIEW)."""
        if self.settings.preview and here > 1.0:  # NaN, where no depth is said, is not
            return self._previewed(stamp_ns, stance, x, best)
        self._untried = NONE
        if self.settings.preview:
            return STAY
        lost = here > self.settings.hold
        if lost and best.depth <= 1.0:
            return best.node
        rival = math.isfinite(here) and best.depth < here - self.settings.margin
        if rival and self._nearer(best.node):
            return best.node
        return NOWHERE if lost else STAY

    def _previewed(self, stamp_ns: int, stance: str, x: np.ndarray, best: Claim) -> int:
        """The node to go over to, STAY or NOWHERE, by (PREVIEW)."""
        assert self._ready is not None
        underway = self.mode == FOLLOWING and not self._ready.tracker.left(stance)
        since = None if self._previewed_ns is None else (stamp_ns - self._previewed_ns) * 1e-9
        fresh = since is not None and 0.0 <= since < self.settings.preview_period
        if fresh and not len(self._untried):
            return self._verdict if underway else NOWHERE
        began = time.perf_counter()
        onto = self._way_home(stance, x, best, underway)
        self._previewed_ns, self._verdict = stamp_ns, STAY if onto >= 0 else onto
        self.preview_times.append(time.perf_counter() - began)
        return onto

    def _way_home(self, stance: str, x: np.ndarray, best: Claim, underway: bool) -> int:
        """STAY, if the way that the robot is on brings it home; else a node that does.

        One register full of rollouts a sample: what is still untried waits for the next one. So
        NOWHERE is the last word only when nothing is untried.
        """
        assert self._ready is not None
        preview, tracker = self._ready.preview, self._ready.tracker
        if not len(self._untried):
            walking = self.wanted != UPRIGHT
            leg, ways = np.array([STANCES.index(stance)]), self._ready.tree.nodes.ways
            nodes = preview.candidates(leg, x[None], walking)[0]
            nodes = nodes[nodes >= 0]
            if best.depth <= 1.0 and not (walking and ways[best.node] == Way.UPRIGHT):
                # A robot that comes by an orbit need not take a way to one.
                nodes = np.insert(nodes, preview.nearest if walking else 0, best.node)
            self._untried = nodes.astype(int)
            if underway:
                # At a root time stands still, whatever the clock says.
                elapsed = 0.0 if tracker.done else tracker.elapsed
                here = np.array([tracker.node])
                if not preview.brings_home(here, x[None], np.array([elapsed]))[0]:
                    return NOWHERE
                self._untried = NONE
                return STAY
        some, self._untried = self._untried[:WIDTH], self._untried[WIDTH:]
        if not len(some):
            return NOWHERE
        home = preview.brings_home(some, np.repeat(x[None], len(some), axis=0))
        if not home.any():
            return NOWHERE
        self._untried = NONE
        return int(some[home.argmax()])

    def _waited(self, stamp_ns: int, here: float) -> bool:
        """Whether the robot gives its node up. One whose plan is over has no choice."""
        return math.isinf(here) or stamp_ns - self._held_ns >= 1e9 * self.settings.patience

    def _best(self, stance: str, x: np.ndarray) -> Claim:
        assert self._ready is not None
        began = time.perf_counter()
        best = self._ready.lookup.best(STANCES.index(stance), x)
        self.lookup_times.append(time.perf_counter() - began)
        return best

    def _depth_here(self, stance: str, x: np.ndarray) -> float:
        """Depth in the funnel at the present point of the tree; NaN where there is none."""
        assert self._ready is not None
        tracker, nodes = self._ready.tracker, self._ready.tree.nodes
        node = tracker.node
        if tracker.left(stance):
            return math.inf
        rho = nodes.rho.item(node)
        if rho == 0.0:
            # An impact is due, or late: nothing is claimed until the foot has landed.
            # Where the reference of a late impact ends, the plan does, too.
            return math.inf if nodes.next.item(node) < 0 else math.nan
        # At a root time stands still, whatever the clock says.
        elapsed = 0.0 if tracker.done else tracker.elapsed
        return max(nodes.cost_to_go(node, elapsed, x[: nodes.x0.shape[1]]), 0.0) / rho

    def _nearer(self, node: int) -> bool:
        assert self._ready is not None
        return bool(self._ready.tree.nodes.to_go[node] <= self.to_go)

    def _search_anew(self) -> None:
        """Whatever previews have said is about another state by now."""
        self._previewed_ns, self._verdict, self._untried = None, NOWHERE, NONE

    def _rest(self, mode: str) -> None:
        """No torque from now on."""
        self.balance.stop()
        self.mode, self.depth, self._torque = mode, math.inf, 0.0
        self.node = self.entered = -1
