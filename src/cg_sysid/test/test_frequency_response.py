"""Frequency responses: known linear systems first, then who bends, rotor or bracket."""

import numpy as np
import pytest
import yaml
from scipy.signal import cont2discrete, lfilter

from cg_description.paths import model_path
from cg_dynamics.linearise import linearise, without_dry_friction
from cg_dynamics.model import Model
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.frequency_response import (
    analyse,
    flexible_start,
    magnitude_trace,
    main,
    resonance,
    response,
    seat,
)
from cg_sysid.records.bags import write_bag
from cg_sysid.records.record import Record

T = 0.002
SETUP = load_experiment('spring_stabilised_inner').setup
SIGNAL = make_signal(
    ExcitationSettings(kind='multisine', amplitude=5.0, duration=20.0, f_min=1.0, f_max=20.0)
)


def linear_record(noise, seed=0, w0=2 * np.pi * 9.0, zeta=0.05, gain=0.4):
    """A rigid body with one resonance: y'' = gain w0^2 / (s^2 + 2 zeta w0 s + w0^2) u."""
    rng = np.random.default_rng(seed)
    n = 20000
    u = rng.standard_normal(n)
    denominator = np.polymul([1, 2 * zeta * w0, w0**2], [1, 0.6, 0.3])
    b, a, _ = cont2discrete(([gain * w0**2], denominator), T, 'zoh')
    y = lfilter(b.ravel(), a, u) + noise * rng.standard_normal(n)
    stamps = 10**9 + np.arange(n, dtype=np.int64) * 2_000_000
    return Record('linear', stamps, {'hip_torque': u}, {'hip_angle': y}, 'compass_gait')


def expected(f, w0=2 * np.pi * 9.0, zeta=0.05, gain=0.4):
    s = 2j * np.pi * f
    return gain * w0**2 / ((s**2 + 2 * zeta * w0 * s + w0**2) * (s**2 + 0.6 * s + 0.3))


def test_response_of_a_linear_system_and_its_interval():
    inside = []
    for seed in range(5):
        path = response(linear_record(2e-4, seed), 'hip_angle')
        chosen = (path.frequency > 2) & (path.frequency < 15)
        error = np.abs(path.H[chosen]) - np.abs(expected(path.frequency[chosen]))
        inside.append(np.abs(error) < 1.96 * path.sigma[chosen])
    # 95 % by their own account; leakage at the peak and the bias of Welch's method cost some.
    assert 0.85 < np.mean(inside) <= 1.0


def test_coherence_falls_with_noise():
    quiet, loud = (response(linear_record(noise), 'hip_angle') for noise in (1e-6, 3e-3))
    at = np.argmin(np.abs(quiet.frequency - 12.0))
    assert quiet.coherence[at] > 0.9 > 0.5 > loud.coherence[at]


def test_resonance_of_a_linear_system_is_found():
    found = resonance(response(linear_record(1e-5), 'hip_angle'))
    assert found.frequency == pytest.approx(9.0, abs=0.1)
    # The window of 4 s resolves 0.25 Hz; the half width of this peak is 0.45 Hz.
    assert found.damping_ratio == pytest.approx(0.05, rel=0.4)
    assert found.level == pytest.approx(0.4, rel=0.1)


@pytest.fixture(scope='module')
def records():
    def chirped(name):
        machine = Model.load(model_path(name))
        return rehearse(name, machine, SETUP, [0.0, 0.0, 0.0, 0.0], [SIGNAL], 20.0, T, 1)

    return {name: chirped(f'compass_gait_{name}') for name in ('mit', 'flexible', 'imu_mount')}


@pytest.mark.parametrize(
    ('name', 'effect'),
    [
        ('mit', ''),
        ('flexible', 'joint_flexibility'),
        pytest.param('imu_mount', 'imu_mount_flexibility', marks=pytest.mark.evidence),
    ],
)
def test_the_seat_of_a_resonance_is_told_by_the_path_that_has_it(records, name, effect):
    _, found = analyse(records[name])
    assert seat(found)[0] == effect
    for peak in found.values():
        assert peak is None or peak.frequency == pytest.approx(10.6, abs=0.15)


def test_start_for_the_diagnosis_is_close_to_the_truth(records):
    _, found = analyse(records['flexible'])
    rigid, true = (Model.load(model_path(f'compass_gait_{n}')) for n in ('mit', 'flexible'))
    start = flexible_start(rigid, SETUP, found['hip_angle'])
    for name in ('stiffness', 'rotor_inertia', 'damping'):
        ratio = (
            start.values[f'joint_flexibility.{name}'] / true.values[f'joint_flexibility.{name}']
        )
        assert 0.7 < ratio < 1.4, name
    linear = linearise(without_dry_friction(start), SETUP, np.zeros(6), np.zeros(1))
    fastest = np.abs(np.linalg.eigvals(linear.A)).max() / (2 * np.pi)
    assert fastest == pytest.approx(found['hip_angle'].frequency, abs=0.1)


def test_magnitude_trace_is_the_amplitude_of_a_sine():
    t = np.arange(5000) * T
    slow, fast = np.sin(2 * np.pi * 0.1 * t), 0.2 * np.sin(2 * np.pi * 12.0 * t) * (t > 5.0)
    trace = magnitude_trace(slow + fast, T)
    # The 0.1 Hz motion leaves (0.1/5)^4 of itself, after its start.
    assert trace[2000:2500].max() < 0.01
    assert trace[-500:].mean() == pytest.approx(0.2, rel=0.05)


def test_command_line_writes_plot_facts_and_model(records, tmp_path, capsys):
    bag = write_bag(tmp_path / 'bag', records['flexible'])
    out = tmp_path / 'out'
    assert main([str(bag), '--model', str(model_path('compass_gait_mit')), '--out', str(out)]) == 0
    assert 'the encoder resonates at 10.' in capsys.readouterr().out
    facts = yaml.safe_load((out / 'frequency_response.yaml').read_text())
    assert facts['effect'] == 'joint_flexibility'
    assert (out / 'frequency_response.png').stat().st_size > 10_000
    assert 'joint_flexibility.stiffness' in Model.load(out / 'model.yaml').values


def test_command_line_refuses_what_it_cannot_use(records, tmp_path, capsys):
    assert main([str(tmp_path / 'none')]) == 2
    short = write_bag(tmp_path / 'short', records['mit'].slice(0.0, 3.0))
    assert main([str(short)]) == 2
    assert 'two windows of 4 s are needed' in capsys.readouterr().err
