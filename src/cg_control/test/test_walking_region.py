"""States of robots that are pushed while they walk, and a tree that grows from them."""

from dataclasses import replace

import numpy as np
import pytest

from cg_control import grow_tree
from cg_control.following.nodes import Way
from cg_control.following.tracking import WALKING
from cg_control.trees.extension import Extension, ExtensionOptions, nearest_orbits
from cg_control.trees.growth import Branch
from cg_control.trees.preview import Preview, pruned
from cg_control.trees.routes import Routes
from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import tree_path
from cg_control.walking.walking_region import OrbitPoints, WalkingRegion
from cg_control.walking.walking_tree import buried
from cg_dynamics.rollout.compiler import compiler

needs_compiler = pytest.mark.skipif(compiler() is None, reason='thousands of rollouts')
AROUND = np.array(grow_tree.AROUND)


@pytest.fixture(scope='module')
def tree(robot) -> Tree:
    """That comes along, without what brings pushed robots back: homes and ways between them."""
    tree = Tree.load(tree_path('compass_gait_mit_walk'), robot)
    return pruned(replace(tree, champions=np.full((2, 0), -1)))


@pytest.fixture(scope='module')
def region(tree):
    return WalkingRegion(np.array(grow_tree.BOX), orbits=OrbitPoints(tree.nodes), around=AROUND)


@pytest.fixture(scope='module')
def states(region):
    return region.draw_walking(np.random.default_rng(3), 200)


def to_orbit(tree, robot, leg, x):
    """The pushed robots that a preview brings back to an orbit."""
    found = Preview(tree, robot, WALKING).choose(leg, x, walking=True)
    return (found >= 0) & (tree.nodes.ways[found] != Way.UPRIGHT)


def test_states_lie_around_the_orbits_and_none_is_in_the_ground(region, tree):
    leg, x = region.draw(np.random.default_rng(0), 400)
    walking = region.walking(400)
    assert walking.sum() == 300
    assert not buried(x[walking], leg[walking]).any()
    nodes = tree.nodes
    on = np.flatnonzero(nodes.orbiting)
    for stance, state in zip(leg[walking], x[walking], strict=True):
        there = on[nodes.stance[on] == stance]
        away = np.abs(nodes.x0[there] - state)[:, [stance, 2 + stance]]
        # Lean and its rate; a knot is near every point: an orbit has 50 of them.
        assert (away <= AROUND[[0, 2]] + [0.03, 0.3]).all(axis=1).any()


def test_the_region_of_another_tree_is_told_apart(tree, region):
    other = replace(tree.nodes, span=tree.nodes.span * 1.01)
    assert repr(OrbitPoints(other)) != repr(region.orbits) == repr(OrbitPoints(tree.nodes))
    with pytest.raises(ValueError, match='no orbit'):
        OrbitPoints(tree.nodes.pruned(np.empty(0, int))[0]._rows(tree.nodes.root_of))


def test_tubes_hold_the_orbit_and_not_its_tangents(tree):
    nodes = tree.nodes
    moving = nodes.orbiting & ~nodes.impact & nodes.normal.any(axis=1)
    for node in np.flatnonzero(moving):
        x0, along = nodes.x0[node], nodes.rates[node]
        for lag in (-0.1, 0.1):
            assert nodes.cost_to_go(node, 0.0, x0 + lag * along) > 3.0
        # Half way to the next knot some knot claims the robot.
        half = nodes.span[node] / 2
        x = half ** np.arange(4.0) @ nodes.edges[node][:, 1:5]
        assert min(nodes.cost_to_go(n, 0.0, x) for n in (node, nodes.next[node])) < 0.8


@needs_compiler
def test_who_walks_tries_what_leads_to_an_orbit_first(tree, robot, states):
    leg, x = states
    preview, ways = Preview(tree, robot, WALKING), tree.nodes.ways
    tried = preview.candidates(leg, x, walking=True)
    for row in tried:
        upright = ways[row[row >= 0]] == Way.UPRIGHT
        assert (np.diff(upright.astype(int)) >= 0).all()
        assert (tree.nodes.orbiting[row[: preview.nearest]]).all()
    assert set(preview.candidates(leg, x)[0]) <= set(tried[0])


def test_the_nearest_orbit_is_the_one_that_the_state_is_on(tree):
    nodes = tree.nodes
    for node in np.flatnonzero(nodes.orbiting & ~nodes.impact)[::17]:
        (near, *_) = nearest_orbits(nodes, int(nodes.stance[node]), nodes.x0[node])
        assert near == nodes.orbit_of[node]


@needs_compiler
def test_plans_end_on_orbits_where_no_way_of_the_tree_does(tree, robot, states):
    leg, x = states
    lost = np.flatnonzero(~to_orbit(tree, robot, leg, x))[:8]
    assert len(lost) == 8
    branches = Extension(robot, options=ExtensionOptions(orbits=2))(tree.nodes, leg[lost], x[lost])
    found = [b for b in branches if isinstance(b, Branch)]
    onto = [b for b in found if tree.nodes.orbiting[b.onto]]
    assert len(onto) >= 2
    for branch in onto:
        grown = tree.nodes.grafted(
            branch.trajectory, robot, branch.onto, branch.elapsed, funnels=branch.funnels
        )
        assert grown.ways[grown.first] == Way.TO_ORBIT


@needs_compiler
@pytest.mark.slow
def test_a_tree_grows_onto_its_orbits_and_brings_more_robots_back(
    tree, robot, states, tmp_path, capsys, monkeypatch
):
    monkeypatch.setattr(grow_tree, 'GROWTH', replace(grow_tree.GROWTH, round_size=192, probes=4))
    monkeypatch.setattr(grow_tree, 'SAMPLE', 300)
    base, path = tmp_path / 'walk.npz', tmp_path / 'grown.npz'
    tree.save(base)
    given = ['--onto', str(base), '--samples', '192', '--workers', '1', '--branches', '12']
    assert grow_tree.main([*given, '--out', str(path)]) == 0
    assert f'grow_tree: {path}: ' in capsys.readouterr().out
    grown = Tree.load(path, robot)
    assert grown.provenance['command'].startswith('grow_tree --onto TREE --samples 192')
    # The ways from home to home are all there.
    before, after = (Routes.of(t.nodes, t.speeds).departures for t in (tree, grown))
    assert [(d.home, d.onto) for d in after] == [(d.home, d.onto) for d in before]
    # Orbits keep their tubes.
    assert (grown.nodes.rho[grown.nodes.orbiting & ~grown.nodes.impact] == 1.0).all()
    # On states that it has not seen.
    assert to_orbit(grown, robot, *states).sum() > to_orbit(tree, robot, *states).sum() + 5
