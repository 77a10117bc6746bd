"""Windows in which measured joints move: as long as the noise of their encoders asks."""

from dataclasses import replace

import numpy as np
import pytest
from hanging_arm import SAMPLE, nominal, recorded

from cg_sysid.identification.data_set import DataSet, prepare
from cg_sysid.identification.measured_motion import (
    HALF_WIDTH_S,
    LONGER,
    NOISY,
    motion_of,
    together,
)

NOISE = np.array([8e-5, 2e-4, 1.2e-4])  # rad
DRAWS = 40


@pytest.fixture(scope='module')
def data_set() -> DataSet:
    return prepare(nominal(), [recorded(nominal(), 6.0, 3)])[0]


def noisy(data_set: DataSet, sigma: np.ndarray, seed: int = 0, still: bool = False) -> DataSet:
    """A record whose three encoders are as good as that, of an arm that moves or stands still."""
    outputs = data_set.outputs.copy()
    if still:
        outputs[:, :3] = outputs[0, :3]
    outputs[:, :3] += np.random.default_rng(seed).normal(0.0, sigma, outputs[:, :3].shape)
    own = data_set.sigma.copy()
    own[:3] = sigma
    return replace(data_set, outputs=outputs, sigma=own)


def motion(data_set: DataSet, **how):
    found = motion_of(nominal(), data_set, nominal().mechanism.inputs, **how)
    assert found is not None
    return found


def half_width_s(found) -> float:
    (samples,) = found.records
    return samples.spacing * (len(samples.weights) // 2)


def test_fine_encoders_keep_the_usual_windows(data_set):
    assert half_width_s(motion(noisy(data_set, 1e-2 * NOISE))) == pytest.approx(HALF_WIDTH_S)


def test_coarse_ones_get_windows_in_which_noise_is_small_again(data_set):
    found = motion(noisy(data_set, NOISE))
    assert HALF_WIDTH_S < half_width_s(found) < LONGER * HALF_WIDTH_S
    share = found.spread[0, 6:] / np.sqrt(np.mean(found.acceleration**2, axis=0))
    # The power 5/2 is that of long windows, of which half a width is many samples.
    assert np.max(share) == pytest.approx(NOISY, rel=0.1)


def test_they_have_an_end(data_set):
    found = motion(noisy(data_set, 100 * NOISE))
    assert half_width_s(found) == pytest.approx(LONGER * HALF_WIDTH_S)


def test_joints_that_stand_still_do_not_ask(data_set):
    found = motion(noisy(data_set, 100 * NOISE, still=True))
    assert half_width_s(found) == pytest.approx(HALF_WIDTH_S)


def test_the_windows_of_a_rotor_stay_as_they_are(data_set):
    found = motion(noisy(data_set, 100 * NOISE), shorter=0.5)
    assert half_width_s(found) == pytest.approx(0.5 * HALF_WIDTH_S, abs=SAMPLE)


def test_the_spread_is_that_of_many_draws(data_set):
    draws = [motion(noisy(data_set, NOISE, seed)) for seed in range(DRAWS)]
    assert len({len(found.position) for found in draws}) == 1
    for k, name in enumerate(('position', 'rate', 'acceleration')):
        every = np.array([getattr(found, name) for found in draws])
        seen = np.sqrt(np.mean(np.var(every, axis=0, ddof=1), axis=0))
        # Of some 100 rows, of which neighbours share noise, and 40 draws: 3 % three times over.
        np.testing.assert_allclose(draws[0].spread[0, 3 * k : 3 * k + 3], seen, rtol=0.1)


def test_records_with_windows_of_their_own_stand_one_after_the_other(data_set):
    fine, coarse = motion(noisy(data_set, 1e-2 * NOISE)), motion(noisy(data_set, 100 * NOISE))
    both = together([fine, coarse])
    first = len(fine.position)
    assert np.flatnonzero(both.first).tolist() == [0, first]
    assert both.stride[first] == pytest.approx(LONGER * both.stride[0], rel=0.05)
    np.testing.assert_array_equal(both.acceleration[first:], coarse.acceleration)
    assert both.records == (*fine.records, *coarse.records)
