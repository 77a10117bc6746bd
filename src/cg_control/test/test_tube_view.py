"""What is drawn of tubes and surfaces, against kinematics and sampled states."""

from dataclasses import replace

import numpy as np
import pytest

from cg_control.trees import tube_view
from cg_control.trees.routes import UPRIGHT, Routes
from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import tree_path
from cg_control.trees.tube_view import CORNERS, MOST_KNOTS, POSES, surface_segments, tube_segments
from cg_control.trees.way_home import WayHome
from cg_dynamics.rig import STANCES
from cg_dynamics.walking.hybrid import swing_foot

LENGTH = 1.1  # m


@pytest.fixture(scope='module')
def tree(robot) -> Tree:
    return Tree.load(tree_path('compass_gait_mit_walk'), robot)


@pytest.fixture(scope='module')
def way(tree) -> WayHome:
    """From upright onto an orbit, and once round it."""
    routes = Routes.of(tree.nodes, tree.speeds)
    return WayHome.along(tree.nodes, routes.towards(UPRIGHT, 1)[0])


def test_in_a_small_tube_the_foot_stays_in_the_ellipse_and_comes_to_its_rim(tree, way):
    """Exact kinematics at states of the rim; small, as the drawing is of first order."""
    small = replace(tree.nodes, F=1e6 * tree.nodes.F)
    found = tube_segments(small, way, LENGTH)
    on = np.flatnonzero(small.orbiting[way.nodes] & ~small.impact[way.nodes])
    assert len(on) <= MOST_KNOTS
    rims = found['tube_foot'].reshape(len(on), CORNERS, 2, 2)[:, :, 0]
    feet = way.feet(LENGTH)
    rng = np.random.default_rng(0)
    for k in (0, len(on) // 3, len(on) - 1):
        row, rim = on[k], rims[k]
        node, leg = way.nodes[row], int(way.stance[row])
        values, vectors = np.linalg.eigh(small.F[node])
        values = np.maximum(values, 1e-9 * values[-1])
        d = rng.standard_normal((4000, 4))
        d /= np.linalg.norm(d, axis=1)[:, None]
        states = way.states[row] + (d / np.sqrt(values)) @ vectors.T
        places = np.array([swing_foot(x[:2], STANCES[leg], LENGTH) for x in states])
        places[:, 0] += feet[row]
        middle = rim.mean(axis=0)
        form = np.linalg.pinv(np.cov((rim - middle).T, bias=True) * 2, rcond=1e-6)
        depth = np.einsum('ni,ij,nj->n', places - middle, form, places - middle)
        # Second order of some milliradians, beside a rim of some millimetres.
        assert depth.max() < 1.1
        assert depth.max() > 0.8
        hip = found['tube_hip'][k]
        leans = states[:, leg] - way.states[row, leg]
        # To where sampling finds it, and not beyond.
        half = np.linalg.norm(hip[1] - hip[0]) / 2
        assert 0.9 * half < LENGTH * np.abs(leans).max() < 1.01 * half


def test_a_tube_is_bounded_however_long_and_wide(tree, way, monkeypatch):
    monkeypatch.setattr(tube_view, 'MOST_KNOTS', 7)
    flat = replace(tree.nodes, F=1e-9 * tree.nodes.F)
    found = tube_segments(flat, way, LENGTH)
    assert found['tube_hip'].shape == (7, 2, 2)
    assert found['tube_foot'].shape == (7 * CORNERS, 2, 2)
    widths = np.linalg.norm(np.diff(found['tube_hip'], axis=1), axis=-1)
    assert widths.max() <= 2 * tube_view.LARGEST * (1 + 1e-9)


def test_a_way_to_upright_has_no_tube(tree):
    routes = Routes.of(tree.nodes, tree.speeds)
    stop = next(iter(routes.towards(1, UPRIGHT).values()))
    found = tube_segments(tree.nodes, WayHome.along(tree.nodes, stop), LENGTH)
    assert all(len(segments) == 0 for segments in found.values())


def test_poses_of_a_surface_are_on_it_and_end_at_the_tube(tree, way):
    nodes = tree.nodes
    feet = way.feet(LENGTH)
    for row in np.flatnonzero(nodes.orbiting[way.nodes] & ~nodes.impact[way.nodes])[::9]:
        node, leg = int(way.nodes[row]), int(way.stance[row])
        found = surface_segments(nodes, way, node, LENGTH)
        assert found.shape == (4 + 2 * (POSES - 1), 2, 2)
        costs = []
        for stands, hip in found[[0, 2]]:
            np.testing.assert_allclose(stands, [feet[row], 0.0], atol=1e-12)
            swing = found[1 if np.array_equal(hip, found[0, 1]) else 3, 1]
            # The angles that put hip and foot there.
            q = np.empty(2)
            q[leg] = np.arcsin((hip - stands)[0] / LENGTH)
            q[1 - leg] = np.arcsin((hip - swing)[0] / LENGTH)
            d = np.append(q - way.states[row, :2], [0.0, 0.0])
            assert nodes.normal[node] @ d == pytest.approx(0.0, abs=1e-9)
            costs.append(d @ nodes.F[node] @ d)
        # A tube wider than what is drawn ends where the drawing does.
        assert max(costs) <= 1.0 + 1e-6
        if np.abs(d).max() < tube_view.LARGEST * (1 - 1e-6):
            np.testing.assert_allclose(costs, 1.0, rtol=1e-6)


def test_off_the_way_there_is_no_surface(tree, way):
    gone = np.setdiff1d(np.arange(len(tree.nodes)), way.nodes)
    for node in (-1, int(gone[0]), 10**7):
        assert len(surface_segments(tree.nodes, way, node, LENGTH)) == 0
