"""Many rollouts at once are what `walk` and `Tracker` do one by one, impacts included."""

from dataclasses import replace

import numpy as np
import pytest

from cg_control.following.nodes import Nodes
from cg_control.following.tracking import Tracker, TrackingSettings
from cg_control.trees import rollouts as module
from cg_control.trees.rollouts import Outcome, follow
from cg_description.paths import model_path
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.batch import Feedback, simulate_batch
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.rollout.compiler import compiler
from cg_dynamics.walking.hybrid import WalkOptions, walk

OPTIONS = WalkOptions(sample_time=0.002, step=0.002)
SPREAD = np.array([0.03, 0.06, 0.06, 0.1])
# Rounding, multiplied by what two impacts and an upright robot make of it; instants of impacts
# are found to 1e-12 s by the one and to 1e-13 s by the other, at accelerations of 10 to 100.
TOLERANCE = 1e-8
# Around upright on the outer leg, which is the first one there.
GOAL = np.array([np.full((4, 4), np.nan), np.diag([1 / 0.05, 1 / 0.02, 1 / 0.3, 1 / 0.1]) ** 2])

needs_compiler = pytest.mark.skipif(compiler() is None, reason='no C compiler on this machine')


@pytest.fixture(scope='module')
def tree(robot, step, back) -> Nodes:
    """Inner -> outer, and outer -> inner grafted on its start: two steps to the outer leg."""
    forth = Nodes.of(step, robot)
    return forth.grafted(back, robot, forth.first)


def drawn(nodes, start, seed, share=1.0):
    """States near the nodes at which rollouts begin; the stance leg is the first of SPREAD."""
    order = np.array([[0, 1, 2, 3], [1, 0, 3, 2]])[nodes.stance[start]]
    near = share * np.random.default_rng(seed).uniform(-1, 1, (len(start), 4)) * SPREAD
    return nodes.x0[start] + np.take_along_axis(near, order, 1)


def walked(nodes, robot, start, x, duration, settings=None, options=OPTIONS, known=None):
    """The reference: one walk after the other, each with a tracker that lives."""
    done = []
    for node, x0 in zip(start, x, strict=True):
        tracker = Tracker(nodes, known or robot, settings, int(node))
        done.append(
            walk(robot, STANCES[nodes.stance[node]], x0, duration,
                 lambda t, s, y, tracker=tracker: np.array([tracker.torque(t, s, y)]), options)
        )  # fmt: skip
    return done


def assert_same(found, done):
    assert [STANCES[s] for s in found.stance] == [one.stance for one in done]
    np.testing.assert_array_equal(found.impacts, [len(one.impacts) for one in done])
    np.testing.assert_allclose(found.time, [one.time for one in done], atol=1e-12)
    np.testing.assert_allclose(found.state, [one.state for one in done], rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize('remedy', ['event', 'phase'])
@pytest.mark.parametrize('slope', [-0.02, 0.0, 0.02])
def test_two_steps_are_those_of_walk_and_tracker(robot, tree, remedy, slope):
    """Where the ground rises the foot lands before its time, where it falls after it."""
    settings, options = TrackingSettings(remedy=remedy), replace(OPTIONS, slope=slope)
    start = np.array([tree.first, tree.first + 7, tree.landing[tree.first]])
    x = drawn(tree, start, seed=3, share=0.3)
    found = follow(tree, robot, start, x, 3.5, settings=settings, options=options)
    done = walked(tree, robot, start, x, 3.5, settings, options)
    assert_same(found, done)
    assert found.impacts.max() == 2
    planned = tree.time[tree.landing[tree.first]]
    delay = done[0].impacts[0].time - planned
    assert delay * slope >= 0
    assert slope == 0.0 or abs(delay) > 5 * OPTIONS.sample_time


def test_steps_of_integration_and_samples_may_differ(robot, tree):
    start = np.array([tree.first, tree.landing[tree.first]])
    x = drawn(tree, start, seed=4, share=0.3)
    options = WalkOptions(sample_time=0.004, step=0.0015)
    found = follow(tree, robot, start, x, 2.0, options=options)
    assert_same(found, walked(tree, robot, start, x, 2.0, None, options))
    # Whole samples: a duration in between goes on to the next.
    rounded = follow(tree, robot, start, x, [1.997, 0.001], options=options)
    np.testing.assert_allclose(rounded.time, [2.0, 0.004])
    np.testing.assert_array_equal(rounded.state[0], found.state[0])


def test_friction_that_was_not_planned_is_compensated(robot, frictionless_step):
    nodes = Nodes.of(frictionless_step, robot)
    assert nodes.compensate
    known = robot.with_values({'coulomb_friction.torque': 2.5, 'c1': 0.105})
    start = np.array([nodes.first, nodes.first + 5])
    x = drawn(nodes, start, seed=5, share=0.3)
    found = follow(nodes, robot, start, x, 2.5, known=known)
    assert_same(found, walked(nodes, robot, start, x, 2.5, known=known))
    assert found.impacts.tolist() == [1, 1]


def test_own_parameters_for_each(robot, tree):
    names = compile_model(robot, Setup()).parameter_names
    rng = np.random.default_rng(6)
    robots = [
        robot.with_values({n: robot.values[n] * rng.uniform(0.98, 1.02) for n in ('c1', 'c5')})
        for _ in range(3)
    ]
    p = np.array([[one.values[name] for name in names] for one in robots])
    start = np.array([tree.first, tree.landing[tree.first], tree.first])
    x = drawn(tree, start, seed=6, share=0.2)
    found = follow(tree, robot, start, x, 2.0, p=p, known=robot)
    for b, one in enumerate(robots):
        done = walked(tree, one, start[b : b + 1], x[b : b + 1], 2.0, known=robot)
        np.testing.assert_allclose(found.state[b], done[0].state, rtol=0, atol=TOLERANCE)


def test_robot_with_more_effects_than_the_controller_knows(robot, tree):
    """Flexible hip, a payload and friction that drifts: states and a clock of their own."""
    more = (
        robot.with_effect('payload', at='inner', mass=0.4, distance=0.6)
        .with_effect('joint_flexibility')
        .with_effect('friction_drift')
    )
    start = np.array([tree.landing[tree.first], tree.first])
    x = drawn(tree, start, seed=7, share=0.2)
    found = follow(tree, more, start, x, 1.0, known=robot)
    assert found.state.shape[1] > 4
    assert_same(found, walked(tree, more, start, x, 1.0, known=robot))
    assert found.impacts.sum() > 0


@needs_compiler
def test_without_a_compiler_it_is_slow_and_the_same(robot, tree, monkeypatch):
    start = np.array([tree.first, tree.landing[tree.first], tree.first + 4, 3])
    x = drawn(tree, start, seed=8)
    x[3] = [0.5, 0.0, 2.0, 0.0]
    how = {'goal': GOAL, 'visits': 120, 'elapsed': np.array([0.0, 0.013, 0.0, 0.0])}
    fast = follow(tree, robot, start, x, 3.5, **how)
    monkeypatch.setattr(module, 'rollout_library', lambda *_: None)
    slow = follow(tree, robot, start, x, 3.5, **how)
    assert Outcome.ARRIVED in fast.outcome
    assert Outcome.FALLEN in fast.outcome
    for name in ('outcome', 'stance', 'node', 'impacts'):
        np.testing.assert_array_equal(getattr(fast, name), getattr(slow, name))
    for name in ('state', 'time', 'elapsed'):
        np.testing.assert_allclose(
            getattr(fast, name), getattr(slow, name), rtol=0, atol=TOLERANCE
        )
    np.testing.assert_array_equal(fast.visits.node, slow.visits.node)
    np.testing.assert_allclose(fast.visits.state, slow.visits.state, rtol=0, atol=TOLERANCE)
    # S has entries up to 1e5.
    np.testing.assert_allclose(fast.visits.cost, slow.visits.cost, rtol=1e-6, atol=1e-3)


def test_from_every_node_the_nominal_state_comes_home(robot, tree):
    """Also in the middle of a motion, just before an impact and right after it."""
    start = np.flatnonzero(~tree.late & ~tree.impact)
    found = follow(tree, robot, start, tree.x0[start], tree.to_go[start] + 1.5, goal=GOAL)
    assert (found.outcome == Outcome.ARRIVED).all()
    # Trajectories begin or end in the goal region, upright on the goal's leg, where the hip is
    # slow and knots are close.
    moved = found.time > 0
    assert 0.5 < moved.mean() < 1
    np.testing.assert_array_equal(found.impacts[moved], tree.steps[start][moved])
    inside = np.einsum('bi,ij,bj->b', found.state, GOAL[1], found.state)
    assert inside.max() <= 1
    before = follow(tree, robot, start, tree.x0[start],
                    np.maximum(found.time - OPTIONS.sample_time, 0.0))  # fmt: skip
    outside = np.einsum('bi,ij,bj->b', before.state, GOAL[1], before.state)
    landed = before.stance == STANCES.index('outer')
    assert (outside[moved & landed] > 1).all()


def test_a_landing_that_nobody_planned_ends_it(robot, tree):
    """The robot falls on its swing leg, which is ahead, when all it should do is stand."""
    start = np.zeros(1, int)
    x = np.array([[-0.25, 0.15, 0.0, 1.5]])
    found = follow(tree, robot, start, x, 2.0)
    assert found.outcome.tolist() == [Outcome.LEFT]
    assert found.impacts.tolist() == [1]
    assert STANCES[found.stance[0]] == 'inner'
    assert found.node.tolist() == [0]


def test_falls_and_runaways_leave_the_others_alone(robot, tree):
    start = np.full(9, tree.landing[tree.first])
    x = drawn(tree, start, seed=9, share=0.2)
    calm = follow(tree, robot, start, x, 1.0)
    x[4], x[6] = [0.9, 0.0, 4.0, 0.0], [0.0, 0.0, 0.0, 1e8]
    found = follow(tree, robot, start, x, 1.0)
    assert found.outcome[[4, 6]].tolist() == [Outcome.FALLEN] * 2
    others = np.delete(np.arange(9), [4, 6])
    np.testing.assert_array_equal(found.state[others], calm.state[others])


@pytest.mark.parametrize('vector', [True, False])
def test_a_leg_that_swings_too_far_is_a_fall(robot, tree, vector, monkeypatch):
    if not vector:
        monkeypatch.setattr(module, 'compiler', lambda: None)
    start = np.full(6, tree.landing[tree.first])
    x = drawn(tree, start, seed=9, share=0.2)
    x[2, :2], x[4, :2] = [0.0, 0.9], [0.0, -0.9]  # the outer leg swings
    narrow = WalkOptions(sample_time=0.002, step=0.002, swing_angle=0.8)
    found = follow(tree, robot, start, x, 0.05, options=narrow)
    assert (found.outcome == Outcome.FALLEN).tolist() == [k in (2, 4) for k in range(6)]


@pytest.mark.parametrize('threads', [1, 2, 3])
def test_results_do_not_depend_on_company(robot, tree, threads):
    """Bit by bit: growing a tree must not depend on how its work is shared."""
    start = np.random.default_rng(10).choice(np.flatnonzero(~tree.late), 53)
    x = drawn(tree, start, seed=10)
    how = {'goal': GOAL, 'visits': 60, 'settings': TrackingSettings(remedy='phase')}
    found = follow(tree, robot, start, x, 1.5, threads=threads, **how)
    order = np.random.default_rng(11).permutation(53)[:37]
    again = follow(tree, robot, start[order], x[order], 1.5, **how)
    for name in ('outcome', 'state', 'time', 'node', 'impacts'):
        np.testing.assert_array_equal(getattr(found, name)[order], getattr(again, name))
    np.testing.assert_array_equal(found.visits.cost[order], again.visits.cost)


def test_visits_say_at_which_cost_each_node_was_passed(robot, tree):
    start = np.array([tree.first])
    x = drawn(tree, start, seed=12, share=0.1)
    found = follow(tree, robot, start, x, 5.0, visits=400)
    nodes = found.visits.node[0]
    nodes = nodes[nodes >= 0]
    # All of the way, the link included, but what an early landing skips.
    way = [tree.first]
    while tree.planned[way[-1]] >= 0:
        way.append(int(tree.planned[way[-1]]))
    skipped = set(way) - set(nodes)
    assert list(nodes) == [node for node in way if node not in skipped]
    assert len(skipped) <= 4
    # At its start and at every landing the reference is at the node itself.
    at_nodes = [tree.first, *tree.landing[tree.impact]]
    for k, node in enumerate(nodes):
        e = found.visits.state[0, k] - tree.x0[node]
        cost = e @ tree.S[node] @ e
        if node in at_nodes:
            assert found.visits.cost[0, k] == pytest.approx(cost, rel=1e-9)
    assert set(at_nodes) <= set(nodes)
    few = follow(tree, robot, start, x, 5.0, visits=5)
    np.testing.assert_array_equal(few.visits.node, found.visits.node[:, :5])
    assert follow(tree, robot, start, x, 0.1).visits is None


@pytest.mark.parametrize('compiled', [True, False])
def test_machine_without_feet(compiled, monkeypatch):
    """A pendulum held upright, against the batch of cg_dynamics."""
    pendulum = Model.load(model_path('sydney_pendulum'))
    torque = pendulum.values['gravity_torque']
    pendulum = pendulum.with_values({'gravity_torque': -torque})
    K = torque * np.array([3.0, 0.7])
    nodes = Nodes.root('inner', K, np.eye(2), pendulum.hash)
    if not compiled:
        monkeypatch.setattr(module, 'rollout_library', lambda *_: None)
    x = np.random.default_rng(13).uniform(-0.3, 0.3, (11, 2))
    x[2], x[5] = [0.9, 40.0], [0.0, 0.01]
    goal = np.array([np.eye(2) / 0.02**2, np.full((2, 2), np.nan)])
    found = follow(nodes, pendulum, np.zeros(11, int), x, 1.0)
    time, limit = np.arange(501) * 0.002, np.array([pendulum.torque_limit])
    law = Feedback(np.tile(K, (501, 1, 1)), np.zeros((501, 2)), limit)
    p = parameter_vector(pendulum, Setup())
    end = simulate_batch(pendulum, Setup(), time, np.zeros((501, 1)), x, p, feedback=law)
    stood = found.outcome == Outcome.TIMED_OUT
    np.testing.assert_allclose(found.state[stood], end[stood], rtol=0, atol=1e-11)
    assert not stood[2]
    arrived = follow(nodes, pendulum, np.zeros(11, int), x, 1.0, goal=goal)
    assert arrived.outcome[5] == Outcome.ARRIVED
    assert arrived.time[5] == 0


def test_states_may_be_stored_by_columns(robot, tree):
    start = np.full(20, tree.first)
    x = drawn(tree, start, seed=14)
    found = follow(tree, robot, start, x, 0.5)
    again = follow(tree, robot, start, np.asfortranarray(x), 0.5)
    np.testing.assert_array_equal(again.state, found.state)


def test_no_rollouts_are_no_error(robot, tree):
    found = follow(tree, robot, np.zeros(0, int), np.zeros((0, 4)), 1.0, visits=3)
    assert found.state.shape == (0, 4)
    assert found.outcome.shape == (0,)


@pytest.mark.parametrize(
    ('wrong', 'message'),
    [
        ({'start': [-1]}, 'start must hold nodes 0 to'),
        ({'x': [[0.0, 0.0, 0.0]]}, r'x has shape \(1, 3\), expected \(1, 4\)'),
        ({'x': [[np.nan, 0.0, 0.0, 0.0]]}, 'finite'),
        ({'elapsed': [-0.1]}, 'not negative'),
        ({'duration': -1.0}, 'duration must'),
        ({'duration': [1.0, 2.0]}, r'duration has shape \(2,\)'),
        ({'goal': np.eye(4)}, r'goal has shape \(4, 4\), expected \(2, 4, 4\)'),
        ({'p': np.ones(3)}, r'p has shape \(3,\)'),
        ({'settings': TrackingSettings(remedy='clock')}, "'event' and 'phase'"),
        ({'settings': TrackingSettings(feedback=False)}, 'with feedback'),
        ({'options': WalkOptions(clearance=0.01)}, 'clearance'),
    ],
)
def test_what_cannot_be_simulated_so_is_refused(robot, tree, wrong, message):
    good = {'start': [0], 'x': np.zeros((1, 4)), 'duration': 1.0}
    with pytest.raises(ValueError, match=message):
        follow(tree, robot, **(good | wrong))


def test_robots_that_need_the_walk_are_named(robot, tree):
    late = robot.with_effect('actuator_delay', delay=0.004)
    with pytest.raises(ValueError, match='input delay; use walk'):
        follow(tree, late, [0], np.zeros((1, 4)), 1.0)
    slippery = robot.with_effect('foot_slip')
    with pytest.raises(ValueError, match='does not stick where it lands'):
        follow(tree, slippery, [0], np.zeros((1, 4)), 1.0)
