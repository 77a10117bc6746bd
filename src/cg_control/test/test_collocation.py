"""Planned motions against the exact hybrid model, and clear words where there is none."""

import itertools
import time

import numpy as np
import pytest

from cg_control.following.nodes import Nodes
from cg_control.friction import FrictionCompensation
from cg_control.trajectories.collocation import (
    InfeasibleError,
    Options,
    PlanningError,
    UndecidedError,
    optimise,
    planning_model,
    screen,
    softened,
)
from cg_control.trajectories.task import Box, Ellipsoid, Task
from cg_control.trajectories.tvlqr import stabilise
from cg_dynamics.walking.gait import find_gait
from cg_dynamics.walking.hybrid import WalkOptions, walk
from cg_dynamics.walking.impact import impact

REBALANCE = Task(('inner', 'outer'), reach=0.2)


def played(trajectory, model):
    """The exact hybrid model under the nominal torque alone."""

    def command(t, stance, x):
        return np.array([trajectory.at(t + 0.001).torque])

    return walk(
        model, trajectory.modes[0], trajectory.states[0], trajectory.duration, command,
        WalkOptions(step=5e-4),
    )  # fmt: skip


@pytest.mark.parametrize('friction', [False, True])
@pytest.mark.parametrize('modes', [('inner', 'outer'), ('outer', 'inner')])
def test_one_step_rebalance_is_a_motion_of_the_exact_model(robot, modes, friction):
    task = Task(modes, reach=0.2)
    trajectory = optimise(robot, task, friction=friction)
    np.testing.assert_allclose(trajectory.states[0], 0, atol=1e-6)
    np.testing.assert_allclose(trajectory.states[-1], 0, atol=1e-6)
    assert np.abs(trajectory.torque).max() <= robot.torque_limit
    done = played(trajectory, planning_model(robot, friction))
    assert [event.kind for event in done.events] == ['impact']
    assert done.stance == modes[1]
    # The upright robot amplifies by exp(3.2 * 1 s) what collocation errs at 20 knots a phase, and
    # that the torque is held while dry friction turns its sign.
    tolerance = 2e-3 if friction else 2e-4
    assert abs(done.impacts[0].time - trajectory.impact_times[0]) < tolerance
    np.testing.assert_allclose(done.state, trajectory.states[-1], atol=tolerance)


@pytest.mark.evidence
def test_more_knots_bring_the_cost_no_lower(robot):
    """The coarse cost is near the fine one: they are the same problem."""
    coarse = screen(planning_model(robot, False), REBALANCE)
    fine = optimise(robot, REBALANCE, friction=False)
    assert coarse.verdict == 'feasible'
    assert coarse.best.cost == pytest.approx(fine.provenance['cost'], rel=0.05)


def test_goal_regions_are_met_and_make_the_motion_cheaper(robot):
    form = np.diag([1 / 0.03**2, 1 / 0.05**2, 1 / 0.1**2, 1 / 0.2**2])
    region = optimise(
        robot, Task(('inner', 'outer'), goal=Ellipsoid(np.zeros(4), form), reach=0.2),
        friction=False,
    )  # fmt: skip
    end = region.states[-1]
    assert 0 < end @ form @ end <= 1 + 1e-5
    point = optimise(robot, REBALANCE, friction=False)
    assert region.provenance['cost'] < point.provenance['cost']
    box = optimise(
        robot,
        Task(('inner', 'outer'), goal=Box([0, 0, -0.1, -0.1], [0, 0, 0.1, 0.1]), reach=0.2),
        friction=False,
    )
    assert box.provenance['cost'] < point.provenance['cost']
    assert np.abs(box.states[-1]).max() <= 0.1 + 1e-5


def test_limits_of_torque_and_its_rate_hold(robot):
    free = optimise(robot, REBALANCE, friction=False)
    peak = np.abs(free.torque).max()
    weak = optimise(robot, Task(('inner', 'outer'), reach=0.2, torque_limit=0.9 * peak),
                    friction=False)  # fmt: skip
    assert np.abs(weak.torque).max() <= 0.9 * peak + 1e-5
    steep = [np.abs(np.diff(p.torque) / np.diff(p.time)).max() for p in free.phases]
    smooth = optimise(
        robot, Task(('inner', 'outer'), reach=0.2, rate_limit=0.8 * max(steep)), friction=False
    )
    slopes = [np.abs(np.diff(p.torque) / np.diff(p.time)).max() for p in smooth.phases]
    assert max(slopes) <= 0.8 * max(steep) * (1 + 1e-4)


def test_steps_are_as_long_and_motions_take_as_much_time_as_allowed(robot):
    free = optimise(robot, REBALANCE, friction=False)
    q = free.phases[0].states[-1, :2]
    reach = robot.values['leg_length'] * (np.sin(q[0]) - np.sin(q[1]))
    short = 0.9 * reach
    task = Task(('inner', 'outer'), reach=short, farthest=short)
    shorter = optimise(robot, task, friction=False)
    q = shorter.phases[0].states[-1, :2]
    # The tolerance of a row.
    assert robot.values['leg_length'] * (np.sin(q[0]) - np.sin(q[1])) == pytest.approx(
        short, abs=1e-6
    )
    wanted = 1.2 * free.duration
    slower = optimise(
        robot, Task(('inner', 'outer'), reach=0.2, total=(wanted, wanted)), friction=False
    )
    assert slower.duration == pytest.approx(wanted, abs=1e-6)
    between = Task(('inner', 'outer'), reach=0.2, total=(wanted, 2 * wanted))
    assert optimise(robot, between, friction=False).duration == pytest.approx(wanted, abs=1e-3)


def test_a_motion_nearby_spares_the_search(robot):
    first = optimise(robot, REBALANCE, friction=False)
    task = Task(('inner', 'outer'), Box.point([0.01, 0, 0, 0]), reach=0.2)
    alone, near = (optimise(robot, task, friction=False, near=at) for at in (None, first))
    assert near.provenance['iterations'] < alone.provenance['iterations'] / 2
    assert near.provenance['cost'] == pytest.approx(alone.provenance['cost'], rel=1e-4)


def test_retracted_foot_stays_within_its_retraction(robot):
    task = Task(('inner', 'outer'), reach=0.2, retraction=0.01)
    trajectory = optimise(robot, task, friction=False)
    q = trajectory.phases[0].states[:, :2]
    l = robot.values['leg_length']
    height = l * (np.cos(q[:, 0]) - np.cos(q[:, 1]))
    reach = l * (np.sin(q[:, 0]) - np.sin(q[:, 1]))
    assert height.min() >= -0.01 - 1e-6
    assert height[reach > 0.05].min() >= -1e-4


@pytest.mark.parametrize(
    ('task', 'message'),
    [
        (Task(('inner',), goal=Box.point([0.0, 0.0, 9.0, 0.0])), 'inner from .* within 40 N m'),
        pytest.param(
            Task(('inner', 'outer'), torque_limit=0.0), 'within 0 N m', marks=pytest.mark.evidence
        ),
        (Task(('inner',), start=Box.point([0.3, 0, 1.5, 0])), 'nearest misses'),
    ],
)
def test_impossible_tasks_are_infeasible_and_say_by_how_much(robot, task, message):
    with pytest.raises(InfeasibleError, match=message):
        optimise(robot, task)


def test_being_out_of_iterations_is_not_infeasible(robot):
    with pytest.raises(UndecidedError, match='there may be one'):
        optimise(robot, REBALANCE, Options(iterations=0))
    with pytest.raises(UndecidedError) as caught:
        optimise(robot, REBALANCE, Options(coarse_iterations=2))
    # Four guesses of 2, 60 and 2 iterations at most.
    assert 0 < caught.value.iterations <= 4 * 64


def test_a_plan_depends_on_no_clock(robot, monkeypatch):
    """A machine on which a second takes an hour makes the same plan, provenance included."""
    task = Task(('inner', 'outer'), reach=0.2)
    expected = optimise(robot, task).text()
    clock = itertools.count(step=3600.0)
    monkeypatch.setattr(time, 'perf_counter', lambda: next(clock))
    assert optimise(robot, task).text() == expected


@pytest.mark.parametrize(
    ('make', 'message'),
    [
        (lambda: Box.point([0, 0, np.nan, 0]), '4 finite numbers'),
        (lambda: Box([0, 0, 0, 1], [0, 0, 0, 0]), 'lower bounds above'),
        (lambda: Task(('left',)), "'left' is not one of inner, outer"),
        (lambda: Task(('inner',), torque_limit=-1.0), 'must not be negative'),
        (lambda: Task(('inner',), durations=(1.0, 0.5)), 'increasing'),
        (lambda: Task(('inner',), total=(1.0, 0.5)), 'not decreasing'),
        (lambda: Task(('inner',), reach=0.3, farthest=0.2), 'above farthest'),
    ],
)
def test_nonsense_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_plan_names_its_model(robot):
    trajectory = optimise(robot, REBALANCE)
    assert trajectory.model_hash == robot.hash
    assert trajectory.provenance['friction'] == 'planned'


# The classic passive walker: two point-mass legs of 5 kg at half of 1 m, 10 kg at the hip.
CLASSIC = {
    'leg_length': 1.0, 'total_mass': 20.0, 'gravity': 9.81, 'c1': 0.0625 + 1e-7,
    'c2': 0.0625 + 1e-7, 'c3': 1e-7, 'c4': 0.125, 'c5': 0.125, 'c6': 0.0,
}  # fmt: skip


def test_passive_gait_is_that_of_the_hybrid_simulation(robot):
    """Found by collocation and by Newton's method on the walk itself, on 3 degrees."""
    slope = 0.0525
    walker = planning_model(robot, False).with_values(CLASSIC)
    anywhere = Box.anywhere()
    task = Task(
        ('inner',), anywhere, anywhere, periodic=True, torque_limit=0.0, slope=slope,
        durations=(0.2, 1.5), reach=0.2,
    )  # fmt: skip
    found = optimise(walker, task)
    assert np.abs(found.torque).max() < 1e-9
    x0 = found.states[0]
    guess = [(x0[1] - x0[0]) / 2, x0[2], x0[3]]
    gait = find_gait(walker, 'inner', guess, WalkOptions(slope=slope), steps=1)
    # What Hermite-Simpson errs with 20 intervals.
    np.testing.assert_allclose(gait.x0, x0, atol=2e-4)
    assert gait.period == pytest.approx(found.duration, abs=2e-4)


def test_gait_on_flat_ground_repeats_itself(robot):
    walker = planning_model(robot, False).with_values(CLASSIC)
    anywhere = Box.anywhere()
    task = Task(('inner',), anywhere, anywhere, periodic=True, reach=0.4, durations=(0.2, 1.5))
    found = optimise(walker, task)
    done = played(found, walker)
    assert len(done.impacts) <= 1
    after = impact(walker, 'inner', found.states[-1]).x_plus
    np.testing.assert_allclose(after[[1, 0, 3, 2]], found.states[0], atol=1e-5)


@pytest.fixture(scope='module')
def branch(robot):
    """The tree of one rebalance from the inner leg to the outer one."""
    return Nodes.of(stabilise(optimise(robot, REBALANCE, friction=False), robot), robot)


def test_a_stretch_is_the_branch_it_is_cut_from(branch):
    stretch = branch.stretch(branch.first)
    assert stretch.stance == 'inner'
    # As far as the impact, and no further.
    assert branch.impact[branch.next[stretch.node[-1]]]
    for s in np.linspace(0.0, stretch.length, 7):
        node, since = stretch.place(s)
        expected = since ** np.arange(4.0) @ branch.edges[node][:, 1:5]
        np.testing.assert_array_equal(stretch.at(s), expected)
    part = branch.stretch(branch.first + 2, pieces=3)
    assert part.node.tolist() == [branch.first + k for k in (2, 3, 4)]
    np.testing.assert_allclose(part.at(0.0), branch.x0[branch.first + 2])
    with pytest.raises(ValueError, match='no stretch begins at node 0'):
        branch.stretch(0)
    with pytest.raises(ValueError, match='stretch on the inner leg'):
        Task(('outer',), goal=stretch)


def test_a_motion_ends_where_joining_the_branch_is_cheapest(robot, branch):
    """No node is as cheap to end in, and the way on is counted with the weights of the task."""
    stretch = branch.stretch(branch.first, pieces=12)
    start = Box.point([0.01, -0.05, 0.05, 0.3])
    found = optimise(robot, Task(('inner',), start, stretch), friction=False)
    onto, since = found.provenance['onto'], found.provenance['elapsed']
    np.testing.assert_allclose(
        found.states[-1], since ** np.arange(4.0) @ branch.edges[onto][:, 1:5], atol=1e-6
    )
    sum_to_go = 0.0
    for k in range(len(stretch.node) - 1, -1, -1):
        node = stretch.node[k]
        # Torque is linear, so its square is what Simpson's rule integrates.
        u0, u1 = branch.u0[node], branch.u0[branch.next[node]]
        squares = (u0**2 + (u0 + u1) ** 2 + u1**2) / 6
        sum_to_go += (0.01 * squares + 0.1) * branch.span[node]
        if k % 4 == 0:
            there = Task(('inner',), start, Box.point(branch.x0[node]))
            try:
                fixed = optimise(robot, there, friction=False)
            except PlanningError:
                continue
            assert found.provenance['cost'] <= fixed.provenance['cost'] + sum_to_go + 1e-3
    grown = branch.grafted(stabilise(found, robot, final_cost=branch.S[onto]), robot, onto, since)
    assert grown.to_go[grown.first] > 0
    last = np.flatnonzero(grown.branch == 2)[-1]
    np.testing.assert_allclose(grown.x0[grown.next[last]], found.states[-1], atol=1e-6)


def test_a_motion_may_end_near_a_branch(robot, branch):
    form = np.diag([1 / 0.02**2, 1 / 0.05**2, 1 / 0.1**2, 1 / 0.3**2])
    start = Box.point([0.01, -0.05, 0.05, 0.3])
    exact, near = (
        optimise(
            robot, Task(('inner',), start, branch.stretch(branch.first, 12, tolerance)),
            friction=False,
        )
        for tolerance in (None, form)
    )  # fmt: skip
    onto, since = near.provenance['onto'], near.provenance['elapsed']
    missed = near.states[-1] - since ** np.arange(4.0) @ branch.edges[onto][:, 1:5]
    assert 1e-3 < missed @ form @ missed <= 1 + 1e-5
    assert near.provenance['cost'] < exact.provenance['cost']


@pytest.mark.parametrize('steps', [pytest.param(2, marks=pytest.mark.evidence), 3, 4])
def test_several_steps_end_on_a_branch_of_either_leg(robot, branch, steps):
    """Walking on, from where a planned rebalance stands, until a foot meets the branch."""
    legs = tuple(('outer', 'inner')[k % 2] for k in range(steps + 1))
    at = branch.first if legs[-1] == 'inner' else int(branch.landing[branch.first])
    goal = branch.stretch(at)
    found = optimise(
        robot, Task(legs, Box.point(np.zeros(4)), goal), Options(fine=8, coarse=8),
        friction=False,
    )  # fmt: skip
    assert found.modes == legs
    onto, since = found.provenance['onto'], found.provenance['elapsed']
    assert onto in goal.node
    end = since ** np.arange(4.0) @ branch.edges[onto][:, 1:5]
    np.testing.assert_allclose(found.states[-1], end, atol=1e-6)
    for before, after in itertools.pairwise(found.phases):
        landed = impact(planning_model(robot, False), before.stance, before.states[-1]).x_plus
        np.testing.assert_allclose(after.states[0], landed, atol=1e-5)


def test_what_dry_friction_takes_is_given_back_within_the_limit(robot):
    """The plan's torque has friction on top, with knots of its own where the hip turns."""
    limit = 12.0
    task = Task(('inner', 'outer'), reach=0.2, torque_limit=limit)
    with_friction, without = (optimise(robot, task, friction=on) for on in (True, False))
    taken = FrictionCompensation(softened(planning_model(robot)))
    for phase in without.phases:
        slip = phase.states[:, 2] - phase.states[:, 3]
        hip = phase.states[:, 0] - phase.states[:, 1]
        whole = phase.torque + [taken.taken(*point) for point in zip(hip, slip, strict=True)]
        assert np.abs(whole).max() <= limit + 1e-3
    assert np.abs(with_friction.torque).max() <= limit + 1e-9
    phase = optimise(robot, REBALANCE).phases[0]
    assert len(phase.time) > 21
    slip = phase.states[:, 2] - phase.states[:, 3]
    turns = np.flatnonzero(slip[:-1] * slip[1:] < 0)
    assert len(turns)
    for k in turns:
        # 1.84 N m, from one side to the other, between the knots where it is slow.
        sense = np.sign(slip[k + 1])
        before = np.flatnonzero(sense * slip[: k + 1] < -0.025)[-1]
        after = k + 1 + np.flatnonzero(sense * slip[k + 1 :] > 0.025)[0]
        jump = sense * (phase.torque[after] - phase.torque[before])
        assert jump == pytest.approx(2 * 1.84, abs=0.4)
