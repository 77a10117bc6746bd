"""The balance controller: law, conditions, hand-over; friction compensation; basins."""

import dataclasses
import math

import numpy as np
import pytest

from cg_control.balancing.balance import (
    BALANCING,
    FALLEN,
    IDLE,
    BalanceController,
    BalanceSettings,
    balance_gains,
    slow_modes,
)
from cg_control.balancing.basin import SWINGS, Basin, modes_of, sample_basin, shipped_basins
from cg_control.balancing.linearise import design_model, linearise_stance
from cg_control.balancing.lqr import LqrError
from cg_control.friction import FrictionCompensation, FrictionSettings
from cg_description.paths import model_path
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model

MODEL = Model.load(model_path('compass_gait_mit'))
FLEXIBLE = Model.load(model_path('compass_gait_flexible'))
T, T_NS = 0.002, 2_000_000
SETTINGS = BalanceSettings()
GAINS = balance_gains(MODEL, SETTINGS, T)
BASINS = shipped_basins(MODEL, GAINS, MODEL.torque_limit)


def controller(**changes):
    settings = dataclasses.replace(SETTINGS, **changes)
    return BalanceController(MODEL, settings, GAINS, BASINS)


# Gains and modes


@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_modes_diagonalise_the_frictionless_robot(stance):
    modes = modes_of(MODEL, stance)
    frictionless = design_model(MODEL).without_effect('viscous_friction')
    A = modes.to_modes @ linearise_stance(frictionless, stance).A @ modes.to_state
    up, down, turn = A[0, 0], A[1, 1], A[2, 3]
    expected = np.zeros((4, 4))
    expected[0, 0], expected[1, 1], expected[2, 3], expected[3, 2] = up, down, turn, -turn
    np.testing.assert_allclose(A, expected, atol=1e-9)
    assert up == pytest.approx(-down)
    assert 3.0 < up < 3.3
    # Legs parallel and at rest lean by exactly the capture coordinate.
    assert modes.split(np.array([0.04, 0.04, 0.0, 0.0]))[0] == pytest.approx(0.04)


@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_slow_modes_of_an_elastic_robot_leave_its_vibration_alone(stance):
    linear = linearise_stance(FLEXIBLE, stance, elastic=True)
    gain = balance_gains(FLEXIBLE, SETTINGS, T, elastic=True)[stance]
    before = np.linalg.eigvals(linear.A)
    after = np.linalg.eigvals(linear.A - linear.B @ gain[None])
    vibration = before[np.abs(before.imag) > 30]
    found = after[np.abs(after.imag) > 30]
    np.testing.assert_allclose(np.sort_complex(found), np.sort_complex(vibration), rtol=1e-8)
    assert after.real.max() < 0 < before.real.max()


def test_a_rigid_model_has_no_other_modes():
    to_slow, from_slow = slow_modes(linearise_stance(MODEL, 'inner').A)
    np.testing.assert_array_equal(to_slow @ from_slow, np.eye(4))


def test_scales_without_a_regulator_name_the_leg():
    weightless = dataclasses.replace(SETTINGS, torque_scale=1e-6)
    with pytest.raises(LqrError, match='no gains for the inner leg as stance'):
        balance_gains(MODEL, weightless, T)


# Conditions


def test_engages_inside_the_basin_only():
    outside, inside = np.array([0.2, 0.2, 0, 0]), np.array([0.06, 0.06, 0, 0])
    balance = controller()
    command = balance.step(0, 'inner', outside)
    assert (command.torque, command.mode) == (0.0, IDLE)
    assert 'outside the basin' in command.reason
    assert balance.step(T_NS, 'inner', inside).mode == BALANCING
    # Once engaged it does not let go for being pushed out.
    assert balance.step(2 * T_NS, 'inner', outside).mode == BALANCING


@pytest.mark.parametrize(
    'x', [np.array([0.5, 0.0, 0, 0]), np.array([0.0, 1.8, 0, 0])], ids=['lean', 'swing']
)
def test_a_fall_ends_it_until_it_is_armed_again(x):
    balance = controller()
    balance.step(0, 'inner', np.zeros(4))
    assert balance.step(T_NS, 'inner', x).mode == FALLEN
    assert balance.falls == 1
    assert balance.step(2 * T_NS, 'inner', np.zeros(4)).torque == 0.0
    balance.adopt(dataclasses.replace(SETTINGS, armed=False))
    assert balance.step(3 * T_NS, 'inner', np.zeros(4)).mode == IDLE
    balance.adopt(SETTINGS)
    assert balance.step(4 * T_NS, 'inner', np.zeros(4)).mode == BALANCING


@pytest.mark.parametrize('bad', [math.nan, math.inf])
def test_a_state_that_is_not_finite_gives_zero_torque(bad):
    balance = controller(hand_over=0.0)
    assert balance.step(0, 'inner', np.array([0.05, 0.05, 0, 0])).torque != 0.0
    command = balance.step(T_NS, 'inner', np.array([0.05, bad, 0, 0]))
    assert (command.torque, command.mode) == (0.0, IDLE)
    assert 'not finite' in command.reason


def test_torque_never_leaves_its_limit():
    balance = controller(torque_limit=7.0, friction_compensation=True)
    rng = np.random.default_rng(4)
    torques = [
        balance.step(k * T_NS, 'inner', rng.uniform(-0.2, 0.2, 4)).torque if k else
        balance.step(0, 'inner', np.zeros(4)).torque
        for k in range(200)
    ]  # fmt: skip
    assert max(map(abs, torques)) == 7.0


# Hand-over


def test_torque_starts_from_zero_and_approaches_the_law():
    balance = controller(hand_over=0.02)
    x = np.array([0.005, 0.005, 0.0, 0.0])
    law = -float(GAINS['inner'] @ x)
    torques = [balance.step(k * T_NS, 'inner', x).torque for k in range(100)]
    assert torques[0] == pytest.approx(0.0, abs=1e-12)
    assert torques[10] == pytest.approx(law * (1 - math.exp(-1.0)), rel=1e-9)
    assert torques[99] == pytest.approx(law, rel=1e-4)


def test_new_gains_and_a_new_stance_leg_do_not_make_the_torque_jump():
    balance = controller(hand_over=0.02)
    x = np.array([0.004, 0.004, 0.0, 0.0])
    for k in range(200):
        before = balance.step(k * T_NS, 'inner', x).torque
    softer = dataclasses.replace(SETTINGS, lean_scale=0.2, lean_rate_scale=0.5)
    balance.adopt(softer, balance_gains(MODEL, softer, T))
    assert balance.step(200 * T_NS, 'inner', x).torque == pytest.approx(before, abs=1e-9)
    before = balance.step(201 * T_NS, 'inner', x).torque
    assert balance.step(202 * T_NS, 'outer', x).torque == pytest.approx(before, abs=1e-9)
    for k in range(203, 400):
        after = balance.step(k * T_NS, 'outer', x).torque
    # The same lean asks for the other sign on the other leg.
    assert after * before < 0


def test_output_filter_is_first_order():
    balance = controller(hand_over=0.0, output_filter_hz=5.0)
    x = np.array([0.005, 0.005, 0.0, 0.0])
    balance.step(0, 'inner', np.zeros(4))
    torques = [balance.step(k * T_NS, 'inner', x).torque for k in range(1, 60)]
    law = -float(GAINS['inner'] @ x)
    expected = law * (1 - np.exp(-2 * np.pi * 5.0 * T * np.arange(1, 60)))
    np.testing.assert_allclose(torques, expected, rtol=1e-9)


# Friction


def test_friction_is_what_the_simulation_takes():
    friction = FrictionCompensation(MODEL)
    setup = Setup()
    bare = MODEL.without_effect('coulomb_friction').without_effect('viscous_friction')
    for rate in (-1.3, -0.02, 0.004, 0.7):
        x = np.array([0.1, -0.1, rate / 2, -rate / 2])
        accelerations = [
            np.asarray(compile_model(m, setup).f(x, u, parameter_vector(m, setup))).ravel()[2:]
            for m, u in ((MODEL, friction.taken(0.2, rate)), (bare, 0.0))
        ]
        np.testing.assert_allclose(accelerations[0], accelerations[1], atol=1e-10)


def test_compensation_is_off_by_default_and_keeps_deadband_share_and_limit():
    friction = FrictionCompensation(MODEL)
    assert friction.torque(0.0, 1.0, FrictionSettings()) == 0.0
    on = FrictionSettings(
        friction_compensation=True, friction_share=0.8, friction_deadband=0.05, friction_limit=2.0
    )
    assert friction.torque(0.0, 0.05, on) == 0.0
    assert friction.torque(0.0, 0.075, on) == pytest.approx(0.5 * 0.8 * friction.taken(0.0, 0.075))
    # 1.84 + 0.694 rate N m passes 2 N m at 0.23 rad/s.
    assert friction.torque(0.0, 1.0, on) == pytest.approx(0.8 * 2.0)
    assert friction.torque(0.0, -1.0, on) == pytest.approx(-0.8 * 2.0)


# Basins


def test_shipped_basins_are_of_these_gains_and_hold_the_promised_lean():
    assert BASINS is not None
    for basin in BASINS.values():
        assert basin.depth(np.array([0.06, 0.06, 0.0, 0.0])) <= 1.0
        assert list(basin.bounds) == sorted(basin.bounds, reverse=True)
    other = balance_gains(MODEL, dataclasses.replace(SETTINGS, lean_scale=0.08), T)
    assert shipped_basins(MODEL, other, MODEL.torque_limit) is None
    assert shipped_basins(MODEL, GAINS, 30.0) is None
    assert shipped_basins(FLEXIBLE, GAINS, MODEL.torque_limit) is None


def test_drawn_states_are_inside_and_fill_it():
    basin = Basin(modes_of(MODEL, 'outer'), (0.06, 0.05, 0.04, 0.03))
    rng = np.random.default_rng(0)
    depths = [basin.depth(basin.draw(rng)) for _ in range(300)]
    assert max(depths) <= 1.0 + 1e-9
    assert max(depths) > 0.95
    assert basin.depth(basin.modes.state(0.0, 0.0, SWINGS[-1] + 0.01, 0.0)) == math.inf


def test_weak_motor_has_a_small_basin(monkeypatch):
    # Few samples: what is tested is the sampling, not the number.
    for name, value in (('SWINGS', (0.0,)), ('SAMPLES', 4), ('HALVINGS', 4), ('DURATION', 3.0)):
        monkeypatch.setattr(f'cg_control.balancing.basin.{name}', value)
    strong, weak = (
        sample_basin(MODEL, 'inner', GAINS['inner'], limit).bounds[0] for limit in (40.0, 10.0)
    )
    # The unstable mode alone can be held up to |w'B| limit / lambda: a quarter for a quarter.
    assert 0.0 < weak < 0.4 * strong
