"""TVLQR against solve_ivp, LQR, scipy's exponential and simulated deviations."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from cg_control.balancing.linearise import design_model, linearise_stance
from cg_control.balancing.lqr import lqr
from cg_control.orbits.floquet import multipliers
from cg_control.orbits.orbit import plan_orbit
from cg_control.trajectories.collocation import Options, optimise, planning_model
from cg_control.trajectories.task import Task
from cg_control.trajectories.trajectory import Phase, TrajectoryError
from cg_control.trajectories.tvlqr import (
    Weights,
    balance_regulator,
    exponentials,
    impact_derivative,
    jump_matrix,
    linearised,
    riccati,
    stabilise,
    stabilise_periodically,
)
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.walking.hybrid import WalkOptions, walk


@pytest.fixture(scope='module')
def step(robot):
    return optimise(robot, Task(('inner', 'outer'), reach=0.2), Options(fine=25))


@pytest.mark.parametrize('index', [0, 1])
def test_cost_to_go_is_that_of_the_continuous_equation(robot, step, index):
    phase, weights, design = step.phases[index], Weights(), design_model(robot)
    S_end = balance_regulator(robot, phase.stance).S
    Q, R = weights.Q(phase.stance), weights.R

    def backward(t, s):
        S, point = s.reshape(4, 4), phase.at(t)
        A, B = (m[0] for m in linearised(
            design, phase.stance, point.state[None], np.array([point.torque])
        ))  # fmt: skip
        return -(Q + S @ A + A.T @ S - S @ B @ B.T @ S / R[0, 0]).ravel()

    done = solve_ivp(
        backward, (phase.end, phase.start), S_end.ravel(), rtol=1e-9, atol=1e-9, method='LSODA'
    )
    expected = done.y[:, -1].reshape(4, 4)
    _, costs = riccati(design, phase, Q, R, S_end)
    # Fourth order in intervals of 40 ms; the aim was 1 %.
    np.testing.assert_allclose(costs[0], expected, atol=1e-4 * np.abs(expected).max())


@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_at_the_equilibrium_it_is_lqr(robot, stance):
    """Started at the algebraic solution it stays there; started elsewhere it goes there."""
    time = np.linspace(0.0, 6.0, 121)
    still = Phase(stance, time, np.zeros((121, 4)), np.zeros((121, 4)), np.zeros(121))
    weights, design = Weights(), design_model(robot)
    Q, R = weights.Q(stance), weights.R
    linear = linearise_stance(robot, stance)
    regulator = lqr(linear.A, linear.B, Q, R)
    gains, costs = riccati(design, still, Q, R, regulator.S)
    size = np.abs(regulator.S).max()
    np.testing.assert_allclose(costs[0], regulator.S, atol=1e-9 * size)
    np.testing.assert_allclose(gains[0], regulator.K[0], rtol=1e-8)
    _, costs = riccati(design, still, Q, R, 3 * regulator.S + np.eye(4))
    # The slowest closed-loop mode is a leg swinging at 2.9 rad/s, hardly damped by this cost.
    np.testing.assert_allclose(costs[0], regulator.S, atol=0.02 * size)


def test_exponentials_are_those_of_scipy():
    rng = np.random.default_rng(0)
    for size in (0.01, 1.0, 8.0):
        stack = size * rng.normal(size=(5, 8, 8))
        expected = np.array([expm(matrix) for matrix in stack])
        np.testing.assert_allclose(
            exponentials(stack), expected, atol=1e-11 * np.abs(expected).max()
        )


def test_saltation_is_how_a_deviation_crosses_an_impact(robot, step):
    """Two simulations, nominal and nudged, compared at one instant after both have landed."""
    model = planning_model(robot, friction=False)
    step = optimise(robot, Task(('inner', 'outer'), reach=0.2), Options(fine=25), friction=False)
    before = step.phases[0]
    margin = 0.01
    x = before.at(before.end - margin).state
    torque = before.torque[-1]

    def end(x0, stance):
        options = WalkOptions(step=2.5e-4, sample_time=1.0)
        done = walk(model, stance, x0, 2 * margin, lambda *_: np.array([torque]), options)
        assert len(done.impacts) == 1
        return done

    nominal = end(x, 'inner')
    landing = nominal.impacts[0]
    jump_in = np.empty((4, 4))
    step_size = 1e-5
    for j in range(4):
        nudge = step_size * np.eye(4)[j]
        jump_in[:, j] = (end(x + nudge, 'inner').state - end(x - nudge, 'inner').state) / (
            2 * step_size
        )
    # Flows from the start to the impact and from the impact to the end, by first order.
    design_before = Phase(
        'inner', np.array([0.0, landing.time]),
        np.array([x, landing.x]), np.array([rates(model, 'inner', x, torque),
                                            rates(model, 'inner', landing.x, torque)]),
        np.full(2, torque),
    )  # fmt: skip
    plus = landing.impact.x_plus
    design_after = Phase(
        'outer', np.array([landing.time, 2 * margin]),
        np.array([plus, nominal.state]), np.array([rates(model, 'outer', plus, torque),
                                                   rates(model, 'outer', nominal.state, torque)]),
        np.full(2, torque),
    )  # fmt: skip
    A1 = linearised(model, 'inner', (x + landing.x)[None] / 2, np.array([torque]))[0][0]
    A2 = linearised(model, 'outer', (plus + nominal.state)[None] / 2, np.array([torque]))[0][0]
    first = expm(A1 * landing.time)
    second = expm(A2 * (2 * margin - landing.time))
    jump = jump_matrix(model, design_before, design_after)
    # The midpoint flows err by the cube of 10 ms.
    np.testing.assert_allclose(second @ jump @ first, jump_in, atol=5e-3)
    # Without the term of the instant it would be wrong by much more than that.
    plain = second @ impact_derivative(model, design_before) @ first
    assert np.abs(plain - jump_in).max() > 0.1


def rates(model, stance, x, torque):
    setup = Setup(stance=stance)
    return np.asarray(
        compile_model(model, setup).f(x, [torque], parameter_vector(model, setup))
    ).ravel()


def test_gains_change_sign_with_the_stance_leg(robot, step):
    done = stabilise(step, robot)
    first, last = done.phases[0].gains[0], done.phases[1].gains[-1]
    assert first[0] > 0 > last[1]
    for phase in done.phases:
        assert np.linalg.eigvalsh(phase.cost_to_go).min() > 0


def test_trajectory_of_another_model_is_refused(robot, step):
    with pytest.raises(TrajectoryError, match='plan it again'):
        stabilise(step, robot.with_values({'c1': 0.101}))
    with pytest.raises(ValueError, match='final_cost must be'):
        stabilise(step, robot, final_cost=np.eye(3))
    with pytest.raises(ValueError, match='torque is 0'):
        Weights(torque=0.0)


def test_a_weak_motor_that_is_known_gets_larger_gains(robot):
    """Half the torque per command wants more gain, and not twice as much: a command costs."""
    weak = robot.with_effect('torque_constant', error=-0.5)
    task = Task(('inner', 'outer'), reach=0.2)
    first, second = (
        stabilise(optimise(model, task, Options(fine=25), friction=False), model)
        for model in (robot, weak)
    )
    # One is a motor that nobody knows of, two the same torque at any price.
    assert 1.1 < second.phases[0].gains[0][0] / first.phases[0].gains[0][0] < 2.0


@pytest.fixture(scope='module')
def gait(robot):
    return plan_orbit(robot, 0.35, 0.3)


@pytest.mark.parametrize('restarts', [False, True])
def test_cost_to_go_of_an_orbit_repeats_itself(robot, gait, restarts):
    done = stabilise_periodically(gait.trajectory, robot, restarts=restarts)
    first, last = done.phases[0], done.phases[-1]
    jump = jump_matrix(design_model(robot), last, first, restarts=restarts)
    S = jump.T @ first.cost_to_go[0] @ jump
    np.testing.assert_allclose(last.cost_to_go[-1], S, atol=1e-6 * np.abs(S).max())
    if not restarts:
        again = stabilise(gait.trajectory, robot, final_cost=(S + S.T) / 2)
        for one, other in zip(again.phases, done.phases, strict=True):
            size = np.abs(other.cost_to_go).max()
            np.testing.assert_allclose(one.cost_to_go, other.cost_to_go, atol=1e-6 * size)


def test_periodic_gains_hold_what_a_restarting_clock_says(robot, gait):
    """Multipliers by (RESTART) are those of another module, and inside the unit circle."""
    done = stabilise_periodically(gait.trajectory, robot, restarts=True)
    values = multipliers(replace(gait, trajectory=done), feedback=True)
    assert np.abs(values).max() < 0.5 < np.abs(multipliers(gait)).max()


def test_motion_that_ends_is_no_orbit(robot, step):
    with pytest.raises(TrajectoryError, match='not periodic'):
        stabilise_periodically(step, robot)
