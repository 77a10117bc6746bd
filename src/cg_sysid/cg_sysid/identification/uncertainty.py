"""How sure identified values are: theory.md, (COV)."""

import numpy as np

from cg_sysid.identification.simulation_error import (
    Point,
    Problem,
    Trial,
    reduced,
    solve,
)

SCORE_BLOCK = 0.25  # s; longer than most residuals are correlated


def uncertainty(
    problem: Problem, trial: Trial | None, weight: float
) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
    """How sure the values are: theory.md, (COV).

    Args:
        problem: What was minimised.
        trial: The simulations at the minimum; None where they run away.
        weight: Of the residual in the cost.

    Returns:
        Covariance of the coordinates (k, k), the share of each that comes from data (k,), and
        the standard deviations of what each data set has of its own behind its initial motion: how
        far extra states are from settled, and its own values.

    Two estimates, and the larger one counts: the curvature scaled by the size of the residual,
    right for white residuals, and the sandwich of scores summed over blocks longer than their
    correlation, right where the model leaves slow waves.
    """
    point, k = trial.point(weight) if trial is not None else None, len(problem.unknowns)
    if trial is None or point is None:
        return np.zeros((k, k)), np.zeros(k), _unknown(problem)
    excess = max(1.0, point.sse.sum() / point.count.sum())
    rescale = 1 / (excess * weight)
    if not k and not any(map(len, _unknown(problem))):
        return np.zeros((0, 0)), np.zeros(0), _unknown(problem)
    sums = [rescale * rows for rows in _block_scores(trial, weight)]
    covariance, information = np.zeros((0, 0)), np.zeros(0)
    if k:
        covariance, information = _of_shared(problem, point, sums, rescale)
    return covariance, information, _own_sigmas(problem, point, sums, covariance, rescale)


def _of_shared(
    problem: Problem, point: Point, sums: list[np.ndarray], rescale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of the shared unknowns and the share of each that comes from data."""
    belief = np.array(
        [1 / u.tolerance**2 if np.isfinite(u.tolerance) else 0.0 for u in problem.unknowns]
    )
    h, _, _ = reduced(point, 0.0)
    h = (h - np.diag(belief)) * rescale + np.diag(belief)
    inverse, lost = _inverse(h)
    scores = np.vstack(_of_shared_alone(problem, point, sums))
    sandwich = inverse @ (scores.T @ scores + np.diag(belief)) @ inverse
    ratio = _widening(sandwich, inverse)
    covariance = inverse * np.outer(ratio, ratio)
    covariance[lost, lost] = np.inf
    certain = np.where(belief > 0, np.diag(covariance), 0.0)
    information = 1 - np.clip(certain * belief, 0, 1)
    information[lost] = 0.0
    return covariance, information


def _widening(sandwich: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Standard deviations by the sandwich over those by curvature, where they are larger.

    1 for what the curvature does not tell at all: its variance is not taken from here.
    """
    curvature = np.diag(inverse)
    told = curvature > np.finfo(float).tiny
    return np.sqrt(np.maximum(np.diag(sandwich) / np.where(told, curvature, np.inf), 1.0))


def not_asked(problem: Problem) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, ...]]:
    """In place of `uncertainty` where nobody asks for it: NaN, and starts as they are believed."""
    k = len(problem.unknowns)
    return (
        np.full((k, k), np.nan), np.full(k, np.nan),
        tuple(np.ones_like(own) for own in _unknown(problem)),
    )  # fmt: skip


def _own_sigmas(
    problem: Problem,
    point: Point,
    sums: list[np.ndarray],
    covariance: np.ndarray,
    rescale: float,
) -> tuple[np.ndarray, ...]:
    """Standard deviation of each data set's own values, what is shared being uncertain too."""
    found = list(_unknown(problem))
    if not any(map(len, found)):
        return tuple(found)
    shared = np.where(np.isfinite(covariance), covariance, 0.0)
    for block, (own, cross, _) in zip(problem.blocks, point.own, strict=True):
        inverse = solve(own, np.eye(len(own))) / rescale
        scatter = np.zeros_like(inverse)
        for i, place in zip(block.data_sets, block.places, strict=True):
            scores = sums[i][:, : len(place)]
            scatter[np.ix_(place, place)] += scores.T @ scores
        ratio = _widening(inverse @ scatter @ inverse, inverse)
        moved = solve(own, cross)
        spread = inverse * np.outer(ratio, ratio) + moved @ shared @ moved.T
        sigmas = np.sqrt(np.maximum(np.diag(spread), 0.0))
        for i, place in zip(block.data_sets, block.places, strict=True):
            found[i] = sigmas[place][len(problem.data_sets[i].motion) :]
    return tuple(found)


def _unknown(problem: Problem) -> tuple[np.ndarray, ...]:
    return tuple(
        np.zeros(len(guess) - len(data_set.motion))
        for guess, data_set in zip(problem.guesses, problem.data_sets, strict=True)
    )


def _inverse(h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of the curvature, and which unknowns it leaves undetermined."""
    diagonal = np.diag(h)
    scale = np.sqrt(np.where(diagonal > 1e-200 * diagonal.max(), diagonal, 1.0))
    eigenvalues, vectors = np.linalg.eigh(h / np.outer(scale, scale))
    # A direction that neither data nor belief determine has infinite variance, not a crash.
    kept = eigenvalues > 1e-13 * eigenvalues.max()
    inverse = (vectors[:, kept] / eigenvalues[kept]) @ vectors[:, kept].T
    lost = (vectors[:, ~kept] ** 2).sum(axis=1) > 1e-6
    return inverse / np.outer(scale, scale), lost


def _of_shared_alone(problem: Problem, point: Point, sums: list[np.ndarray]) -> list[np.ndarray]:
    """Scores of the shared unknowns, with all else where it is best for them."""
    # What moves of each data set's own with what is shared, shape (own, k).
    follows: dict[int, np.ndarray] = {}
    for block, (own, cross, _) in zip(problem.blocks, point.own, strict=True):
        solved = solve(own, cross)
        follows |= {i: solved[p] for i, p in zip(block.data_sets, block.places, strict=True)}
    return [
        rows[:, len(follows[i]) :] - rows[:, : len(follows[i])] @ follows[i]
        for i, rows in enumerate(sums)
    ]


def _block_scores(trial: Trial, weight: float) -> list[np.ndarray]:
    """Gradient of each data set's cost, block by block of time: its own, then what is shared."""
    problem = trial.problem
    chain = problem.chain(problem.values(trial.theta))
    found = []
    for data_set, motion, followed in zip(
        problem.data_sets, trial.motions, trial.followed, strict=True
    ):
        n, (_, y, jacobian) = followed.rows, followed.normal(keep=True)
        assert y is not None
        assert jacobian is not None
        residual = np.nan_to_num((y - data_set.outputs[:n]) / data_set.sigma**2) * weight
        rows = np.einsum('kj,kjc->kc', residual, jacobian)
        edges = np.arange(0, n, max(1, int(n * SCORE_BLOCK / max(data_set.time[n - 1], 1e-9))))
        sums = np.add.reduceat(rows, edges, axis=0)
        sums[:, len(motion) :] *= chain
        found.append(sums)
    return found
