"""Following the one-step rebalance on the exact hybrid model, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from cg_control.balancing.balance import BalanceController, balance_gains
from cg_control.following.execution import ExecutionSettings, TrajectoryController
from cg_control.following.nodes import Nodes
from cg_control.following.planning import CheckOptions, RejectedError, check, executed, plan
from cg_control.following.tracking import REMEDIES, Tracker, TrackingSettings, wrong_leg
from cg_control.trajectories.collocation import Options
from cg_control.trajectories.task import Task
from cg_control.trajectories.trajectory import TrajectoryError
from cg_dynamics.walking.hybrid import WalkOptions

OPTIONS = WalkOptions(sample_time=0.004, step=0.002, minimum_step=0.1, fall_angle=0.6)
TASK = Task(('inner', 'outer'), reach=0.2)


def rebalanced(done):
    """Standing upright on the other leg; dry friction leaves a small limit cycle."""
    return (
        done.outcome == 'time'
        and done.stance == 'outer'
        and len(done.impacts) == 1
        and abs(done.state[1]) < 0.05
        and abs(done.state[3]) < 0.2
    )


@pytest.mark.parametrize('remedy', REMEDIES)
def test_perturbed_robot_steps_and_stands(robot, step, remedy):
    x0 = np.array([0.015, -0.04, 0.03, 0.08])
    done = executed(step, robot, TrackingSettings(remedy=remedy), x0=x0, more=1.5, options=OPTIONS)
    assert rebalanced(done)


def test_without_feedback_it_falls(robot, step):
    """The counter-proof: the test above needs the feedback."""
    done = executed(
        step, robot, TrackingSettings(feedback=False), x0=np.array([0.015, -0.04, 0.03, 0.08]),
        options=OPTIONS,
    )  # fmt: skip
    assert not rebalanced(done)


def test_an_accepted_plan_says_what_it_was_checked_for(robot, step):
    assert step.provenance['checked']['open_loop'] < CheckOptions().open_loop
    assert step.provenance['checked']['closed_loop'] < CheckOptions().closed_loop
    assert np.abs(step.phases[0].gains).max() > 0


def test_a_motion_that_the_model_does_not_make_is_rejected(robot, step):
    """A plan whose torque was scaled fails open loop; the bounds are those of the check."""
    phases = tuple(replace(phase, torque=1.5 * phase.torque) for phase in step.phases)
    assert 'open loop' in check(step.with_phases(phases), robot).problem
    with pytest.raises(RejectedError, match='not accepted: closed loop'):
        plan(robot, TASK, Options(fine=25), checks=CheckOptions(closed_loop=1e-9))


def test_friction_that_was_not_planned_is_compensated(robot, frictionless_step):
    step = frictionless_step
    assert step.provenance['friction'] == 'to be compensated'
    done = executed(step, robot, TrackingSettings(), more=1.0, options=OPTIONS)
    assert rebalanced(done)


def test_event_goes_over_to_the_leg_that_stands(robot, step):
    tracker = Tracker(Nodes.of(step, robot), robot, TrackingSettings(remedy='event'))
    early = step.impact_times[0] - 0.05
    x = step.phases[0].at(early).state
    tracker.torque(0.0, 'inner', step.states[0])
    tracker.torque(early, 'inner', x)
    assert tracker.s == pytest.approx(early)
    tracker.torque(early + 0.002, 'outer', step.phases[1].states[0])
    assert tracker.s == step.phases[1].start
    clock = Tracker(Nodes.of(step, robot), robot, TrackingSettings(remedy='clock'))
    clock.torque(0.0, 'inner', step.states[0])
    clock.torque(early + 0.002, 'outer', step.phases[1].states[0])
    assert clock.s == pytest.approx(early + 0.002)


def test_reference_goes_on_while_an_impact_is_late(robot, step):
    tracker = Tracker(Nodes.of(step, robot), robot, TrackingSettings(remedy='event'))
    end = step.phases[0].end
    tracker.torque(0.0, 'inner', step.states[0])
    tracker.torque(end + 0.05, 'inner', step.phases[0].states[-1])
    assert tracker.s == pytest.approx(end + 0.05)


def test_phase_is_drawn_to_the_closest_point(robot, step):
    tracker = Tracker(Nodes.of(step, robot), robot, TrackingSettings(remedy='phase', pull=20.0))
    tracker.torque(0.0, 'inner', step.states[0])
    # A robot that is 60 ms ahead of the clock.
    for k in range(1, 200):
        t = 0.002 * k
        tracker.torque(t, 'inner', step.phases[0].at(t + 0.06).state)
    assert tracker.s == pytest.approx(t + 0.06, abs=0.01)


def test_it_starts_anywhere_along_the_motion(robot, step):
    """From a node or between two, and then goes on as if it had come that way."""
    nodes = Nodes.of(step, robot)
    for s in (0.3, step.impact_times[0] + 0.1, step.duration):
        whole, part = Tracker(nodes, robot), Tracker(nodes, robot)
        part.begin(*nodes.locate(s))
        assert part.s == pytest.approx(s)
        point = step.at(s)
        stance = step.modes[step.index_at(s)]
        away = np.array([0.001, -0.001, 0.005, 0.002])
        ended = s == step.duration
        gain = nodes.K[0] if ended else point.gain
        nominal = 0.0 if ended else point.torque
        x = (0 if ended else point.state) + away
        first = part.torque(7.0, stance, x)
        assert first == pytest.approx(nominal - gain @ away, abs=1e-9)
        whole.begin(nodes.first)
        whole.torque(-s, step.modes[0], step.states[0])
        if stance != step.modes[0]:
            whole.torque(-s + step.impact_times[0], stance, step.phases[1].states[0])
        assert whole.torque(0.0, stance, x) == pytest.approx(first, abs=1e-8)
    with pytest.raises(ValueError, match='there are nodes 0 to'):
        part.begin(len(nodes))
    with pytest.raises(ValueError, match='elapsed is -1'):
        part.begin(0, -1.0)


def test_a_landing_that_nobody_planned_gets_no_torque(robot, step):
    tracker = Tracker(Nodes.of(step, robot), robot)
    tracker.begin(tracker.nodes.landing[tracker.nodes.first])
    x = step.phases[1].states[0]
    assert tracker.torque(0.0, 'outer', x) != 0.0
    assert not tracker.left('outer')
    assert tracker.torque(0.002, 'inner', x) == 0.0
    assert tracker.left('inner')
    assert tracker.torque(0.004, 'outer', x) != 0.0


def test_a_trajectory_can_be_entered_in_its_middle(robot, step):
    settings = ExecutionSettings(start_tolerance=0.02)
    gains = balance_gains(robot, settings, 0.002)
    controller = TrajectoryController(BalanceController(robot, settings, gains), robot, settings)
    s = step.impact_times[0] + 0.6
    x = step.at(s).state
    assert controller.step(0, 'outer', x).mode == 'balancing'
    assert 'inner leg, but outer stands' in controller.start(step)
    assert 'from the start' in controller.start(step, at=step.impact_times[0] + 0.01)
    assert 'the trajectory takes' in controller.start(step, at=step.duration + 1.0)
    assert controller.start(step, at=s) == ''
    assert controller.step(2_000_000, 'outer', x).mode == 'tracking'
    assert controller.step(2_000_000 + round((step.duration - s) * 1e9) + 1, 'outer',
                           np.zeros(4)).mode == 'caught'  # fmt: skip


def test_doubt_gives_no_torque(robot, step):
    tracker = Tracker(Nodes.of(step, robot), robot)
    assert tracker.torque(0.0, 'inner', np.array([0, np.nan, 0, 0])) == 0.0
    assert abs(tracker.torque(0.0, 'inner', np.array([9.0, 0, 0, 0]))) <= robot.torque_limit
    with pytest.raises(TrajectoryError, match='plan it again'):
        Nodes.of(step, robot.with_values({'c1': 0.101}))
    assert 'begins on the inner leg, but outer stands' in wrong_leg(step, 'outer')
    assert wrong_leg(step, 'inner') == ''
    with pytest.raises(ValueError, match='remedy'):
        TrackingSettings(remedy='hope')
