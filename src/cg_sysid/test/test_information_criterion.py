"""Evidence: its parts against what statistics knows of them."""

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import wilcoxon

from cg_sysid.identification.information_criterion import (
    CORRELATION_S,
    block_gain,
    correlation_time,
    evidence,
    independent_samples,
    weight_of,
)

STEP = 0.002


@pytest.mark.parametrize('memory', [0.0, 0.5, 0.9])
def test_correlation_time_of_a_first_order_process(memory):
    """The sum of rho^|k| over all k is (1 + rho) / (1 - rho)."""
    rng = np.random.default_rng(3)
    times = [
        correlation_time(lfilter([1.0], [1.0, -memory], rng.standard_normal(20_000)), STEP)
        for _ in range(5)
    ]
    # What lies below 2/sqrt(n) is not summed; scatter of the sum over a few hundred lags.
    assert np.mean(times) == pytest.approx((1 + memory) / (1 - memory), rel=0.1)


def test_gaps_and_scraps_have_a_correlation_time():
    rng = np.random.default_rng(4)
    noise = rng.standard_normal(4000)
    noise[rng.random(4000) < 0.5] = np.nan
    assert correlation_time(noise, STEP) == pytest.approx(1.0, abs=0.2)
    assert correlation_time(np.full(4000, np.nan), STEP) == 1.0
    assert correlation_time(np.zeros(4000), STEP) == 1.0


def test_one_slow_wave_is_not_thousands_of_samples():
    time = STEP * np.arange(5000)
    white = np.random.default_rng(5).standard_normal((5000, 1))
    wave = np.sin(2 * np.pi * 0.3 * time)[:, None]
    assert independent_samples([white], [STEP]) > 4000
    assert independent_samples([wave], [STEP]) < 20
    # A channel that nobody recorded adds nothing.
    silent = np.hstack((white, np.full_like(white, np.nan)))
    assert independent_samples([silent], [STEP]) == independent_samples([white], [STEP])


def test_weight_of_noise_and_of_model_error():
    excess = np.array([0.3, 1.0, 2.0, 10.0, 1e4])
    weight = weight_of(excess, STEP)
    np.testing.assert_array_equal(weight[:2], 1.0)
    assert (np.diff(weight[1:]) < 0).all()
    # Far above the noise what lies within one correlation time speaks once.
    assert weight[-1] == pytest.approx(STEP / CORRELATION_S / excess[-1], rel=1e-3)
    # Samples further apart than that are as many words as samples.
    np.testing.assert_allclose(weight_of(excess, CORRELATION_S), 1 / np.maximum(1.0, excess))


def test_at_the_noise_evidence_is_the_usual_chi2_and_bic():
    n = 5000
    worse = evidence(n + 10.0, n, n, 3, 0.0) - evidence(n, n, n, 3, 0.0)
    assert worse == pytest.approx(10.0 / 2, rel=2e-3)  # the next term of the logarithm: 10 / 2n
    assert evidence(n, n, n, 4, 0.0) - evidence(n, n, n, 3, 0.0) == pytest.approx(np.log(n) / 2)
    assert evidence(n, n, n, 3, 4.0) - evidence(n, n, n, 3, 0.0) == pytest.approx(2.0)


def test_block_gain_is_the_signed_rank_statistic():
    rng = np.random.default_rng(6)
    rows, blocks = 50, 40
    before = rng.standard_normal((rows * blocks, 2)) * 1.3
    after = rng.standard_normal((rows * blocks, 2))
    drops = ((before**2 - after**2).reshape(blocks, rows, 2).mean(axis=1)).sum(axis=1)
    known = wilcoxon(drops, method='asymptotic', correction=False)
    found = block_gain([before], [after], rows)
    assert found == pytest.approx(abs(known.zstatistic))
    assert block_gain([after], [before], rows) == pytest.approx(-found)


def test_too_few_blocks_decide_nothing():
    before, after = np.full((500, 1), 2.0), np.full((500, 1), 1.0)
    assert block_gain([before], [after], 100) == 0.0
    assert block_gain([before], [after], 50) > 2.5
    # What changes by less than a fiftieth of the noise does not vote.
    assert block_gain([after * 1.001], [after], 10) == 0.0
