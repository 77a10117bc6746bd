"""Virtual constraints on the exact hybrid model: what is on them stays, what is off comes back."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cg_control.orbits.orbit import plan_orbit
from cg_control.orbits.virtual_constraints import BANDWIDTH, VirtualConstraints
from cg_control.trajectories.collocation import planning_model
from cg_control.trajectories.flow import state_rates
from cg_control.trajectories.trajectory import TrajectoryError
from cg_dynamics.rig import STANCES
from cg_dynamics.walking.hybrid import WalkOptions, walk
from cg_dynamics.walking.impact import impact


@pytest.fixture(scope='module')
def walker(robot):
    """The robot with other numbers, legs that differ more and no friction."""
    other = robot.with_values({'c1': robot.values['c1'] * 1.1, 'c5': robot.values['c5'] * 0.95})
    return planning_model(other, friction=False)


@pytest.fixture(scope='module')
def orbit(walker):
    return plan_orbit(walker, 0.35, 0.3)


@pytest.fixture(scope='module')
def law(walker, orbit):
    return VirtualConstraints(orbit.trajectory, walker)


def on_constraint(law, stance, angle, rate):
    """The state (4,) that keeps the constraint of a leg at its angle and rate."""
    st = STANCES.index(stance)
    h, slope, _ = law.constraints[stance].at(np.array([angle]))
    x = np.empty(4)
    x[[st, 1 - st, 2 + st, 3 - st]] = angle, h[0], rate, slope[0] * rate
    return x


def test_constraint_is_that_of_the_orbit_with_its_derivatives(orbit, law):
    step = 1e-5
    for phase in orbit.trajectory.phases:
        y, dy = law.output(phase.stance, phase.states)
        np.testing.assert_allclose(y, 0.0, atol=1e-12)
        np.testing.assert_allclose(dy, 0.0, atol=1e-12)
        constraint = law.constraints[phase.stance]
        angle = np.linspace(constraint.begin + 0.001, constraint.end - 0.001, 40)
        (low, *_), (high, *_) = constraint.at(angle - step), constraint.at(angle + step)
        middle, slope, curvature = constraint.at(angle)
        np.testing.assert_allclose((high - low) / (2 * step), slope, atol=1e-5)
        np.testing.assert_allclose((high - 2 * middle + low) / step**2, curvature, atol=0.05)


@pytest.mark.parametrize('index', [0, 1])
def test_torque_at_the_knots_is_that_of_the_orbit(orbit, law, index):
    phase = orbit.trajectory.phases[index]
    wanted = [law.torque(phase.stance, x) for x in phase.states]
    np.testing.assert_allclose(wanted, phase.torque, atol=1e-8)


@pytest.mark.parametrize('stance', STANCES)
def test_faster_robot_stays_on_the_constraint_through_the_impact(walker, law, stance):
    """The zero dynamics are invariant, and so is the constraint under the impact map."""
    constraint = law.constraints[stance]
    x = on_constraint(law, stance, constraint.begin, 0.6)

    def f(t, y):
        u = np.array([law.torque(stance, y)])
        return state_rates(walker, stance, y[None], u)[0]

    def landed(t, y):
        return y[STANCES.index(stance)] - constraint.end

    landed.terminal = True
    done = solve_ivp(f, (0.0, 2.0), x, rtol=1e-10, atol=1e-11, events=landed)
    assert done.status == 1
    y, dy = law.output(stance, done.y.T)
    np.testing.assert_allclose(y, 0.0, atol=1e-7)
    np.testing.assert_allclose(dy, 0.0, atol=1e-6)
    other = STANCES[1 - STANCES.index(stance)]
    after = impact(walker, stance, done.y[:, -1]).x_plus
    y, dy = law.output(other, after[None])
    assert abs(y[0]) < 1e-7
    assert abs(dy[0]) < 1e-5


@pytest.mark.parametrize('stance', STANCES)
def test_output_dies_out_as_a_damped_spring(walker, law, stance):
    x = on_constraint(law, stance, law.constraints[stance].begin + 0.02, 0.55)
    st = STANCES.index(stance)
    y0, time = 0.01, np.linspace(0.0, 0.25, 6)
    x[1 - st] += y0

    def f(t, y):
        return state_rates(walker, stance, y[None], np.array([law.torque(stance, y)]))[0]

    done = solve_ivp(f, (0.0, 0.25), x, t_eval=time, rtol=1e-9, atol=1e-11)
    y, _ = law.output(stance, done.y.T)
    expected = y0 * (1 + BANDWIDTH * time) * np.exp(-BANDWIDTH * time)
    np.testing.assert_allclose(y, expected, atol=1e-6)


def test_robot_with_friction_walks_along_its_orbit_for_two_periods(robot):
    """What leaves it is that the torque is held for a sample; friction is given back."""
    orbit = plan_orbit(robot, 0.35, 0.3)
    law = VirtualConstraints(orbit.trajectory, robot)
    off = []
    for sample_time in (0.002, 0.0005):
        options = WalkOptions(sample_time=sample_time, step=0.0005, largest_steps=4)
        done = walk(robot, 'inner', orbit.trajectory.states[0], 4.0, law.command, options)
        assert len(done.impacts) == 4
        off.append(np.abs(done.state - orbit.trajectory.states[0]).max())
    assert off[1] < 0.02
    assert off[1] < 0.5 * off[0]


def test_motion_whose_stance_leg_turns_back_is_refused(walker, orbit):
    first, second = orbit.trajectory.phases
    states = first.states.copy()
    states[3, 2] = -0.01
    back = orbit.trajectory.with_phases((replace(first, states=states), second))
    with pytest.raises(TrajectoryError, match='turns back'):
        VirtualConstraints(back, walker)
