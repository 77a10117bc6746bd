"""How strongly data speak for one model against another: theory.md, (EV).

With chi2 the squared simulation error over noise variance, N its number of samples and N_eff the
number of *independent* ones, a model has the evidence (in nats, smaller is better)

    E = N_eff/2 log(chi2/N) + k/2 log(N_eff) + belief/2                              (EV)

The logarithm is the Gaussian likelihood with the size of the error unknown: where a model reaches
the noise it is the usual chi2/2, where model error dominates only ratios count. N_eff comes from
the autocorrelation of what the best model leaves, so that a residual that is one slow wave does
not count as ten thousand proofs. k is the number of parameters that the data determine. `belief`
is the squared distance of the parameters from what the model file believes, in its own standard
deviations.
"""

from collections.abc import Sequence

import numpy as np

TIE = 0.02  # change of chi2/N of a block below which it does not vote
MIN_BLOCKS = 6  # fewer voters decide nothing
CORRELATION_S = 0.2  # of model error: the order of a motion's own
LONGEST_LAG = 1.0  # s; correlation beyond is motion of the whole record, not memory


def correlation_time(residual: np.ndarray, step: float) -> float:
    """Integrated autocorrelation time of a residual in samples, at least 1.

    Args:
        residual: One channel of one record, shape (n,), NaN where there is no sample.
        step: Sampling interval in s.
    """
    r = residual[np.isfinite(residual)]
    if len(r) < 16:
        return 1.0
    n = len(r)
    # A constant misfit is correlated for ever: about zero, not about the mean.
    spectrum = np.abs(np.fft.rfft(r, 2 * n)) ** 2
    covariance = np.fft.irfft(spectrum)[:n]
    if covariance[0] <= 0:
        return 1.0
    rho = covariance / covariance[0]
    last = min(n - 1, max(1, int(LONGEST_LAG / step)))
    # Sum until the correlation is lost in its own scatter (Geyer's rule, simplified).
    below = np.flatnonzero(rho[1 : last + 1] < 2 / np.sqrt(n))
    stop = int(below[0]) if len(below) else last
    return float(1 + 2 * rho[1 : stop + 1].sum())


def weight_of(excess: np.ndarray, step: float) -> np.ndarray:
    """What a sample says beside what the model file believes, where the noise alone would say 1.

    Residuals far above the noise are model error: correlated over many samples, so that each says
    much less than white noise of that size would.

    Args:
        excess: Mean squared residual over noise variance, any shape.
        step: Sampling interval in s.
    """
    excess = np.maximum(1.0, excess)
    together = max(1.0, CORRELATION_S / step)
    return 1 / (excess * (1 + (together - 1) * (1 - 1 / excess)))


def independent_samples(residuals: Sequence[np.ndarray], steps: Sequence[float]) -> float:
    """N_eff: independent samples in the residuals of all records.

    Args:
        residuals: Simulated minus measured of each record, shape (n, ny), over noise.
        steps: Sampling interval of each record in s.
    """
    total = 0.0
    for residual, step in zip(residuals, steps, strict=True):
        for channel in residual.T:
            count = np.isfinite(channel).sum()
            if count:
                total += count / correlation_time(channel, step)
    return max(total, 2.0)


def evidence(
    chi2: float, samples: float, independent: float, parameters: float, belief: float
) -> float:
    """(EV), in nats; smaller is better."""
    return (
        independent / 2 * np.log(chi2 / samples)
        + parameters / 2 * np.log(independent)
        + belief / 2
    )


def block_gain(before: Sequence[np.ndarray], after: Sequence[np.ndarray], rows: int) -> float:
    """How significantly the error fell, in standard errors, by the ranks of blocks of time.

    Wilcoxon's signed ranks, because squared errors have heavy tails: a push shows in few blocks
    but strongly there, and a mean over blocks would drown it in its own scatter. Blocks that
    change by less than a fiftieth of the noise power are ties and do not vote.

    Args:
        before: Residual of each record over noise, shape (n, ny).
        after: The same with the other model.
        rows: Rows per block.
    """
    drops = []
    for a, b in zip(before, after, strict=True):
        blocks = max(1, len(a) // rows)
        for x, y in zip(np.array_split(a, blocks), np.array_split(b, blocks), strict=True):
            seen = np.maximum(np.isfinite(x).sum(axis=0), 1)
            # Summed over outputs: one of them may be all that an effect changes.
            drops.append((np.nansum(x**2 - y**2, axis=0) / seen).sum())
    change = np.array(drops)
    change = change[np.abs(change) > TIE]
    if len(change) < MIN_BLOCKS:
        return 0.0
    from scipy.stats import wilcoxon  # three quarters of a second, in every worker

    return float(wilcoxon(change, alternative='greater', method='approx').zstatistic)
