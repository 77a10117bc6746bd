"""Residuals with rare large ones: Student's t with a scale for each column.

    -2 log L = sum (nu + 1) log(1 + (r/s)^2 / nu) + 2 log s,   nu = 4                          (T)

with s, one for each coordinate, the most likely: a fit is ranked by what it leaves, and by no
weights that another has chosen.
"""

import numpy as np

RUN_AWAY = 1e6  # standard deviations, in which no state is that moves with its joint
TAILS = 4.0  # nu of (T)
SCALED = 1e-3  # relative change of s at which it has settled


def spread_of(residual: np.ndarray) -> np.ndarray:
    """Standard deviation of most of the rows, shape (m,)."""
    return np.maximum(1.4826 * np.median(np.abs(residual), axis=0), 1e-12)


def scale_of(residual: np.ndarray) -> np.ndarray:
    """The most likely s of (T), shape (m,): each step of this makes it more likely."""
    scale = spread_of(residual)
    if not np.isfinite(residual).all():
        return scale
    settled = False
    while not settled:
        rows = residual / row_scale(residual, scale)
        new = np.maximum(scale * np.sqrt(np.mean(rows**2, axis=0)), 1e-12)
        settled, scale = bool((np.abs(new - scale) < SCALED * scale).all()), new
    return scale


def row_scale(residual: np.ndarray, scale: np.ndarray) -> np.ndarray:
    """By what to divide each residual, that least squares descend (T), shape (rows, m)."""
    return scale * np.sqrt((TAILS + (residual / scale) ** 2) / (TAILS + 1))


def deviance(residual: np.ndarray) -> float:
    """(T) at its most likely s, but for a constant."""
    scale = scale_of(residual)
    with np.errstate(invalid='ignore'):
        size = np.abs(residual / scale)
    if not np.all(size < RUN_AWAY):
        return np.inf
    each = (TAILS + 1) * np.log1p(size**2 / TAILS)
    return float(each.sum() + 2 * len(residual) * np.log(scale).sum())
