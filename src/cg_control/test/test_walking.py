"""Orbits as homes of a tree: tubes, ways from home to home, rollouts that arrive on an orbit."""

from dataclasses import replace

import numpy as np
import pytest

from cg_control.following.nodes import Nodes, Way
from cg_control.following.tracking import WALKING, Tracker
from cg_control.grow_tree import upright_tree
from cg_control.orbits.orbit import plan_orbit
from cg_control.trajectories.trajectory import TrajectoryError
from cg_control.trees import rollouts
from cg_control.trees.preview import LANDING
from cg_control.trees.rollouts import Outcome, follow
from cg_control.trees.routes import UPRIGHT, Departure, Routes
from cg_control.trees.tree import Tree, TreeError
from cg_control.trees.tree_files import tree_path
from cg_control.trees.way_home import WayHome
from cg_control.walking.walking_tree import (
    TubeOptions,
    across,
    buried,
    orbit_nodes,
    tube_level,
    with_orbits,
    with_ways,
)
from cg_dynamics.rig import STANCES
from cg_dynamics.walking.hybrid import swing_foot, walk


@pytest.fixture(scope='module')
def orbit(robot):
    return plan_orbit(robot, 0.25, 0.3)


@pytest.fixture(scope='module')
def nodes(robot, orbit) -> Nodes:
    return orbit_nodes(robot, orbit, tube=TubeOptions(samples=1024))


@pytest.fixture(scope='module')
def shipped(robot) -> Tree:
    return Tree.load(tree_path('compass_gait_mit_walk'), robot)


def test_an_orbit_leads_round_and_is_home(nodes, orbit):
    on = nodes.orbiting
    assert on.sum() == sum(len(phase.time) for phase in orbit.trajectory.phases)
    assert not nodes.late[on].any()
    assert (nodes.to_go[on] == 0).all()
    assert (nodes.ways[on] == Way.ORBIT).all()
    assert (nodes.ways[nodes.late] == Way.TO_ORBIT).all()
    node, seconds = 0, 0.0
    for _ in range(int(on.sum())):
        seconds += 0.0 if nodes.impact[node] else nodes.span[node]
        node = int(nodes.planned[node])
    assert node == 0
    assert seconds == pytest.approx(orbit.period, rel=1e-12)


def test_a_motion_that_is_not_periodic_is_no_orbit(robot, step):
    with pytest.raises(TrajectoryError, match='an orbit needs a periodic motion'):
        Nodes.orbit(step, robot)


def test_the_robot_walks_on_its_orbit(robot, nodes, orbit):
    start = nodes.phase_starts(0)
    done = follow(
        nodes, robot, start, nodes.x0[start], 2.1 * orbit.period, settings=WALKING, options=LANDING
    )
    assert done.impacts.tolist() == [4, 4]
    for node, elapsed, x in zip(done.node, done.elapsed, done.state, strict=True):
        # Torque is held for 2 ms, where the plan's is continuous.
        # The reference is up to a sample off, (0.002 s / 0.05 s)^2 by (TUBE).
        assert nodes.cost_to_go(int(node), float(elapsed), x) < 1e-3 + (0.002 / 0.05) ** 2


def near(nodes, node, cost, seed):
    """States on the surfaces of nodes, this deep, above the ground."""
    rng = np.random.default_rng(seed)
    x = nodes.x0[node] + np.sqrt(cost)[:, None] * across(nodes, node, rng)
    above = ~buried(x, nodes.stance[node])
    return node[above], x[above]


def test_deviations_across_cost_what_they_are_asked_to_and_keep_the_phase(nodes):
    node = np.flatnonzero(nodes.orbiting & ~nodes.impact)
    away = across(nodes, node, np.random.default_rng(3))
    cost = np.einsum('ni,nij,nj->n', away, nodes.F[node], away)
    np.testing.assert_allclose(cost, 1.0, rtol=1e-5)
    along = np.einsum('ni,ni->n', nodes.surfaces[node, 0], away)
    np.testing.assert_allclose(along, 0.0, atol=1e-9)


def test_a_tube_holds_other_robots_than_those_that_found_it(robot, nodes, orbit):
    rng = np.random.default_rng(77)
    node = rng.choice(np.flatnonzero(nodes.orbiting & ~nodes.impact), 1500)
    node, x = near(nodes, node, np.exp(rng.uniform(np.log(1e-3), 0.0, len(node))), 78)
    done = follow(nodes, robot, node, x, 5 * orbit.period, settings=WALKING, options=LANDING)
    # One percent failed of those that found the level; 3 sigma of a binomial of 1000 are one more.
    assert (done.impacts >= 8).mean() > 0.98


def test_outside_the_tube_robots_fall(robot, nodes, orbit):
    """So the level says something."""
    rng = np.random.default_rng(79)
    node = rng.choice(np.flatnonzero(nodes.orbiting & ~nodes.impact), 400)
    node, x = near(nodes, node, np.full(len(node), 1000.0), 80)
    done = follow(nodes, robot, node, x, 5 * orbit.period, settings=WALKING, options=LANDING)
    assert (done.impacts >= 8).mean() < 0.1


def test_an_orbit_without_feedback_has_no_tube(robot, nodes):
    limp = replace(nodes, K=np.zeros_like(nodes.K))
    with pytest.raises(TrajectoryError, match='next to nothing'):
        tube_level(limp, robot, TubeOptions(samples=512))


def test_buried_is_a_swing_foot_ahead_and_below_the_ground():
    rng = np.random.default_rng(4)
    x = rng.uniform(-0.4, 0.4, (200, 4))
    leg = rng.integers(0, 2, 200)
    for slope in (0.0, 0.05):
        found = buried(x, leg, slope)
        for state, number, deep in zip(x, leg, found, strict=True):
            ahead, height = swing_foot(state[:2], STANCES[number], 1.0)
            below = height + ahead * np.tan(slope) < 0
            assert deep == (below and state[number] > state[1 - number])


@pytest.mark.parametrize('compiled', [True, False])
def test_arriving_is_being_in_the_tube_on_the_orbit(robot, shipped, compiled, monkeypatch):
    """In C and one by one: at once inside, after a while outside; upright only on a way there."""
    if not compiled:
        monkeypatch.setattr(rollouts, 'rollout_library', lambda *_: None)
    nodes = shipped.nodes
    orbit = np.flatnonzero(nodes.orbiting & (nodes.orbit_of == 1) & ~nodes.impact)
    inside, x_inside = near(nodes, orbit[[3, 40]], np.full(2, 0.5), 5)
    outside, x_outside = near(nodes, orbit[[3, 40]], np.full(2, 3.0), 5)
    entry = np.array([d.entry for d in Routes.of(nodes, shipped.speeds).departures
                      if d.home == UPRIGHT])  # fmt: skip
    start = np.concatenate([inside, outside, entry])
    x = np.concatenate([x_inside, x_outside, nodes.x0[entry]])
    done = follow(
        nodes, robot, start, x, 5.0, goal=shipped.goal, settings=WALKING, options=LANDING
    )
    assert (done.outcome == Outcome.ARRIVED).all()
    assert (done.time[: len(inside)] == 0.0).all()
    assert (done.time[len(inside) :] > 0.0).all()
    # The step in begins in the goal region of the leg that stands, and does not end there.
    np.testing.assert_array_equal(nodes.orbit_of[done.node[-len(entry) :]], nodes.orbit_of[entry])
    assert (done.impacts[-len(entry) :] >= 1).all()


def test_rollouts_on_an_orbit_are_those_of_walk_and_tracker(robot, nodes, orbit):
    start = nodes.phase_starts(0)
    x = nodes.x0[start] + [[0.004, -0.003, 0.02, 0.03], [-0.002, 0.004, -0.02, 0.02]]
    seconds = 1.2 * orbit.period
    found = follow(nodes, robot, start, x, seconds, settings=WALKING, options=LANDING)
    for row, node in enumerate(start):
        tracker = Tracker(nodes, robot, WALKING, int(node))
        done = walk(
            robot, STANCES[nodes.stance[node]], x[row], seconds,
            lambda t, s, y, tracker=tracker: np.array([tracker.torque(t, s, y)]), LANDING,
        )  # fmt: skip
        assert len(done.impacts) == found.impacts[row] == 2
        # Rounding, multiplied by what two impacts and gains of thousands make of it.
        np.testing.assert_allclose(found.state[row], done.state, rtol=0, atol=1e-6)


def test_ways_lead_from_home_to_home(robot, nodes):
    tree = with_ways(with_orbits(upright_tree(robot), [nodes], [0.25]), robot)
    routes = Routes.of(tree.nodes, tree.speeds)
    assert {(d.home, d.onto) for d in routes.departures} == {(UPRIGHT, 0), (0, UPRIGHT)}
    assert len(routes.departures) == 4  # from either leg
    entry = np.array([d.entry for d in routes.departures])
    done = follow(
        tree.nodes, robot, entry, tree.nodes.x0[entry], tree.nodes.to_go[entry] + 3.0,
        goal=tree.goal, settings=WALKING, options=LANDING,
    )  # fmt: skip
    assert (done.outcome == Outcome.ARRIVED).all()
    found = Tree.of(tree.header(), tree.arrays())
    np.testing.assert_array_equal(found.nodes.orbit_of, tree.nodes.orbit_of)


def test_the_way_home_onto_an_orbit_goes_round_once(shipped):
    nodes = shipped.nodes
    (entry, *_) = [d.entry for d in Routes.of(nodes, shipped.speeds).departures
                   if d.home == UPRIGHT]  # fmt: skip
    way = WayHome.along(nodes, entry)
    round_ = nodes.orbiting & (nodes.orbit_of == nodes.orbit_of[entry])
    assert np.isin(np.flatnonzero(round_), way.nodes).all()
    assert len(np.unique(way.nodes)) == len(way.nodes)
    hip = way.points(1.0)['hip']
    assert (np.diff(hip[:, 0]) > -1e-9).all()  # it never goes back


def test_no_way_is_planned_twice(shipped):
    ways = Routes.of(shipped.nodes, shipped.speeds).departures
    assert len({(d.node, d.onto) for d in ways}) == len(ways)
    # A step in and a stop of each orbit from either leg, and to each neighbour.
    count = len(shipped.speeds)
    assert len(ways) == 4 * count + 4 * (count - 1)


def test_from_every_speed_the_robot_stops_and_to_every_speed_it_steps_in_at_once(robot, shipped):
    nodes = shipped.nodes
    routes = Routes.of(nodes, shipped.speeds)
    entries = []
    for orbit in range(len(shipped.speeds)):
        stops = routes.towards(orbit, UPRIGHT)
        assert sorted(stops) == nodes.phase_starts(orbit).tolist()
        starts = routes.towards(UPRIGHT, orbit)
        assert sorted(starts) == sorted(nodes.root_of)
        assert (nodes.orbit_of[list(stops.values())] == UPRIGHT).all()
        assert (nodes.orbit_of[list(starts.values())] == orbit).all()
        entries += [*stops.values(), *starts.values()]
    assert (nodes.steps[entries] <= 2).all()
    entry = np.array(entries)
    done = follow(
        nodes, robot, entry, nodes.x0[entry], nodes.to_go[entry] + 3.0, goal=shipped.goal,
        settings=WALKING, options=LANDING,
    )  # fmt: skip
    assert (done.outcome == Outcome.ARRIVED).all()
    np.testing.assert_array_equal(nodes.orbit_of[done.node], nodes.orbit_of[entry])


def test_from_speed_to_speed_the_robot_does_not_stop(shipped):
    routes = Routes.of(shipped.nodes, shipped.speeds)
    last = len(shipped.speeds) - 1
    home, hops = 0, []
    while home != last:
        ways = routes.towards(home, last)
        assert ways
        home = int(shipped.nodes.orbit_of[next(iter(ways.values()))])
        hops.append(home)
    assert hops == list(range(1, last + 1))


def test_ways_that_are_missing_are_gone_round():
    """From upright on the leg that has a way, over upright where there is no other one."""
    routes = Routes(
        (
            Departure(UPRIGHT, 0, 20, 1), Departure(UPRIGHT, 0, 30, 0),
            Departure(UPRIGHT, 1, 40, 0), Departure(0, 5, 50, 1), Departure(1, 6, 60, UPRIGHT),
        ),
        (0.2, 0.3),
    )  # fmt: skip
    assert routes.towards(UPRIGHT, 1) == {0: 20, 1: 40}
    assert routes.towards(0, UPRIGHT) == {5: 50}
    assert routes.towards(1, 0) == {6: 60}
    assert routes.towards(UPRIGHT, 0) == {0: 30, 1: 40}


def test_the_home_of_a_speed_is_the_nearest(shipped):
    routes = Routes.of(shipped.nodes, shipped.speeds)
    last = len(shipped.speeds) - 1
    assert routes.towards(last, last) == {}
    assert routes.home_at(0.0) == UPRIGHT
    assert routes.home_at(9.0) == last
    assert routes.home_at(shipped.speeds[1] + 0.01) == 1
    lost = Routes((Departure(0, 5, 9, 1),), (0.2, 0.3))
    assert lost.towards(UPRIGHT, 1) == {}
    assert lost.towards(0, 1) == {5: 9}
    with pytest.raises(ValueError, match='1 speeds are given; the tree has 5 orbits'):
        Routes.of(shipped.nodes, [0.3])


def test_a_tree_that_walks_is_checked(shipped):
    arrays = shipped.arrays()
    with pytest.raises(TreeError, match='speeds must be 5 finite numbers'):
        Tree.of(shipped.header(), {**arrays, 'speeds': np.full(5, np.nan)})
    branch = np.where(shipped.nodes.orbiting, 7, shipped.nodes.branch).astype(np.int32)
    with pytest.raises(TreeError, match='leads round and round'):
        Tree.of(shipped.header(), {**arrays, 'branch': branch})
