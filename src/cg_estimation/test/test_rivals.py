"""Kalman filters and filtered derivatives: what each must do on data where the truth is known."""

import numpy as np
import pytest
from scipy.signal import sosfilt, sosfilt_zi

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup
from cg_estimation.derivative import Chebyshev, Derivative, FirstOrder
from cg_estimation.estimator import replay
from cg_estimation.high_gain import HighGainObserver
from cg_estimation.kalman import ExtendedKalmanFilter, SteadyKalmanFilter
from cg_estimation.observer_settings import METHODS, ObserverSettings, make_estimator

MODEL = Model.load(model_path('compass_gait_mit'))
T = 0.002


@pytest.fixture(scope='module')
def recording():
    """Two seconds on springs would be long; here a fall from a lean, with real sensors."""
    plant = Plant(MODEL, Setup(), np.array([-0.15, 0.1, 0.5, 0.0]), T, seed=3)
    stamps, torque, readings, states = [], [], [], []
    for k in range(500):
        measurement = plant.measure()
        u = 5.0 * np.sin(8.0 * k * T)
        plant.latch(np.array([u]))
        stamps.append(measurement.time_ns)
        torque.append(u)
        readings.append(measurement.outputs)
        states.append(measurement.state)
        plant.advance()
    outputs = {c: np.array([r[c] for r in readings]) for c in readings[0]}
    return np.array(stamps), np.array(torque), outputs, np.array(states)


def rate_error(estimator, recording):
    stamps, torque, outputs, states = recording
    estimates = replay(estimator, stamps, torque, outputs)
    return np.sqrt(np.mean((estimates[150:, 2:4] - states[150:, 2:4]) ** 2))


def test_models_beat_differences_and_nonlinear_ones_beat_linear_ones(recording):
    errors = {
        'raw': rate_error(Derivative(MODEL), recording),
        'first_order': rate_error(Derivative(MODEL, kind='first_order', cutoff_hz=10), recording),
        'steady': rate_error(SteadyKalmanFilter(MODEL), recording),
        'extended': rate_error(ExtendedKalmanFilter(MODEL, disturbance=1.0), recording),
        'high_gain': rate_error(HighGainObserver(MODEL, epsilon=0.1), recording),
    }
    assert errors['raw'] > 2 * errors['first_order'] > 2 * errors['steady']
    assert errors['steady'] > 2 * errors['extended']
    assert errors['steady'] > 2 * errors['high_gain']


def test_extended_kalman_filter_knows_how_wrong_it_is(recording):
    stamps, torque, outputs, states = recording
    kalman = ExtendedKalmanFilter(MODEL, disturbance=1.0)
    distances = []
    for k, stamp in enumerate(stamps):
        held = torque[k - 1] if k else 0.0
        estimate = kalman.step(int(stamp), held, {c: y[k] for c, y in outputs.items()})
        error = estimate.x - states[k]
        distances.append(error @ np.linalg.solve(kalman._P, error))
    # Chi-squared of four freedoms has mean 4; the plant has no disturbance but the filter expects
    # one, so it must not be overconfident and may be somewhat shy.
    assert 0.3 < np.mean(distances[100:]) < 6.0


def test_steady_gain_is_the_limit_of_the_extended_filter():
    """On the frictionless robot at rest upright both are the same filter."""
    frictionless = MODEL.without_effect('coulomb_friction')
    steady = SteadyKalmanFilter(frictionless, disturbance=20.0)
    extended = ExtendedKalmanFilter(frictionless, disturbance=20.0)
    still = {'imu_angle': 0.0, 'imu_rate': 0.0, 'hip_angle': 0.0}
    for filter_ in (steady, extended):
        for k in range(500):
            filter_.step(k * 2_000_000, 0.0, still)
    knock = still | {'imu_angle': 1e-5, 'hip_angle': -2e-5}
    moved = [filter_.step(500 * 2_000_000, 0.0, knock).x for filter_ in (steady, extended)]
    # The one discretises with the exponential, the other with Runge-Kutta: T^2 times the rates.
    np.testing.assert_allclose(moved[0], moved[1], rtol=1e-3, atol=1e-9)


def test_landing_moves_the_covariance_along(recording):
    stamps, _, outputs, _ = recording
    kalman = ExtendedKalmanFilter(MODEL)
    for k in range(100):
        kalman.step(int(stamps[k]), 0.0, {c: y[k] for c, y in outputs.items()}, 'inner')
    estimate = kalman.step(int(stamps[100]), 0.0, {c: y[100] for c, y in outputs.items()}, 'outer')
    assert estimate.stance == 'outer'
    np.testing.assert_allclose(kalman._P, kalman._P.T, atol=1e-15)
    assert np.linalg.eigvalsh(kalman._P).min() > 0


def test_chebyshev_is_scipys_filter_settled_at_the_first_value():
    signal = 0.3 + np.cumsum(np.random.default_rng(2).standard_normal(200))
    ours = Chebyshev(20.0, signal[:1], T)
    filtered = [signal[0], *(ours.step(signal[k : k + 1], T)[0] for k in range(1, 200))]
    start = sosfilt_zi(ours.sections) * signal[0]
    theirs, _ = sosfilt(ours.sections, signal, zi=start)
    np.testing.assert_allclose(filtered, theirs, atol=1e-10)


def test_first_order_filter_decays_as_its_cutoff_says_at_any_interval():
    whole, parts = FirstOrder(3.0, np.ones(1)), FirstOrder(3.0, np.ones(1))
    whole.step(np.zeros(1), 0.1)
    for _ in range(20):
        parts.step(np.zeros(1), 0.005)
    assert whole.value[0] == pytest.approx(np.exp(-2 * np.pi * 3.0 * 0.1), rel=1e-12)
    assert parts.value[0] == pytest.approx(whole.value[0], rel=1e-12)


@pytest.mark.parametrize('use_gyro', [False, True])
def test_derivative_of_a_steady_turn_is_its_rate(use_gyro):
    derivative = Derivative(MODEL, use_gyro=use_gyro)
    for k in range(20):
        t = k * T
        y = {'imu_angle': 0.3 * t, 'imu_rate': 0.3, 'hip_angle': 0.3 * t - 0.7 * t}
        x = derivative.step(round(t * 1e9), 0.0, y).x
    np.testing.assert_allclose(x, [0.3 * t, 0.7 * t, 0.3, 0.7], atol=1e-9)


@pytest.mark.parametrize('method', METHODS)
def test_every_method_runs_from_settings(method, recording):
    estimator = make_estimator(ObserverSettings(method=method), MODEL, Setup())
    stamps, torque, outputs, _ = recording
    states = replay(estimator, stamps[:50], torque[:50], {c: y[:50] for c, y in outputs.items()})
    assert states.shape == (50, 4)
    assert np.isfinite(states).all()
