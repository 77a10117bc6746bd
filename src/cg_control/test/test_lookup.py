"""Lookup of the best funnel: against the quadratic forms themselves."""

import numpy as np
import pytest

from cg_control.following.nodes import Nodes
from cg_control.trees.lookup import Lookup, lifted, monomials


@pytest.fixture(scope='module')
def tree(robot, step, back) -> Nodes:
    """Two steps to the outer leg, with funnels of all sizes."""
    forth = Nodes.of(step, robot)
    nodes = forth.grafted(back, robot, forth.first)
    claimed = nodes.rho > 0
    nodes.rho[claimed] = np.random.default_rng(1).uniform(0.1, 9.0, claimed.sum())
    return nodes


def draw(count, seed=0):
    rng = np.random.default_rng(seed)
    return rng.integers(0, 2, count), rng.uniform(-1, 1, (count, 4)) * [0.3, 0.5, 1.0, 3.0]


def test_lifted_forms_are_the_forms():
    rng = np.random.default_rng(2)
    x0, root = rng.standard_normal((50, 4)), rng.standard_normal((50, 4, 4))
    F, x = root @ root.transpose(0, 2, 1), rng.standard_normal((7, 4))
    e = x[:, None] - x0
    expected = np.einsum('bni,nij,bnj->bn', e, F, e)
    # Rounding of sums of terms of some hundreds.
    np.testing.assert_allclose(monomials(x) @ lifted(x0, F).T, expected, atol=1e-11)


def test_the_best_node_is_the_least_deep_one_on_the_leg(tree):
    lookup = Lookup(tree)
    legs, states = draw(200)
    for leg, x in zip(legs, states, strict=True):
        claims = [
            (tree.cost_to_go(i, 0.0, x) / tree.rho[i], i)
            for i in np.flatnonzero((tree.stance == leg) & (tree.rho > 0) & (tree.span > 0))
        ]
        depth, node = min(claims)
        found = lookup.best(int(leg), x)
        assert found.node == node
        assert found.depth == pytest.approx(depth, rel=1e-9)


def test_many_are_looked_up_as_one_by_one(tree):
    lookup = Lookup(tree)
    legs, states = draw(300, seed=4)
    node, depth = lookup.best_of_many(legs, states)
    one_by_one = [lookup.best(int(leg), x) for leg, x in zip(legs, states, strict=True)]
    assert node.tolist() == [claim.node for claim in one_by_one]
    np.testing.assert_allclose(depth, [claim.depth for claim in one_by_one], rtol=1e-9)


def test_cut_funnels_claim_after_a_refresh(tree):
    lookup, x = Lookup(tree), tree.x0[tree.first]
    leg = int(tree.stance[tree.first])
    assert lookup.best(leg, x).depth == pytest.approx(0.0, abs=1e-9)
    before, tree.rho[:] = tree.rho.copy(), 0.0
    lookup.refresh()
    assert lookup.best(leg, x).node == -1
    tree.rho[:] = before


def test_a_leg_without_nodes_claims_nothing(robot):
    root = Nodes.root('outer', np.ones(4), np.eye(4), robot.hash)
    assert Lookup(root).best(0, np.zeros(4)).node == -1
    assert Lookup(root).best_of_many(np.zeros(2, int), np.zeros((2, 4)))[0].tolist() == [-1, -1]
