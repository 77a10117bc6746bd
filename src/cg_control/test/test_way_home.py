"""The way home to look at: where it goes, and that feet stand where they stand."""

import numpy as np
import pytest

from cg_control.following.nodes import Nodes
from cg_control.trees.way_home import WayHome


@pytest.fixture(scope='module')
def nodes(robot, step, back) -> Nodes:
    """A step, and a step back onto its start."""
    forth = Nodes.of(step, robot)
    return forth.grafted(back, robot, forth.first)


def test_it_is_the_plan_from_there_to_the_root(nodes, step, back):
    way = WayHome.along(nodes, nodes.first)
    assert len(way.nodes) == len(back.time) + len(step.time) - 1  # two motions less links + root
    assert way.time[-1] == pytest.approx(float(nodes.to_go[nodes.first]))
    assert nodes.planned[way.nodes[-1]] < 0
    assert (np.diff(way.time) >= 0).all()
    np.testing.assert_array_equal(way.states[: len(back.time) - 1], back.states[:-1])
    assert np.flatnonzero(np.diff(way.stance)).size == 2
    with pytest.raises(ValueError, match='there are nodes 0 to'):
        WayHome.along(nodes, len(nodes))


def test_from_a_root_there_is_no_way_to_go(nodes):
    way = WayHome.along(nodes, 0)
    assert (len(way.nodes), way.time.tolist()) == (1, [0.0])


def test_feet_stand_and_hips_go_on(nodes, robot):
    length = robot.values['leg_length']
    way = WayHome.along(nodes, nodes.first)
    points = way.points(length, foot=2.0)
    feet = np.stack([points['inner_foot'], points['outer_foot']], axis=1)
    standing = feet[np.arange(len(feet)), way.stance]
    assert np.abs(standing[:, 1]).max() == 0.0
    places = np.unique(standing[:, 0].round(6))
    assert places[0] == 2.0
    # Each step is 0.2 m or more, and nothing moves a foot between two steps.
    assert len(places) == 3
    assert (np.diff(places) > 0.19).all()
    for leg, name in enumerate(('inner_foot', 'outer_foot')):
        reach = np.linalg.norm(points['hip'] - points[name], axis=1)
        np.testing.assert_allclose(reach, length, rtol=1e-12)
        q = np.arctan2(*(points['hip'] - points[name]).T)
        np.testing.assert_allclose(q, way.states[:, leg], atol=1e-12)
    # Hip and foot jump nowhere: what lands stands where it landed.
    jumps = np.abs(np.diff(points['hip'], axis=0)).max()
    assert jumps < 0.1
