"""Growing a tree by falsification: what it promises of seeds, claims and homes."""

import numpy as np
import pytest

from cg_control.balancing.balance import BalanceSettings, balance_gains
from cg_control.balancing.basin import shipped_basins
from cg_control.following.nodes import ARRAYS, Nodes
from cg_control.trajectories.tvlqr import Weights, balance_regulator
from cg_control.trees.extension import Extension, upright_form
from cg_control.trees.growth import Branch, Grower, GrowthOptions, Region, in_coordinates
from cg_control.trees.lookup import Lookup
from cg_control.trees.rollouts import Outcome
from cg_control.trees.tree import Tree
from cg_dynamics.rig import STANCES
from cg_dynamics.rollout.compiler import compiler
from cg_dynamics.walking.hybrid import WalkOptions

pytestmark = pytest.mark.skipif(compiler() is None, reason='thousands of rollouts')

BOX = np.array([0.25, 0.5, 0.8, 2.0])  # rad and rad/s, in the roles of the legs
REGION = Region(BOX)
OPTIONS = GrowthOptions(seed=3, round_size=64, at_once=8, probes=16)
LANDING = WalkOptions(sample_time=0.002, step=0.002, minimum_step=0.1)


@pytest.fixture(scope='module')
def roots(robot) -> Tree:
    """Upright on either leg, no branch yet."""
    gains = balance_gains(robot, BalanceSettings(), 0.002)
    basins = shipped_basins(robot, gains, robot.torque_limit)
    nodes, goal = None, np.full((2, 4, 4), np.nan)
    for leg, stance in enumerate(STANCES):
        to_modes, bound = basins[stance].modes.to_modes, basins[stance].bounds[-1]
        reach = np.array([bound, bound, 0.3, 0.3])
        goal[leg] = to_modes.T @ np.diag(reach**-2) @ to_modes
        root = Nodes.root(
            stance, gains[stance], balance_regulator(robot, stance).S, robot.hash, True,
            funnel=upright_form(robot, stance, Weights()),
        )  # fmt: skip
        nodes = root if nodes is None else nodes.joined(root)
    return Tree(nodes, goal, {})


def fresh(roots: Tree) -> Tree:
    """The same with funnels of its own: growing writes them."""
    arrays = {name: getattr(roots.nodes, name).copy() for name in ARRAYS}
    nodes = Nodes(**arrays, model_hash=roots.nodes.model_hash, compensate=True)
    return Tree(nodes, roots.goal, {})


@pytest.fixture(scope='module')
def grown(robot, roots) -> Grower:
    grower = Grower(robot, fresh(roots), REGION, Extension(robot), OPTIONS, simulation=LANDING)
    for _ in range(3):
        grower.round()
    return grower


def test_a_seed_says_what_grows(robot, roots, grown):
    again = Grower(
        robot, fresh(roots), REGION, Extension(robot), OPTIONS, simulation=LANDING, threads=2
    )
    for _ in range(3):
        again.round()
    assert vars(again.counts) == vars(grown.counts)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(again.nodes, name), getattr(grown.nodes, name))


def test_every_state_is_covered_or_planned_for(grown):
    counts = grown.counts
    assert counts.samples == 3 * 64
    assert counts.grown > 3
    assert counts.covered + counts.grown <= counts.samples
    assert counts.planned + counts.covered >= counts.samples


def test_what_is_claimed_comes_home(grown):
    """The share of false claims falls with the robots that came by."""
    rng = np.random.default_rng(7)
    for _ in range(4):
        grown.look_up(*REGION.draw(rng, 1000))
    leg, x = REGION.draw(rng, 600)
    node, depth = Lookup(grown.nodes).best_of_many(leg, x)
    claimed = depth <= 1.0
    done = grown.roll_out(node[claimed], x[claimed])
    # A robot that lands where nobody planned it is looked up again, and is not lost yet.
    assert np.isin(done.outcome, (Outcome.ARRIVED, Outcome.LEFT)).mean() > 0.9
    assert claimed.mean() > 0.2


def test_a_motion_that_does_not_bring_its_state_home_is_not_taken(robot, roots, step):
    def wrong(nodes, legs, x):
        onto = int(np.flatnonzero(nodes.stance == 1)[0])
        return [Branch(step, onto)] * len(legs)  # it begins upright, far from these states

    tree = fresh(roots)
    tree.nodes.rho[:] = 0.0
    region = Region(np.array([0.4, 0.5, 1.0, 2.0]))
    tree = Tree(
        Nodes(**{n: getattr(tree.nodes, n) for n in ARRAYS}, model_hash=robot.hash), tree.goal
    )
    grower = Grower(
        robot, tree, region, wrong, GrowthOptions(round_size=4, at_once=4), simulation=LANDING
    )
    counts = grower.round()
    assert (counts.rejected, counts.grown) == (4, 0)
    assert len(grower.nodes) == len(roots.nodes)


def test_the_swing_leg_is_drawn_about_the_stance_leg():
    roles = np.array([[1.0, 0.5, 3.0, 4.0]] * 2)
    states = in_coordinates(np.array([0, 1]), roles)
    assert states.tolist() == [[1.0, 1.5, 3.0, 7.0], [1.5, 1.0, 7.0, 3.0]]
