"""Previewing a tree: what is chosen comes home, on the robot that is known."""

import numpy as np
import pytest

from cg_control.grow_tree import upright_tree
from cg_control.trees.extension import Extension
from cg_control.trees.growth import Grower, GrowthOptions, Region
from cg_control.trees.lookup import Lookup
from cg_control.trees.preview import LANDING, Preview
from cg_control.trees.rollouts import Outcome, follow
from cg_dynamics.rollout.compiler import compiler
from cg_dynamics.walking.hybrid import WalkOptions

pytestmark = pytest.mark.skipif(compiler() is None, reason='thousands of rollouts')

REGION = Region(np.array([0.25, 0.5, 0.8, 2.0]))  # rad and rad/s, in the roles of the legs
FINE = WalkOptions(sample_time=0.002, step=0.0005, minimum_step=0.1)


@pytest.fixture(scope='module')
def tree(robot):
    options = GrowthOptions(seed=4, round_size=64, at_once=8)
    grower = Grower(robot, upright_tree(robot), REGION, Extension(robot), options)
    for _ in range(2):
        grower.round()
    return grower.tree


@pytest.fixture(scope='module')
def states():
    return REGION.draw(np.random.default_rng(12), 800)


def arrives(tree, robot, node, x, options=LANDING, known=None):
    duration = tree.nodes.to_go[node] + 3.0
    done = follow(
        tree.nodes, robot, node, x, duration, goal=tree.goal, options=options, known=known
    )
    return done.outcome == Outcome.ARRIVED


def test_what_is_chosen_comes_home_in_a_finer_simulation(robot, tree, states):
    leg, x = states
    node = Preview(tree, robot).choose(leg, x)
    found = node >= 0
    assert found.mean() > 0.3
    assert (tree.nodes.stance[node[found]] == leg[found]).all()
    assert np.isin(node[found], tree.nodes.entries).all()
    # A state on the edge may turn with the fourth digit of an impact: two in a hundred.
    assert arrives(tree, robot, node[found], x[found], FINE).mean() > 0.98


def test_more_come_home_than_funnels_hold(robot, tree, states):
    leg, x = states
    node, depth = Lookup(tree.nodes).best_of_many(leg, x)
    held = depth <= 1.0
    held[held] = arrives(tree, robot, node[held], x[held])
    previewed = Preview(tree, robot).choose(leg, x) >= 0
    assert previewed.mean() > 1.15 * held.mean()
    assert previewed[held].mean() > 0.95


def test_the_robot_that_is_known_is_the_one_that_is_simulated(robot, tree, states):
    """With 1.2 kg high on the inner legs other entries bring it home, or none does."""
    leg, x = states
    loaded = robot.with_effect('payload', 'inner', mass=1.2, distance=0.9)
    chosen = {
        name: Preview(tree, model).choose(leg, x)
        for name, model in (('nominal', robot), ('loaded', loaded))
    }
    assert (chosen['nominal'] != chosen['loaded']).mean() > 0.02
    share = {}
    for name, known in (('nominal', robot), ('loaded', loaded)):
        found = chosen[name] >= 0
        share[name] = arrives(tree, loaded, chosen[name][found], x[found], known=known).mean()
    assert share['loaded'] == 1.0
    assert share['nominal'] < 0.97


def test_the_least_deep_that_comes_home_is_chosen(robot, tree, states):
    leg, x = states[0][:60], states[1][:60]
    preview = Preview(tree, robot)
    nearest, node = preview.candidates(leg, x), preview.choose(leg, x)
    for row in range(60):
        some = nearest[row][nearest[row] >= 0]
        home = arrives(tree, robot, some, np.repeat(x[row : row + 1], len(some), axis=0))
        assert node[row] == (some[home.argmax()] if home.any() else -1)


def test_a_leg_on_which_nothing_stands(robot):
    preview = Preview(upright_tree(robot, ('inner',)), robot)
    x = np.array([[0.001, 0.002, 0.0, 0.01]] * 2)
    assert (preview.choose(np.array([0, 1]), x) >= 0).tolist() == [True, False]
