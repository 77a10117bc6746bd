"""Excitation signals: what their spectrum, peak and duration must be."""

import numpy as np
import pytest

from cg_sysid.experiments.excitation import (
    ExcitationSettings,
    crest_factor,
    make_signal,
    multisine_lines,
    playback,
)

DURATION, RATE = 20.0, 500.0
TIMES = np.arange(round(DURATION * RATE)) / RATE


def sampled(**changes):
    signal = make_signal(ExcitationSettings(duration=DURATION, **changes))
    return np.array([signal(time) for time in TIMES])


def test_multisine_has_its_rms_and_stays_in_its_band():
    torque = sampled(kind='multisine', amplitude=6.0, f_min=0.2, f_max=3.0, ramp=0.0)
    assert np.sqrt(np.mean(torque**2)) == pytest.approx(6.0, rel=1e-9)
    power = np.abs(np.fft.rfft(torque)) ** 2
    frequency = np.fft.rfftfreq(len(TIMES), 1.0 / RATE)
    inside = (frequency > 0.19) & (frequency < 3.01)
    assert power[~inside].sum() < 1e-18 * power.sum()
    # Flat: every line carries the same power.
    assert np.ptp(power[inside]) < 1e-9 * power[inside].mean()


@pytest.mark.parametrize('seed', range(10))
def test_multisine_crest_factor_is_modest(seed):
    # A Gaussian signal of this length peaks beyond 4 times its RMS.
    torque = sampled(kind='multisine', seed=seed, f_min=0.1, f_max=2.5)
    assert crest_factor(torque) < 2.9


def test_same_seed_same_signal_other_seed_other_signal():
    np.testing.assert_array_equal(sampled(seed=3), sampled(seed=3))
    assert np.abs(np.corrcoef(sampled(seed=3), sampled(seed=4))[0, 1]) < 0.5


def test_a_band_without_lines_is_refused():
    with pytest.raises(ValueError, match='no harmonic'):
        multisine_lines(1.0, 0.2, 0.8, seed=0)


def test_chirp_sweeps_from_first_to_last_frequency():
    torque = sampled(kind='chirp', amplitude=5.0, f_min=1.0, f_max=20.0, ramp=0.0)
    assert np.abs(torque).max() == pytest.approx(5.0, rel=1e-3)
    rising = TIMES[1:][(torque[:-1] < 0.0) & (torque[1:] >= 0.0)]
    frequency = 1.0 / np.diff(rising)
    assert frequency[0] == pytest.approx(1.5, abs=0.6)
    assert frequency[-1] == pytest.approx(20.0, rel=0.05)


def test_steps_are_held_and_bounded():
    torque = sampled(kind='steps', amplitude=4.0, dwell=0.5, ramp=0.0)
    changes = np.count_nonzero(np.diff(torque))
    assert 20 < changes < 80
    assert np.abs(torque).max() <= 4.0


@pytest.mark.parametrize('kind', ['none', 'multisine', 'chirp', 'steps'])
def test_torque_is_zero_outside_the_duration_and_small_at_its_ends(kind):
    signal = make_signal(ExcitationSettings(kind=kind, duration=2.0, f_min=0.5))
    assert signal(-0.001) == signal(2.0) == signal(100.0) == 0.0
    assert abs(signal(0.002)) < 0.1
    assert abs(signal(1.998)) < 0.1


def test_playback_holds_its_rows(tmp_path):
    file = tmp_path / 'command.csv'
    file.write_text('# a comment\ntime,torque\n0.0,1.0\n0.5,-2.0\n1.0,3.0\n')
    signal = playback(file)
    assert [signal(t) for t in (-0.1, 0.0, 0.49, 0.5, 1.0, 1.01)] == [0, 1, 1, -2, 3, 0]


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('', 'no rows'),
        ('0.0,1.0\nx,y\n', ':2: expected'),
        ('0.0,1.0\n0.0,2.0\n', 'times must grow'),
        ('0.0,nan\n', 'not finite'),
        ('0.0\n1.0\n', ':2: expected'),
    ],
)
def test_a_wrong_command_file_is_refused_with_its_line(tmp_path, text, message):
    file = tmp_path / 'command.csv'
    file.write_text(text)
    with pytest.raises(ValueError, match=message):
        playback(file)


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'kind': 'square'}, 'kind is'),
        ({'f_min': 5.0, 'f_max': 2.0}, 'f_min is'),
        ({'kind': 'file'}, 'file is empty'),
    ],
)
def test_wrong_settings_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        ExcitationSettings(**changes)
