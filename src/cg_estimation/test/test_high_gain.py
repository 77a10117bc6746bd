"""The observer: its gain, its convergence, landings, and what samples can do wrong."""

import numpy as np
import pytest

from cg_description.paths import model_path
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.walking.hybrid import walk
from cg_estimation.estimator import replay
from cg_estimation.high_gain import HighGainObserver, sampled_gain

MODEL = Model.load(model_path('compass_gait_mit'))
T_NS = 2_000_000
X0 = np.array([0.05, -0.1, 0.4, -0.8])


def swing(model=MODEL, stance='inner', rows=400, x0=X0):
    """True states, torque and clean readings of a stance phase under a held, varying torque."""
    setup = Setup(stance=stance)
    compiled, p = compile_model(model, setup), parameter_vector(model, setup)
    stamps = np.arange(rows) * T_NS
    torque = 4.0 * np.sin(np.arange(rows) * 0.05)
    u = np.column_stack([torque, *[np.ones(rows)] * (compiled.nu - 1)])
    start = compiled.initial_state(x0, u[0], p)
    states = compiled.simulate(stamps * 1e-9, u, start, p)
    y = compiled.outputs(stamps * 1e-9, u, states, p)
    return stamps, torque, dict(zip(compiled.channels, y.T, strict=True)), states


@pytest.mark.parametrize(('pole', 'rate_gain'), [(-1.0, 1.0), (-1.0 + 1.0j, 2.0)])
def test_gain_for_short_samples_is_that_of_eq_4_17(pole, rate_gain):
    epsilon, T = 0.1, 1e-6
    l1, l2 = sampled_gain(pole, epsilon, T)
    # First order in T / epsilon = 1e-5.
    assert l1 / T == pytest.approx(2.0 / epsilon, rel=1e-4)
    assert l2 / T == pytest.approx(rate_gain / epsilon**2, rel=1e-4)


@pytest.mark.parametrize('pole', [-1.0 + 0.0j, -1.0 + 1.0j])
@pytest.mark.parametrize('T', [0.002, 0.05, 1.0])
def test_gain_places_the_poles_of_the_sampled_error(pole, T):
    epsilon = 0.02
    l1, l2 = sampled_gain(pole, epsilon, T)
    error = (np.eye(2) - np.array([[l1, 0.0], [l2, 0.0]])) @ np.array([[1.0, T], [0.0, 1.0]])
    z = np.exp(pole * T / epsilon)
    # A double pole is known to the root of rounding only.
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(error)), np.sort_complex([z, z.conjugate()]), atol=1e-7
    )


@pytest.mark.parametrize('stance', ['inner', 'outer'])
@pytest.mark.parametrize('form', ['symmetric', 'printed'])
@pytest.mark.parametrize('use_gyro', [False, True])
def test_noiseless_run_converges_to_the_true_rates(stance, form, use_gyro):
    stamps, torque, outputs, states = swing(stance=stance)
    observer = HighGainObserver(MODEL, Setup(stance=stance), 0.02, form, use_gyro)
    estimates = replay(observer, stamps, torque, outputs)
    # 0.8 s at eps = 0.02 s: what is left is rounding and the integrators' difference.
    np.testing.assert_allclose(estimates[-1], states[-1], atol=1e-6)
    # It does start wrong, or nothing would have been shown.
    assert np.abs(estimates[0] - states[0]).max() > 0.1


def test_printed_form_corrects_the_stance_leg_faster():
    """Eq. 4.17 as printed has 2/eps^2 for the stance leg, here the outer one."""
    observers = {
        form: HighGainObserver(MODEL, Setup(stance='outer'), 0.2, form)
        for form in ('symmetric', 'printed')
    }
    moved = {}
    for form, observer in observers.items():
        for k in range(600):
            observer.step(k * T_NS, 0.0, {'imu_angle': 0.0, 'imu_rate': 0.0, 'hip_angle': 0.0})
        # Both legs 1 mrad off what is expected.
        after = observer.step(
            600 * T_NS, 0.0, {'imu_angle': 1e-3, 'imu_rate': 0.0, 'hip_angle': 0.0}
        )
        moved[form] = after.x[2:4]
    # To first order in T / eps = 0.01, and the rotation of the legs' friction is below that.
    np.testing.assert_allclose(moved['printed'] / moved['symmetric'], [1.0, 2.0], rtol=0.02)


@pytest.mark.parametrize('epsilon', [0.02, 0.2])
def test_what_is_not_in_the_model_is_passed_as_eps_says(epsilon):
    """A vibration of the readings moves the rate by |s / (eps s + 1)^2| of it, s = i omega."""
    frictionless = MODEL.without_effect('coulomb_friction').without_effect('viscous_friction')
    stamps, torque = np.arange(1500) * T_NS, np.zeros(1500)
    still = {c: np.zeros(1500) for c in ('imu_angle', 'imu_rate', 'hip_angle')}
    omega, size = 2 * np.pi * 10.0, 1e-4
    shaken = still | {'hip_angle': size * np.sin(omega * stamps * 1e-9)}
    estimates = replay(HighGainObserver(frictionless, Setup(), epsilon), stamps, torque, shaken)
    heard = np.abs(estimates[1200:, 3]).max()
    # Sampling, 0.06 rad of phase per sample, and gravity, (3/63)^2, change it by a few percent.
    assert heard == pytest.approx(size * omega / (1 + (omega * epsilon) ** 2), rel=0.1)


@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_landing_applies_the_impact_map(stance):
    # The swing foot is ahead and falls; after the impact the other leg stands.
    x0 = np.array([0.15, -0.35, 0.9, -0.3])
    if stance == 'outer':
        x0 = x0[[1, 0, 3, 2]]
    motion = walk(MODEL, stance, x0, 0.9)
    assert len(motion.impacts) >= 1
    impact = motion.impacts[0]
    observer = HighGainObserver(MODEL, Setup(stance=stance), 0.02)
    true = []
    for k in range(int(motion.arcs[1].time[-1] * 500) - 1):
        t = k * T_NS * 1e-9
        arc = motion.arcs[0] if t < impact.time else motion.arcs[1]
        x = np.array([np.interp(t, arc.time, column) for column in arc.states.T])
        estimate = observer.step(
            k * T_NS, 0.0, {'imu_angle': x[0], 'imu_rate': x[2], 'hip_angle': x[0] - x[1]},
            arc.stance,
        )  # fmt: skip
        true.append((t, x, estimate))
    after = next(row for row in true if row[0] >= impact.time)
    jump = np.abs(impact.impact.x_plus[2:4] - impact.x[2:4]).max()
    # At the very next sample the rates are those after the impact: what is left is the error
    # before it and a fraction of a sample predicted with the wrong stance.
    assert jump > 0.3
    assert np.abs(after[2].x - after[1])[2:4].max() < 0.1 * jump
    assert after[2].stance == impact.impact.stance != stance


def test_repeated_and_overtaken_samples_change_nothing():
    stamps, torque, outputs, _ = swing(rows=60)
    plain = replay(HighGainObserver(MODEL), stamps, torque, outputs)
    order = [k for i in range(60) for k in ([i, i, i - 3] if i >= 3 else [i])]
    observer = HighGainObserver(MODEL)
    for k in order:
        held = torque[k - 1] if k else 0.0
        last = observer.step(int(stamps[k]), held, {c: y[k] for c, y in outputs.items()})
    np.testing.assert_array_equal(last.x, plain[-1])
    assert observer.ignored == 57


def test_missing_samples_are_predicted_across():
    stamps, torque, outputs, states = _held(3.0)
    keep = np.random.default_rng(1).random(500) > 0.4
    keep[0] = True
    observer = HighGainObserver(MODEL, epsilon=0.05)
    estimates = replay(
        observer, stamps[keep], torque[keep], {c: y[keep] for c, y in outputs.items()}
    )
    # The torque is constant, so that nothing is lost with a sample but its correction.
    np.testing.assert_allclose(estimates[-1], states[keep][-1], atol=1e-5)
    assert observer.restarts == 0


def _held(value, rows=500):
    setup = Setup()
    compiled, p = compile_model(MODEL, setup), parameter_vector(MODEL, setup)
    stamps, torque = np.arange(rows) * T_NS, np.full(rows, value)
    states = compiled.simulate(stamps * 1e-9, torque[:, None], X0, p)
    y = compiled.outputs(stamps * 1e-9, torque[:, None], states, p)
    return stamps, torque, dict(zip(compiled.channels, y.T, strict=True)), states


@pytest.mark.parametrize('silent', ['imu_angle', 'hip_angle'])
def test_a_sensor_that_stutters_costs_accuracy_not_stability(silent):
    stamps, torque, outputs, states = swing(rows=500)
    stuttering = outputs[silent].copy()
    stuttering[np.arange(500) % 5 != 0] = np.nan
    estimates = replay(
        HighGainObserver(MODEL, epsilon=0.05), stamps, torque, outputs | {silent: stuttering}
    )
    np.testing.assert_allclose(estimates[-1], states[-1], atol=1e-4)


def test_blind_time_is_that_of_the_position_longest_unseen():
    observer = HighGainObserver(MODEL)
    observer.step(0, 0.0, {'imu_angle': 0.0, 'imu_rate': 0.0, 'hip_angle': 0.0})
    for k in range(1, 6):
        estimate = observer.step(k * T_NS, 0.0, {'imu_angle': 0.0, 'hip_angle': np.nan})
    assert estimate.blind == pytest.approx(5 * T_NS * 1e-9)
    assert observer.step(6 * T_NS, 0.0, {'imu_angle': 0.0, 'hip_angle': 0.0}).blind == 0.0


def test_long_gap_starts_anew():
    observer = HighGainObserver(MODEL)
    y = {'imu_angle': 0.1, 'imu_rate': 0.2, 'hip_angle': 0.0}
    for k in range(10):
        observer.step(k * T_NS, 0.0, y)
    estimate = observer.step(10**9, 0.0, y)
    assert observer.restarts == 1
    assert estimate.running == 0.0
    np.testing.assert_allclose(estimate.x[:2], 0.1)


def test_a_known_delay_of_the_drive_is_taken_into_account():
    late = MODEL.with_effect('actuator_delay', delay=0.008)
    stamps, torque, outputs, states = swing(late)
    errors = {}
    for name, model in (('knows', late), ('does not', MODEL)):
        estimates = replay(HighGainObserver(model, epsilon=0.1), stamps, torque, outputs)
        errors[name] = np.abs(estimates - states)[-100:, 2:].max()
    assert errors['knows'] < 0.1 * errors['does not']


def test_a_known_delay_of_a_sensor_is_taken_into_account():
    late = MODEL.with_effect('sensor_delay', at='encoder', delay=0.01)
    stamps, torque, outputs, states = swing(late)
    errors = {}
    for name, model in (('knows', late), ('does not', MODEL)):
        estimates = replay(HighGainObserver(model, epsilon=0.05), stamps, torque, outputs)
        errors[name] = np.abs(estimates - states)[-100:, :2].max()
    assert errors['knows'] < 0.2 * errors['does not']


def test_unknown_form_is_refused():
    with pytest.raises(ValueError, match="form is 'other'; allowed are symmetric, printed"):
        HighGainObserver(MODEL, form='other')


def test_nothing_but_a_compass_gait_with_free_legs():
    with pytest.raises(ValueError, match='both legs free'):
        HighGainObserver(MODEL, Setup(fixture='legs_tied'))
