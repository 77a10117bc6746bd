"""The tree of a robot that walks: orbits, and the motions that lead to them and away.

Its homes are upright, on each leg, and the orbits, one for each speed. Between them lead motions
that are planned as any branch of a tree: steps in from upright and stops, of every orbit, and
changes of speed between neighbours. A motion ends anywhere on the phase of an orbit that it joins,
or upright; its gains and its cost to go are continued from there. On such a tree more motions can
be grown: a push is answered by a way back to an orbit, or to upright, in as many steps as it takes
(growth.py).
"""

import contextlib
import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cg_control.following.nodes import Nodes
from cg_control.following.tracking import WALKING
from cg_control.orbits.orbit import Orbit
from cg_control.orbits.transverse import stabilise_over_phase
from cg_control.trajectories.collocation import Options, PlanningError, optimise
from cg_control.trajectories.task import UPRIGHT, Box, Goal, Task
from cg_control.trajectories.trajectory import TrajectoryError
from cg_control.trajectories.tvlqr import Weights
from cg_control.trees.extension import Attempt, ExtensionOptions, branch_of
from cg_control.trees.growth import Branch
from cg_control.trees.preview import LANDING
from cg_control.trees.rollouts import follow
from cg_control.trees.routes import UPRIGHT as STANDING
from cg_control.trees.tree import Tree
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_dynamics.walking.hybrid import WalkOptions

log = logging.getLogger(__name__)

# s by which a state in a tube may be off the surface of its phase: more than half of what lies
# between two knots, so that tubes hold all of the orbit, and less than what leaves the orbit.
LAG = 0.05


@dataclass(frozen=True)
class TubeOptions:
    """How the tube of an orbit is found by simulation.

    Attributes:
        samples: Robots that begin on the surfaces around the orbit.
        costs: Least and largest cost to go at which they begin.
        steps: That a robot has to walk on.
        tolerated: Share of failures that a tube may hold.
        seed: Of the samples.
    """

    samples: int = 4096
    costs: tuple[float, float] = (1e-3, 1e2)
    steps: int = 12
    tolerated: float = 0.01
    seed: int = 0


def orbit_nodes(
    model: Model,
    orbit: Orbit,
    weights: Weights | None = None,
    tube: TubeOptions | None = None,
    simulation: WalkOptions = LANDING,
) -> Nodes:
    """An orbit with gains over phase, and the tube in which it was seen to hold the robot.

    Args:
        model: The robot.
        orbit: Planned for it.
        weights: Of deviations.
        tube: How its tube is found.
        simulation: Of the robots that find it.

    Raises:
        TrajectoryError: The orbit holds hardly a robot.
    """
    motion = stabilise_over_phase(orbit.trajectory, model, weights)
    nodes = Nodes.orbit(motion, model)
    level = tube_level(nodes, model, tube or TubeOptions(), simulation)
    # (TUBE) of walking.md: the cost to go says nothing about states ahead on the tangent.
    return Nodes.orbit(motion, model, [
        phase.cost_to_go / level + np.einsum('ni,nj->nij', phase.normals, phase.normals) / LAG**2
        for phase in motion.phases
    ])  # fmt: skip


def tube_level(
    nodes: Nodes, model: Model, options: TubeOptions, simulation: WalkOptions = LANDING
) -> float:
    """The cost to go below which robots around an orbit walk on.

    Args:
        nodes: One orbit.
        model: The robot.
        options: How many are tried, and how deep.
        simulation: Of the robots.

    Raises:
        TrajectoryError: Failures begin at the least cost that is tried.
    """
    rng = np.random.default_rng(options.seed)
    on = np.flatnonzero(nodes.orbiting & ~nodes.impact)
    node = rng.choice(on, options.samples)
    low, high = np.log(options.costs)
    cost = np.exp(np.sort(rng.uniform(low, high, len(node))))
    x = nodes.x0[node] + np.sqrt(cost)[:, None] * across(nodes, node, rng)
    # Where the swing foot would be ahead and in the ground it has landed before.
    above = ~buried(x, nodes.stance[node], simulation.slope)
    node, cost, x = node[above], cost[above], x[above]
    done = follow(
        nodes, model, node, x, 0.75 * nodes.span[on].sum() * options.steps, settings=WALKING,
        options=simulation,
    )  # fmt: skip
    failed = np.cumsum(done.impacts < options.steps)
    holds = failed <= options.tolerated * np.arange(1, len(failed) + 1)
    level = float(cost[np.flatnonzero(holds)[-1]]) if holds.any() else 0.0
    if level < 10 * options.costs[0]:
        raise TrajectoryError(
            f'an orbit holds robots up to a cost of {level:.3g} only: its tube is next to nothing'
        )
    return level


def buried(x: np.ndarray, leg: np.ndarray, slope: float = 0.0) -> np.ndarray:
    """Whether the swing foot is ahead of the stance foot and in the ground, shape (n,).

    Args:
        x: States, shape (n, 4).
        leg: Stance legs, index into STANCES, shape (n,).
        slope: Fall of the ground ahead, rad.
    """
    rows = np.arange(len(x))
    standing, swinging = x[rows, leg], x[rows, 1 - leg]
    return (standing > swinging) & (standing + swinging > 2 * slope)


def across(nodes: Nodes, node: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Deviations of cost one on the surfaces of nodes, of random direction: (m, 4)."""
    # What a deviation costs apart from how far it is along the flow: (TUBE) counts that, too.
    project = np.eye(4) - np.einsum('ni,nj->nij', nodes.rates[node], nodes.surfaces[node, 0])
    form = project.transpose(0, 2, 1) @ nodes.F[node] @ project
    values, vectors = np.linalg.eigh(form)
    # Slow orbits amplify so much that rounding makes the least of the three negative.
    values = np.maximum(values, 1e-9 * values[:, -1:])
    # S costs nothing along the flow: three directions are left.
    g = rng.standard_normal((len(node), 3))
    g /= np.linalg.norm(g, axis=1)[:, None]
    away = np.einsum('nij,nj->ni', vectors[:, :, 1:], g / np.sqrt(values[:, 1:]))
    along = np.einsum('ni,ni->n', nodes.surfaces[node, 0], away)
    return away - along[:, None] * nodes.rates[node]


def with_orbits(tree: Tree, orbits: Sequence[Nodes], speeds: Sequence[float]) -> Tree:
    """A tree with more homes.

    Args:
        tree: Of the same model.
        orbits: One tree each (`orbit_nodes`).
        speeds: Theirs, m/s.
    """
    nodes = tree.nodes
    for orbit in orbits:
        nodes = nodes.joined(orbit)
    return replace(tree, nodes=nodes, speeds=np.append(tree.speeds, speeds))


def with_ways(
    tree: Tree, model: Model, options: ExtensionOptions | None = None, most: int = 2
) -> Tree:
    """A tree with motions from home to home: steps in, stops, changes to the next speed.

    What is not found is left out, and logged: then the way leads over a neighbour.

    Args:
        tree: With orbits, slowest first.
        model: The robot.
        options: Of the planner.
        most: Impacts of a motion at most.

    Raises:
        TrajectoryError: No motion leads from upright to an orbit, or back.
    """
    options = options or ExtensionOptions()
    nodes, count = tree.nodes, int(tree.nodes.orbit_of.max()) + 1
    wanted: list[tuple[int, int]] = []  # (node to leave from, home to go to)
    roots = np.flatnonzero(nodes.planned < 0)
    for orbit in range(count):
        wanted += [(int(root), orbit) for root in roots]
        neighbours = [onto for onto in (orbit - 1, orbit + 1) if 0 <= onto < count]
        for onto in (STANDING, *neighbours):
            wanted += [(int(node), onto) for node in nodes.phase_starts(orbit)]
    ways = 0
    for node, onto in wanted:
        branch = planned(nodes, node, onto, model, options, most)
        what = f'{STANCES[nodes.stance[node]]} leg, node {node} to home {onto}'
        if branch is None:
            log.warning('no way: %s', what)
            continue
        nodes = nodes.grafted(
            branch.trajectory, model, branch.onto, branch.elapsed, funnels=branch.funnels
        )
        ways += 1
    if not ways:
        raise TrajectoryError('no motion leads from any home of the tree to another')
    return replace(tree, nodes=nodes)


def planned(
    nodes: Nodes, node: int, onto: int, model: Model, options: ExtensionOptions, most: int
) -> Branch | None:
    """The motion with the fewest steps from a node to a home; None if none is found.

    Args:
        nodes: The tree.
        node: Where it begins.
        onto: Number of the orbit on which it ends, or UPRIGHT of routes.py.
        model: The robot.
        options: Of the planner.
        most: Impacts at most.
    """
    start, leg = Box.point(nodes.x0[node]), int(nodes.stance[node])
    for modes, ends, goal in _ends(nodes, leg, onto, most):
        attempt = Attempt.on(nodes, ends, Task(modes, start, goal, reach=options.reach))
        with contextlib.suppress(PlanningError, TrajectoryError):
            motion = optimise(model, attempt.task, Options(fine=options.fine), options.friction)
            return branch_of(motion, attempt, model, options)
    return None


def _ends(
    nodes: Nodes, leg: int, onto: int, most: int
) -> Iterable[tuple[tuple[str, ...], np.ndarray, Goal]]:
    """Stance legs, nodes and goal of the motions to a home, fewest impacts first."""
    for impacts in range(most + 1):
        modes = tuple(STANCES[(leg + k) % 2] for k in range(impacts + 1))
        last = STANCES.index(modes[-1])
        if onto == STANDING:
            roots = np.flatnonzero((nodes.planned < 0) & (nodes.stance == last))
            if len(roots):
                yield modes, roots[:1], UPRIGHT
        elif impacts:
            first = [n for n in nodes.phase_starts(onto) if nodes.stance[n] == last]
            for node in first:
                goal = nodes.stretch(int(node))
                yield modes, np.asarray(goal.node), goal
