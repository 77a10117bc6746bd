"""Noise: known sigmas and quanta come back, whatever the motion and the sampling."""

import numpy as np
import pytest

from cg_sysid.records.noise import channel_noise, contrasts, resolution, white_sigma

SEEDS = range(8)


def motion(time):
    """A motion of a radian up to 3 Hz."""
    return np.sin(2 * np.pi * 0.7 * time) + 0.3 * np.sin(2 * np.pi * 3.0 * time + 1.0)


def stamps(rng, count=5000, rate=500.0, jitter=0.0):
    return (np.arange(count) + rng.uniform(-0.5, 0.5, count) * jitter) / rate


@pytest.mark.parametrize('width', [3, 5, 9])
def test_contrasts_vanish_on_polynomials_and_keep_the_variance(width):
    rng = np.random.default_rng(width)
    time = stamps(rng, jitter=0.8)
    polynomial = np.polyval(rng.standard_normal(width - 1), time)
    rounding = 1e-14 * np.abs(polynomial).max()
    np.testing.assert_allclose(contrasts(time, polynomial, width), 0.0, atol=rounding)
    noise = rng.standard_normal(len(time))
    assert np.std(contrasts(time, noise, width)) == pytest.approx(1.0, rel=0.1)


@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize('jitter', [0.0, 0.8])
@pytest.mark.parametrize('sigma', [1e-5, 1e-3, 1e-1])
def test_white_noise_comes_back(seed, jitter, sigma):
    rng = np.random.default_rng(seed)
    time = stamps(rng, jitter=jitter)
    values = motion(time) + sigma * rng.standard_normal(len(time))
    # 78 blocks of 64 overlapping contrasts, the smallest of three widths.
    assert white_sigma(time, values) == pytest.approx(sigma, rel=0.12)


@pytest.mark.parametrize('seed', SEEDS)
def test_impacts_and_rests_do_not_count(seed):
    rng = np.random.default_rng(seed)
    time = stamps(rng)
    values = np.abs(motion(time)) + 0.2 * np.floor(time)
    values += 1e-4 * rng.standard_normal(len(time))
    assert white_sigma(time, values) == pytest.approx(1e-4, rel=0.2)


@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize('counts', [500, 4096, 8192])
def test_the_quantum_comes_back(seed, counts):
    rng = np.random.default_rng(seed)
    quantum = 2 * np.pi / counts
    time = stamps(rng)
    values = quantum * np.rint(motion(time) / quantum)
    assert resolution(values) == pytest.approx(quantum, rel=1e-6)
    noise = channel_noise(time, values)
    assert noise.sigma_floor == pytest.approx(quantum / np.sqrt(12), rel=0.25)


def test_a_value_off_the_grid_does_not_hide_the_quantum():
    time = stamps(np.random.default_rng(0))
    values = np.clip(0.001 * np.rint(motion(time) / 0.001), -0.8004, 0.8004)
    assert resolution(values) == pytest.approx(0.001, rel=1e-3)


@pytest.mark.parametrize('seed', SEEDS)
def test_noise_beyond_the_quantum_is_told_from_it(seed):
    rng = np.random.default_rng(seed)
    quantum = 1e-3
    time = stamps(rng)
    values = motion(time) + 2.0 * quantum * rng.standard_normal(len(time))
    noise = channel_noise(time, quantum * np.rint(values / quantum))
    assert noise.quantum == pytest.approx(quantum, rel=1e-6)
    assert noise.sigma == pytest.approx(2.0 * quantum, rel=0.12)


@pytest.mark.parametrize('seed', SEEDS)
def test_continuous_values_have_no_quantum(seed):
    assert resolution(np.random.default_rng(seed).standard_normal(3000)) == 0.0


@pytest.mark.parametrize('values', [[], [1.0], [1.0] * 50, [0.0, 1.0] * 3])
def test_short_and_constant_signals_have_an_answer(values):
    values = np.array(values)
    noise = channel_noise(np.arange(len(values)) * 0.01, values)
    assert noise.sigma == 0.0
    assert np.isfinite(noise.sigma_floor)
