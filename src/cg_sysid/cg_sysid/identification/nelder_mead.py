"""Reference identification by a simplex search, as in the source text (Eq. 4.13, `fminsearch`).

The same simulator and the same cost as identify.py at full length, but none of what makes that
one robust: no sensitivities, no growing horizon, no belief of the model file. It is kept as the
method that the other is compared with, and as an answer that does not depend on derivatives.

The simplex moves the shared parameters. Each record's initial motion is fitted beforehand and
again between searches, since no recording states it exactly.
"""

import time as clock
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import scipy

from cg_dynamics.model import Model
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.identify import Progress, score
from cg_sysid.identification.simulation_error import Problem
from cg_sysid.identification.unknowns import (
    IdentificationError,
    own_unknowns,
    unknowns_of,
    unsettled_states,
)
from cg_sysid.text import off_by

EVALUATIONS_PER_UNKNOWN = 200  # the limit of fminsearch
TOLERANCE = 1e-4  # of fminsearch: on the simplex, relative to each start, and on the cost
FIRST_SIMPLEX = 0.05  # relative size of the first simplex, as fminsearch takes it
FIRST_AT_ZERO = 0.00025  # the same where a start is zero
SEARCHES = 3  # each from the best point of the last, with a fresh simplex and initial motions
RUNAWAY = 1e30  # cost where the simulation runs away or no real body has the parameters


def nelder_mead(
    model: Model,
    data_sets: Sequence[DataSet],
    only: Sequence[str] | None = None,
    evaluations: int | None = None,
    progress: Progress = lambda what, done, total, best: None,
) -> Fit:
    """Identify a model's parameters by a simplex search on the simulation error.

    Args:
        model: Where to start.
        data_sets: Prepared records.
        only: Full names of the parameters to identify; by default all that are free.
        evaluations: Limit of simulations of all records.
        progress: Called with (what, done, total, how good it is so far in words).

    Returns:
        A fit without uncertainties: the method gives none, so that they are infinite.

    Raises:
        IdentificationError: if the model cannot be simulated along the data at all.
    """
    if not data_sets:
        raise IdentificationError('no record to identify from; at least one is needed')
    unknowns = unknowns_of(model, only)
    if not unknowns:
        raise IdentificationError(f'model {model.name!r} has no free parameter to identify')
    if own_unknowns(model):
        raise IdentificationError(
            f'a simplex search cannot find what each record has of its own, as '
            f'{own_unknowns(model)[0].name}; use gauss-newton'
        )
    began = clock.perf_counter()
    guesses = [data_set.motion for data_set in data_sets]
    cost = _Cost(Problem(model, data_sets, unknowns, guesses), _motions(model, data_sets))
    values = np.array([u.prior for u in unknowns])
    if cost(values) >= RUNAWAY:
        raise IdentificationError(
            f'model {model.name!r} runs away along the data '
            f'({", ".join(t.name for t in data_sets)}); a simplex search cannot start there'
        )
    limit = evaluations or EVALUATIONS_PER_UNKNOWN * len(values)
    cost.progress = lambda done, best: progress('simplex search', done, limit, best)
    for _ in range(SEARCHES):
        found = _search(cost, values, limit - cost.problem.evaluations)
        settled = found.success and np.allclose(found.x, values, rtol=TOLERANCE, atol=1e-9)
        values = found.x
        here = model.with_values(dict(zip((u.name for u in unknowns), values, strict=True)))
        cost.motions = _motions(here, data_sets)
        if settled or cost.problem.evaluations >= limit:
            break
    sse, count = cost.errors(values)
    k = len(unknowns)
    quantities = dict(here.quantities)
    for u in unknowns:
        quantities[u.name] = replace(quantities[u.name], source='identified by Nelder-Mead')
    stopped = (
        ()
        if found.success
        else (f'the simplex search stopped at its limit of {limit} simulations',)
    )
    return Fit(
        model=replace(here, quantities=quantities),
        unknowns=unknowns,
        values=values,
        covariance=np.diag(np.full(k, np.inf)),
        information=np.full(k, np.nan),
        motions=tuple(cost.motions),
        own=(),
        own_sigmas=tuple(np.zeros(0) for _ in data_sets),
        cost=float(sse.sum()),
        mse=sse / np.maximum(count, 1),
        count=count,
        inflation=1.0,
        horizon=max(data_set.duration for data_set in data_sets),
        evaluations=cost.problem.evaluations,
        seconds=clock.perf_counter() - began,
        refinement=1.0,
        converged=bool(found.success),
        warnings=stopped,
    )


def _motions(model: Model, data_sets: Sequence[DataSet]) -> list[np.ndarray]:
    try:
        return list(score(model, data_sets).motions)
    except IdentificationError:
        settled = np.zeros(len(unsettled_states(model)))
        return [np.concatenate([data_set.motion, settled]) for data_set in data_sets]


def _search(cost: '_Cost', start: np.ndarray, evaluations: int) -> 'scipy.optimize.OptimizeResult':
    simplex = np.tile(start, (len(start) + 1, 1))
    for j, value in enumerate(start):
        simplex[j + 1, j] = value * (1 + FIRST_SIMPLEX) if value else FIRST_AT_ZERO
    # Relative to each start, or else the smallest lump would never be resolved.
    scale = np.where(start != 0, np.abs(start), 1.0)
    return _unscaled(
        scipy.optimize.minimize(
            lambda relative: cost(relative * scale),
            start / scale,
            method='Nelder-Mead',
            options={
                'initial_simplex': simplex / scale,
                'xatol': TOLERANCE,
                'fatol': TOLERANCE * cost(start),
                'maxfev': max(evaluations, 1),
                'maxiter': max(evaluations, 1),
            },
        ),
        scale,
    )


def _unscaled(
    found: 'scipy.optimize.OptimizeResult', scale: np.ndarray
) -> 'scipy.optimize.OptimizeResult':
    found.x = found.x * scale
    return found


class _Cost:
    """Eq. 4.13 over all records, each output in units of its noise."""

    def __init__(self, problem: Problem, motions: list[np.ndarray]):
        self.problem, self.motions = problem, motions
        self.best = np.inf  # chi2/N
        self.progress: Callable[[int, str], None] = lambda done, best: None

    def __call__(self, values: np.ndarray) -> float:
        problem = self.problem
        problem.evaluations += 1
        if any(not u.lower <= v <= u.upper for u, v in zip(problem.unknowns, values, strict=True)):
            return RUNAWAY
        if problem.consistency is not None and not (problem.consistency(values)[0] > 0).all():
            return RUNAWAY
        sse, count = self.errors(values)
        self.best = min(self.best, float(sse.sum() / max(count.sum(), 1)))
        self.progress(problem.evaluations, off_by(self.best))
        return float(sse.sum()) if np.isfinite(sse).all() else RUNAWAY

    def errors(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Squared error over noise variance and samples, each of shape (data sets, ny)."""
        problem = self.problem
        ny = len(problem.data_sets[0].sigma)
        sse, count = np.zeros((len(problem.data_sets), ny)), np.zeros((len(problem.data_sets), ny))
        for i, data_set in enumerate(problem.data_sets):
            compiled, p = problem.compiled[i], problem.vectors[i]
            p[problem.places[i]] = values
            x0 = compiled.initial_state(self.motions[i][problem.starts[i]], data_set.inputs[0], p)
            no_columns = np.zeros((compiled.nx, 0))
            unmoved = np.full(len(compiled.free), -1)
            normal, _, _ = compiled.normal(
                data_set.time, data_set.inputs, x0, no_columns, p, unmoved,
                data_set.outputs, 1 / data_set.sigma,
            )  # fmt: skip
            whole = normal.rows == len(data_set.time)
            sse[i] = normal.sse if whole else np.inf
            count[i] = normal.count
        return sse, count
