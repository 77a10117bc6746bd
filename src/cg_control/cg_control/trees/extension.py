"""Motions from states that nobody claims onto a tree: trees.md, "Extension".

For each state motions are tried in this order, and the first one found is taken:

    onto an orbit    in none, one, ... steps, ending anywhere on the phase of an orbit on the leg
                     that stands then; of the orbits those that pass by the state most closely
    home             in none, one, ... steps, ending upright on a leg that is a goal
    onto the tree    on the leg that stands, ending anywhere on the stretch behind the node at
                     which the state is least deep; whatever steps that branch takes come with it

What the screen of reach.py rules out is not tried. Gains and funnels come from two Riccati
equations with the same dynamics. The gains' weights make the robot follow; the funnels' weights
are `FUNNEL` times as large, so that a deviation costs what it takes to undo it and little for
being there. A limited torque fails where the former is large.
"""

import contextlib
import dataclasses
import functools
import pickle
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field

import numpy as np

from cg_control.balancing.linearise import linearise_stance
from cg_control.balancing.lqr import lqr
from cg_control.following.nodes import Nodes
from cg_control.trajectories.collocation import PlanningError, optimise, planning_model
from cg_control.trajectories.program import Guess
from cg_control.trajectories.reach import Screen, cheap
from cg_control.trajectories.task import UPRIGHT, Box, Goal, Stretch, Task
from cg_control.trajectories.trajectory import Trajectory, TrajectoryError
from cg_control.trajectories.tvlqr import Weights, stabilise
from cg_control.trees.growth import Branch, GivenUp
from cg_control.trees.lookup import Lookup
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_dynamics.watched_processes import WorkLost

FUNNEL = 0.03  # weight of deviations in the form of a funnel, as a share of that of the gains
SOON = Guess(0.15, 0.3)  # what joins the tree nearby takes no longer


def funnel_weights(weights: Weights) -> Weights:
    """The weights of the funnels that belong to weights of the gains."""
    names = ('stance_angle', 'swing_angle', 'stance_rate', 'swing_rate')
    return dataclasses.replace(weights, **{n: FUNNEL * getattr(weights, n) for n in names})


def upright_form(model: Model, stance: str, weights: Weights) -> np.ndarray:
    """Form of the funnel of the upright robot on one leg, shape (4, 4)."""
    linear, light = linearise_stance(model, stance), funnel_weights(weights)
    return lqr(linear.A, linear.B, light.Q(stance), light.R).S


@dataclass(frozen=True)
class Attempt:
    """A motion to try, with what has to be known of the tree where it may end.

    Attributes:
        task: What is asked.
        node: Nodes at which it may end, or after which, shape (m,).
        span: Time to the next node, s, shape (m,).
        S: Cost to go at these nodes and at the next ones, shape (m, 2, 4, 4).
        F: Forms of the funnels likewise.
    """

    task: Task
    node: np.ndarray
    span: np.ndarray
    S: np.ndarray
    F: np.ndarray

    @classmethod
    def on(cls, nodes: Nodes, node: np.ndarray, task: Task) -> 'Attempt':
        """An attempt to end at, or behind, nodes of a tree."""
        then = np.maximum(nodes.next[node], 0)
        S, F = (np.stack([a[node], a[then]], axis=1) for a in (nodes.S, nodes.F))
        return cls(task, node, nodes.span[node], S, F)

    def end(self, onto: int, elapsed: float) -> tuple[np.ndarray, np.ndarray]:
        """S and F at a point of the tree, (4, 4) each."""
        row = int(np.flatnonzero(self.node == onto)[0])
        share = elapsed / self.span[row] if 0 < elapsed < np.inf else 0.0
        return tuple((1 - share) * a[row, 0] + share * a[row, 1] for a in (self.S, self.F))


@dataclass(frozen=True)
class ExtensionOptions:
    """What is tried.

    Attributes:
        steps: Most steps of a motion that goes home.
        reach: Least step length, m.
        fine: Intervals a phase.
        friction: Plan with friction; otherwise the controller gives it back.
        weights: Of the gains.
        near: Depth up to which a motion onto the tree is tried where none goes home; 0: never.
        orbits: How many orbits are tried; 0: none.
        orbit_steps: Most steps of a motion that ends on an orbit.
    """

    steps: int = 1
    reach: float = 0.12
    fine: int = 20
    friction: bool = False
    weights: Weights = field(default_factory=Weights)
    near: float = 0.0
    orbits: int = 0
    orbit_steps: int = 2


class Extension:
    """Plans from states onto a tree. Called with (nodes, legs, states), as `Grower` does.

    Args:
        model: The robot.
        goals: Legs on which upright is home.
        options: What is tried.
        executor: Whose workers plan, such as WatchedProcesses or Cluster; None plans here. Results
            do not depend on it. A state over which it raises WorkLost is given up.
    """

    def __init__(
        self,
        model: Model,
        goals: Sequence[str] = STANCES,
        options: ExtensionOptions | None = None,
        executor: Executor | None = None,
    ):
        self.model, self.goals = model, tuple(goals)
        self.options = options or ExtensionOptions()
        plant = planning_model(model, self.options.friction)
        self._screen = Screen(plant, reach=self.options.reach)
        self._executor = executor
        # Packed once: it goes along with every state.
        self._common = pickle.dumps((model, self.options))

    def promising(self, legs: np.ndarray, x: np.ndarray) -> np.ndarray:
        """Least number of steps of a motion that may exist, (n,); more than allowed: none."""
        return self._least(legs, x)[0]

    def _least(self, legs: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Least number of steps of motions to upright and onto an orbit, (n,) each."""
        most = self.options.steps, self.options.orbit_steps
        home, orbit = (np.full(len(legs), steps + 1) for steps in most)
        for leg, stance in enumerate(STANCES):
            rows = np.flatnonzero(np.asarray(legs) == leg)
            if not len(rows):
                continue
            reach = self._screen.reach(stance, x[rows])
            for least, steps, allows in (
                (home, most[0], reach.allows), (orbit, most[1], reach.allows_orbit),
            ):  # fmt: skip
                for count in range(steps, -1, -1):
                    least[rows[allows(count)]] = count
        return home, orbit

    def __call__(
        self, nodes: Nodes, legs: np.ndarray, x: np.ndarray
    ) -> list[Branch | GivenUp | None]:
        """For each state a branch, None if there is none, or that it was given up."""
        (least, onto), orders = self._least(legs, x), []
        node, depth = Lookup(nodes).best_of_many(np.asarray(legs), x)
        for leg, state, steps, joins, near, deep in zip(
            legs, x, least, onto, node, depth, strict=True
        ):
            order: list[Attempt] = []
            if self.options.orbits:
                order += self._onto_orbits(nodes, int(leg), state, int(joins))
            if steps <= self.options.steps:
                order += self._home(nodes, int(leg), state, int(steps))
                if near >= 0 and deep < self.options.near:
                    order += self._onto(nodes, int(near), int(leg), state)
            orders.append(order)
        if self._executor is None:
            return [first_of(order, self.model, self.options) for order in orders]
        # What the screen rules out needs no worker.
        futures = [
            self._executor.submit(_plan, order, self._common) if order else None
            for order in orders
        ]
        return [None if future is None else _planned(future) for future in futures]

    def _onto(self, nodes: Nodes, node: int, leg: int, x: np.ndarray) -> Iterator[Attempt]:
        with contextlib.suppress(ValueError):  # the robot rests there, or lands
            goal = nodes.stretch(node)
            yield self._attempt(nodes, np.asarray(goal.node), (STANCES[leg],), goal, x)

    def _onto_orbits(self, nodes: Nodes, leg: int, x: np.ndarray, steps: int) -> Iterator[Attempt]:
        near = nearest_orbits(nodes, leg, x)[: self.options.orbits]
        for count in range(steps, self.options.orbit_steps + 1):
            modes = tuple(STANCES[(leg + k) % 2] for k in range(count + 1))
            for orbit in near:
                for start in nodes.phase_starts(int(orbit)):
                    if STANCES[nodes.stance[start]] == modes[-1]:
                        goal = nodes.stretch(int(start))
                        yield self._attempt(nodes, np.asarray(goal.node), modes, goal, x)

    def _home(self, nodes: Nodes, leg: int, x: np.ndarray, steps: int) -> Iterator[Attempt]:
        for count in range(steps, self.options.steps + 1):
            modes = tuple(STANCES[(leg + k) % 2] for k in range(count + 1))
            if modes[-1] in self.goals:
                last = STANCES.index(modes[-1])
                roots = np.flatnonzero((nodes.planned < 0) & (nodes.stance == last))[:1]
                yield self._attempt(nodes, roots, modes, UPRIGHT, x)

    def _attempt(
        self, nodes: Nodes, node: np.ndarray, modes: tuple[str, ...], goal: Goal, x: np.ndarray
    ) -> Attempt:
        task = Task(modes, start=Box.point(x), goal=goal, reach=self.options.reach)
        return Attempt.on(nodes, node, task)


def nearest_orbits(nodes: Nodes, leg: int, x: np.ndarray) -> np.ndarray:
    """Numbers of the orbits, those first in whose tube a state is least deep.

    Args:
        nodes: A tree.
        leg: Leg that stands, index into STANCES.
        x: The state, shape (4,).
    """
    on = np.flatnonzero(nodes.orbiting & ~nodes.impact & (nodes.stance == leg))
    away = x - nodes.x0[on]
    depth = np.full(int(nodes.orbit_of.max()) + 1, np.inf)
    np.minimum.at(depth, nodes.orbit_of[on], np.einsum('ni,nij,nj->n', away, nodes.F[on], away))
    return np.argsort(depth, kind='stable')


def first_of(order: Sequence[Attempt], model: Model, options: ExtensionOptions) -> Branch | None:
    """The first motion that is found, with gains and funnels; None if there is none."""
    for attempt in order:
        how = cheap(len(attempt.task.modes) - 1, options.fine)
        if isinstance(attempt.task.goal, Stretch) and len(attempt.task.modes) == 1:
            how = dataclasses.replace(how, starts=(SOON,))
        with contextlib.suppress(PlanningError, TrajectoryError):
            motion = optimise(model, attempt.task, how, options.friction)
            return branch_of(motion, attempt, model, options)
    return None


def branch_of(
    motion: Trajectory, attempt: Attempt, model: Model, options: ExtensionOptions
) -> Branch:
    """A motion with the gains and the funnels that end in those of the tree.

    Args:
        motion: Found for the attempt.
        attempt: What it was found for.
        model: The robot.
        options: The weights are theirs.
    """
    onto = int(motion.provenance.get('onto', attempt.node[0]))
    elapsed = float(motion.provenance.get('elapsed', 0.0))
    S, F = attempt.end(onto, elapsed)
    light = stabilise(motion, model, funnel_weights(options.weights), F)
    followed = stabilise(motion, model, options.weights, S)
    return Branch(followed, onto, elapsed, tuple(p.cost_to_go for p in light.phases))


def _planned(future: Future) -> Branch | GivenUp | None:
    try:
        return future.result()
    except WorkLost:
        return GivenUp()


def _plan(order: Sequence[Attempt], common: bytes) -> Branch | None:
    """On a worker: as `first_of`."""
    return first_of(order, *_unpacked(common))


@functools.lru_cache(maxsize=1)
def _unpacked(common: bytes) -> tuple[Model, ExtensionOptions]:
    return pickle.loads(common)
