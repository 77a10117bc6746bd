"""Residuals with rare large ones: Student's t with a scale for each column.

    -2 log L = sum (nu + 1) log(1 + (r/s)^2 / nu) + 2 log s,   nu = 4                          (T)

with s, one for each coordinate, the most likely: a fit is ranked by what it leaves, and by no
weights that another has chosen. NaN is where there is no residual, as of a joint that a set-up
locks; where a simulation ran away it is infinite.
"""

import warnings

import numpy as np

RUN_AWAY = 1e6  # standard deviations, in which no state is that moves with its joint
TAILS = 4.0  # nu of (T)
SCALED = 1e-3  # relative change of s at which it has settled


def spread_of(residual: np.ndarray) -> np.ndarray:
    """Standard deviation of most of the rows, shape (m,)."""
    with warnings.catch_warnings():
        warnings.simplefilter('ignore', RuntimeWarning)  # of a joint that is locked everywhere
        spread = 1.4826 * np.nanmedian(np.abs(residual), axis=0)
    return np.fmax(spread, 1e-12)


def scale_of(residual: np.ndarray) -> np.ndarray:
    """The most likely s of (T), shape (m,): each step of this makes it more likely."""
    scale = spread_of(residual)
    if np.isinf(residual).any():
        return scale
    count = np.maximum(np.isfinite(residual).sum(axis=0), 1)
    settled = False
    while not settled:
        rows = residual / row_scale(residual, scale)
        new = np.maximum(scale * np.sqrt(np.nansum(rows**2, axis=0) / count), 1e-12)
        settled, scale = bool((np.abs(new - scale) < SCALED * scale).all()), new
    return scale


def row_scale(residual: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """By what to divide each residual, that least squares descend (T), shape (rows, m)."""
    return scale * np.sqrt((TAILS + (residual / scale) ** 2) / (TAILS + 1))


def deviance(residual: np.ndarray) -> float:
    """(T) at its most likely s, but for a constant; infinite where a simulation ran away."""
    return float(deviance_by_column(residual).sum())


def deviance_by_column(residual: np.ndarray) -> np.ndarray:
    """The same, as the sum of its columns has it, shape (m,)."""
    if np.isinf(residual).any():
        return np.full(residual.shape[1], np.inf)
    scale = scale_of(residual)
    if np.any(np.abs(residual / scale) >= RUN_AWAY):
        return np.full(len(scale), np.inf)
    count = np.isfinite(residual).sum(axis=0)
    return np.nansum(deviances(residual, scale), axis=0) + 2 * count * np.log(scale)


def deviances(residual: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """(T) of each residual at a given s, but for a constant and log s, shape (rows, m)."""
    return (TAILS + 1) * np.log1p((residual / scale) ** 2 / TAILS)
