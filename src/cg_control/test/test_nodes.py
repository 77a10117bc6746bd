"""Trees in flat arrays: what is between nodes, where they lead, what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from cg_control.following.nodes import ARRAYS, LATE, Nodes
from cg_control.trajectories.trajectory import Trajectory, TrajectoryError
from cg_dynamics.rig import STANCES


@pytest.fixture(scope='module')
def tree(robot, step, back) -> Nodes:
    """Inner -> outer, and outer -> inner grafted on its start: two steps to the outer leg."""
    forth = Nodes.of(step, robot)
    return forth.grafted(back, robot, forth.first)


def along(nodes, node, elapsed):
    """(u0, x0, K, S) at a point of the tree."""
    u0, x0, K = np.split(elapsed ** np.arange(4.0) @ nodes.edges[node], [1, 5])
    return u0[0], x0, K, nodes.costs[node, 0] + elapsed * nodes.costs[node, 1]


def test_between_nodes_it_is_the_trajectory(robot, step):
    nodes = Nodes.of(step, robot)
    for phase in step.phases:
        for s in np.random.default_rng(1).uniform(phase.start, phase.end, 20):
            point = step.at(s)
            found = along(nodes, *nodes.locate(s))
            expected = (point.torque, point.state, point.gain, point.cost_to_go)
            for a, b in zip(found, expected, strict=True):
                # Rounding of two forms of one cubic.
                np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-11)
            e = np.array([0.01, -0.02, 0.03, 0.05])
            cost = nodes.cost_to_go(*nodes.locate(s), point.state + e)
            assert cost == pytest.approx(e @ point.cost_to_go @ e, rel=1e-9)


def test_every_node_knows_where_its_landing_leads(tree, step, back):
    assert not (tree.stance[tree.next[tree.next >= 0]] != tree.stance[tree.next >= 0]).any()
    landing = tree.landing >= 0
    assert (tree.stance[tree.landing[landing]] != tree.stance[landing]).all()
    # The root and the last phase of `step` have none ahead.
    assert (~landing).sum() == 1 + len(step.phases[1].time)
    first = tree.first
    assert STANCES[tree.stance[first]] == 'outer'
    np.testing.assert_array_equal(tree.x0[first], back.states[0])
    np.testing.assert_array_equal(tree.x0[tree.landing[first]], back.phases[1].states[0])
    assert tree.impact.sum() == 2


def test_time_and_steps_to_go_add_up(tree, step, back):
    first = tree.first
    assert tree.to_go[0] == tree.steps[0] == 0
    assert tree.to_go[first] == pytest.approx(back.duration + step.duration, abs=1e-12)
    assert tree.steps[first] == 2
    assert tree.steps[tree.landing[first]] == 1
    assert np.isfinite(tree.to_go).all()
    node, seen = first, [first]
    while tree.planned[node] >= 0:
        node = int(tree.planned[node])
        seen.append(node)
    assert node == 0
    assert (np.diff(tree.to_go[seen]) <= 1e-12).all()  # rounding of sums of seconds
    assert len(seen) == len(step.time) + len(back.time) + 1


def test_a_way_that_leads_round_is_an_orbit(tree):
    landing = tree.landing.copy()
    landing[tree.impact] = tree.first, tree.first
    round_ = replace(tree, landing=landing)
    assert round_.orbiting[tree.first]
    assert round_.to_go[tree.first] == 0.0
    assert not round_.orbiting[round_.late].any()


def test_at_and_beyond_an_impact_nothing_is_claimed(tree, step):
    assert tree.late.sum() == pytest.approx(2 * LATE / 0.01, abs=2)
    nothing = tree.late | tree.impact
    assert (tree.rho[nothing] == 0).all()
    assert np.isinf(tree.rho[~nothing]).all()
    end = tree.next[np.flatnonzero(tree.impact)[0]]
    assert tree.late[end]
    # The model under its last torque: the cubic between two knots of it has its rates.
    np.testing.assert_allclose(
        (tree.x0[end + 1] - tree.x0[end]) / 0.01, (tree.rates[end] + tree.rates[end + 1]) / 2,
        atol=1e-2,
    )  # fmt: skip


def test_a_graft_keeps_the_nodes_that_were_there(robot, step, back):
    forth = Nodes.of(step, robot)
    tree = forth.grafted(back, robot, forth.first)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(tree, name)[: len(forth)], getattr(forth, name))


def test_a_graft_between_two_nodes_is_a_point_of_the_way(robot, step, back):
    forth = Nodes.of(step, robot)
    onto = forth.first + 3
    elapsed = 0.3 * forth.span[onto]
    tree = forth.grafted(back, robot, onto, elapsed)
    new = len(forth)
    last = tree.first + len(tree) - new - 2
    assert (tree.next[last], tree.span[last]) == (new, 0.0)
    assert tree.to_go[new] == pytest.approx(forth.to_go[onto] - elapsed, abs=1e-12)
    for more in (0.0, 0.5, 0.9):
        later = more * tree.span[new]
        found = along(tree, new, later)
        for a, b in zip(found, along(forth, onto, elapsed + later), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-10, atol=1e-10)
    # All of the span leads to the next node itself.
    whole = forth.grafted(back, robot, onto, float(forth.span[onto]))
    assert whole.to_go[whole.first] == pytest.approx(back.duration + forth.to_go[onto + 1])


def test_joined_trees_are_both_trees(tree, robot, back):
    other = Nodes.of(back, robot)
    both = tree.joined(other)
    n = len(tree)
    np.testing.assert_array_equal(both.to_go, np.concatenate([tree.to_go, other.to_go]))
    assert both.first == n + other.first
    assert both.landing[both.first] == n + other.landing[other.first]
    assert set(both.branch) == {0, 1, 2, 3}


def test_what_does_not_fit_is_refused(robot, step, back):
    forth = Nodes.of(step, robot)
    with pytest.raises(TrajectoryError, match='plan it again'):
        forth.grafted(replace(step, model_hash='f' * 64), robot, 0)
    with pytest.raises(TrajectoryError, match='ends on the inner leg, node 0 stands on the outer'):
        forth.grafted(back, robot, 0)
    with pytest.raises(TrajectoryError, match='nodes 0 to'):
        forth.grafted(back, robot, len(forth))
    with pytest.raises(TrajectoryError, match='spans 0 to'):
        forth.grafted(back, robot, forth.first, 9.0)
    impact = int(np.flatnonzero(forth.impact)[0])
    with pytest.raises(TrajectoryError, match='late impact'):
        forth.grafted(back, robot, impact, 0.001)
    other_way = Trajectory(back.phases, back.model_hash, {'friction': 'to be compensated'})
    with pytest.raises(TrajectoryError, match='compensated in the other'):
        forth.grafted(other_way, robot, forth.first)
    with pytest.raises(ValueError, match='the trajectory goes from'):
        forth.locate(step.duration + 1.0)
    with pytest.raises(ValueError, match='cost_to_go has shape'):
        Nodes.root('inner', np.zeros(4), np.eye(3), robot.hash)


@pytest.mark.parametrize(
    ('name', 'node', 'value', 'message'),
    [
        ('stance', 5, 2, 'node 5: stance must be 0 to 1'),
        ('next', 5, 10_000, 'node 5: next must be -1 to'),
        ('next', 5, -1, 'node 5: span must be infinite where next is -1'),
        ('next', 5, 0, 'node 5: next must be on the same leg'),
        ('landing', 5, -2, 'node 5: landing must be -1 to'),
        ('landing', 5, 6, 'node 5: landing must be on the other leg'),
        ('span', 5, -0.1, 'node 5: span must be infinite where'),
        ('span', 5, 0.0, 'node 5: a link must lead to an older branch'),
        ('rho', 5, -1.0, 'node 5: rho must not be negative'),
        ('u0', 5, np.nan, 'u0 must be finite numbers'),
        ('K', 5, np.inf, 'K must be finite numbers'),
    ],
)
def test_arrays_that_are_no_tree_are_refused(tree, name, node, value, message):
    tree.require_consistency()
    array = getattr(tree, name).copy()
    array[node] = value
    with pytest.raises(TrajectoryError, match=message):
        replace(tree, **{name: array}).require_consistency()
    with pytest.raises(TrajectoryError, match='has shape'):
        replace(tree, **{name: array[:-1]}).require_consistency()


def test_a_pruned_tree_keeps_what_a_branch_ends_on(robot, step, back):
    forth = Nodes.of(step, robot)
    there = forth.grafted(back, robot, forth.first)  # ends on the first one
    both = there.grafted(step, robot, 0)
    whole, place = both.pruned(np.array([2]))
    assert sorted(np.unique(whole.branch)) == [0, 1, 2]
    whole.require_consistency()
    kept = np.flatnonzero(place >= 0)
    np.testing.assert_array_equal(whole.x0, both.x0[kept])
    np.testing.assert_array_equal(whole.to_go, both.to_go[kept])
    np.testing.assert_array_equal(whole.landing >= 0, both.landing[kept] >= 0)
    alone, _ = both.pruned(np.array([3]))
    assert sorted(np.unique(alone.branch)) == [0, 3]
    assert (alone.branches, whole.branches, both.branches) == (1, 2, 3)
    np.testing.assert_array_equal(alone.to_go[1:], both.to_go[both.branch == 3])
