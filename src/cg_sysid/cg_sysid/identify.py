"""Identification by simulation error over many records at once: theory.md, (ID).

    J = sum_records sum_k |y_sim[k] - y_measured[k]|^2_W  +  |theta - theta_file|^2_(1/tolerance^2)

over the parameters shared by all records and, for each record, its own initial motion. Gauss-
Newton with exact sensitivities and Levenberg-Marquardt damping; each record's own unknowns are
eliminated by a Schur complement, so that many records cost no more than their simulation.

Two things make it robust. The horizon grows from a fraction of a second to the whole record, so
that the cliffs of the full cost (seed text, 4.2.3) are met only near the solution. And the weight
W follows the residual that is left, so that a wrong model does not buy a small gain in fit with
parameters far outside what the model file believes.
"""

import time as clock
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.compiled import CompiledModel, Normal, compile_model
from cg_dynamics.model import Model
from cg_sysid.trial import Trial

HORIZONS = (0.5, 2.0, 5.0)  # s, before the full length
RELATIVE_TOLERANCE = 0.15  # of a value whose file states no tolerance
BARRIER = 1e-2  # weight of the physical-consistency barrier, in units of one squared sigma
SCORE_BLOCK = 0.25  # s; longer than most residuals are correlated
BETWEEN_WEIGHTS = 8  # iterations after which the weights follow the residual
SMALL_GAIN = 0.1  # squared standard deviations: nobody would call one fit better than another
DRIFT = 1e-5  # relative change of the cost at which a fit has converged


class IdentificationError(ValueError):
    """An identification that cannot be done; the message says why."""


@dataclass(frozen=True)
class Unknown:
    """A shared parameter to be identified, in the coordinate in which it is moved.

    Attributes:
        name: Full parameter name.
        unit: SI unit.
        prior: Centre of what the model file believes.
        tolerance: Standard deviation of that belief; infinite where there is none. For a
            logarithmic unknown it is relative.
        lower: Smallest allowed value.
        upper: Largest allowed value.
        logarithmic: Moved as log(value).
        scale: Typical change, for damping.
    """

    name: str
    unit: str
    prior: float
    tolerance: float
    lower: float
    upper: float
    logarithmic: bool
    scale: float

    def to_coordinate(self, value: float) -> float:
        """Value -> coordinate."""
        return float(np.log(value)) if self.logarithmic else value

    def to_value(self, coordinate: float) -> float:
        """Coordinate -> value."""
        value = float(np.exp(coordinate)) if self.logarithmic else float(coordinate)
        return min(max(value, self.lower), self.upper)


@dataclass(frozen=True)
class Fit:
    """Result of an identification.

    Attributes:
        model: The model with the identified values and their standard deviations.
        unknowns: What was identified.
        values: Identified value of each unknown.
        covariance: Of the unknowns' coordinates (log where logarithmic), shape (k, k).
        information: Share of each unknown's certainty that comes from data, 0 (all from the
            model file's belief) to 1.
        motions: Initial motion of each trial, (2m,) each.
        cost: Final cost J, in squared noise standard deviations.
        mse: Mean squared error of each trial and output, in squared noise, shape (trials, ny).
        count: Samples behind `mse`.
        inflation: Variance of the residual over that of the noise, as used in the weights.
        horizon: Length of the records used, in s.
        evaluations: Number of evaluations of all records.
        seconds: Wall time.
        converged: False if it stopped at the limit of iterations.
        warnings: What a person should know: bounds, correlations, unidentifiable directions.
    """

    model: Model
    unknowns: tuple[Unknown, ...]
    values: np.ndarray
    covariance: np.ndarray
    information: np.ndarray
    motions: tuple[np.ndarray, ...]
    cost: float
    mse: np.ndarray
    count: np.ndarray
    inflation: float
    horizon: float
    evaluations: int
    seconds: float
    converged: bool
    warnings: tuple[str, ...] = ()

    @property
    def sigmas(self) -> np.ndarray:
        """Standard deviation of each value, in its unit, shape (k,)."""
        spread = np.sqrt(np.clip(np.diag(self.covariance), 0, None))
        pairs = zip(self.unknowns, self.values, strict=True)
        factor = [v if u.logarithmic else 1.0 for u, v in pairs]
        return spread * np.array(factor)

    @property
    def normalised_error(self) -> float:
        """Mean squared error over noise variance, all trials and outputs together."""
        return float(np.nansum(self.mse * self.count) / self.count.sum())


def unknowns_of(model: Model, only: Sequence[str] | None = None) -> tuple[Unknown, ...]:
    """The parameters of a model that identification moves: declared free, not fixed in the file.

    Raises:
        IdentificationError: if `only` names something that the model does not have.
    """
    declared = model.declarations
    if only is not None:
        for name in only:
            if name not in declared:
                raise IdentificationError(
                    f'no parameter {name!r} to identify; there are: {", ".join(declared)}'
                )
    found = []
    for name, parameter in declared.items():
        q = model.quantities[name]
        if (only is None and (q.fixed or not parameter.free)) or (
            only is not None and name not in only
        ):
            continue
        if not np.isfinite(q.value):
            continue
        tolerance = q.tolerance
        if tolerance is None:
            belongs = '.' not in name
            tolerance = RELATIVE_TOLERANCE * abs(q.value) if belongs and q.value else np.inf
        if parameter.logarithmic and np.isfinite(tolerance):
            tolerance = tolerance / q.value
        found.append(
            Unknown(
                name, parameter.unit, q.value, tolerance, parameter.lower,
                parameter.upper, parameter.logarithmic, parameter.scale,
            )
        )  # fmt: skip
    return tuple(found)


@dataclass
class _Problem:
    """Compiled models and constants of one fit."""

    model: Model
    trials: Sequence[Trial]
    unknowns: tuple[Unknown, ...]
    compiled: list[CompiledModel] = field(default_factory=list)
    vectors: list[np.ndarray] = field(default_factory=list)
    places: list[np.ndarray] = field(default_factory=list)
    columns: list[np.ndarray] = field(default_factory=list)
    inputs: list[np.ndarray] = field(default_factory=list)
    evaluations: int = 0

    def __post_init__(self):
        names = tuple(u.name for u in self.unknowns)
        default = compile_free(self.model, names)
        for trial in self.trials:
            compiled = compile_model(self.model, trial.setup, default)
            m2 = 2 * compiled.equations.coordinates
            self.compiled.append(compiled)
            self.inputs.append(trial.inputs_for(compiled.input_names))
            self.vectors.append(parameter_vector(self.model, trial.setup))
            self.places.append(np.array([compiled.parameter_names.index(n) for n in names], int))
            self.columns.append(
                np.array([m2 + names.index(f) if f in names else -1 for f in compiled.free], int)
            )
        self.consistency = _consistency(self.model, names)

    def values(self, theta: np.ndarray) -> np.ndarray:
        return np.array([u.to_value(c) for u, c in zip(self.unknowns, theta, strict=True)])

    def chain(self, values: np.ndarray) -> np.ndarray:
        return np.array(
            [v if u.logarithmic else 1.0 for u, v in zip(self.unknowns, values, strict=True)]
        )


def compile_free(model: Model, names: Sequence[str]) -> tuple[str, ...] | None:
    """Parameters to compile sensitivities for: all declared free, and those asked for besides."""
    declared = model.declarations
    if all(declared[name].free for name in names):
        return None
    return tuple(n for n, p in declared.items() if p.free or n in names)


def _consistency(model: Model, names: tuple[str, ...]):
    symbols = {name: ca.SX.sym(name) for name in model.declarations}
    conditions = model.mechanism.consistency(symbols)
    if not conditions or not names:
        return None
    stacked = ca.vertcat(*conditions)
    moved = ca.vertcat(*(symbols[name] for name in names))
    function = ca.Function(
        'consistency', list(symbols.values()), [stacked, ca.jacobian(stacked, moved)]
    )
    fixed = model.values

    def evaluate(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        numbers = {**fixed, **dict(zip(names, values, strict=True))}
        stack, jacobian = function(*numbers.values())
        return np.asarray(stack).ravel(), np.asarray(ca.densify(jacobian))

    return evaluate


@dataclass
class _Point:
    """Cost and normal equations at one point; None where the simulation runs away."""

    cost: float
    shared_hessian: np.ndarray
    shared_gradient: np.ndarray
    own: list[tuple[np.ndarray, np.ndarray, np.ndarray]]  # D, E, g of each trial
    sse: np.ndarray
    count: np.ndarray
    data_cost: float


def _evaluate(
    problem: _Problem, theta: np.ndarray, motions: list[np.ndarray], horizon: float, weight: float
) -> _Point | None:
    k = len(theta)
    values = problem.values(theta)
    chain = problem.chain(values)
    shared_h, shared_g = np.zeros((k, k)), np.zeros(k)
    own, cost = [], 0.0
    ny = len(problem.trials[0].sigma)
    sse, count = np.zeros((len(problem.trials), ny)), np.zeros((len(problem.trials), ny))
    if problem.consistency is not None:
        c, jacobian = problem.consistency(values)
        if not (c > 0).all():
            return None
        jacobian = jacobian * chain / c[:, None]
        cost -= 2 * BARRIER * np.log(c).sum()
        shared_g -= BARRIER * jacobian.sum(axis=0)
        shared_h += BARRIER * jacobian.T @ jacobian
    problem.evaluations += 1
    for i, trial in enumerate(problem.trials):
        n, normal, _, _ = _simulate_sensitive(problem, i, values, motions[i], horizon)
        m2 = len(motions[i])
        if normal.rows < n or not np.isfinite(normal.hessian).all():
            return None
        h, g = normal.hessian * weight, normal.gradient * weight
        h[m2:] *= chain[:, None]
        h[:, m2:] *= chain
        g[m2:] *= chain
        sse[i], count[i] = normal.sse, normal.count
        away = (motions[i] - trial.motion) / trial.motion_sigma
        own_h = h[:m2, :m2] + np.diag(1 / trial.motion_sigma**2)
        own_g = g[:m2] + away / trial.motion_sigma
        own.append((own_h, h[:m2, m2:], own_g))
        shared_h += h[m2:, m2:]
        shared_g += g[m2:]
        cost += weight * normal.sse.sum() + away @ away
    data_cost = cost
    for j, u in enumerate(problem.unknowns):
        if np.isfinite(u.tolerance):
            away = (theta[j] - u.to_coordinate(u.prior)) / u.tolerance
            cost += away**2
            shared_g[j] += away / u.tolerance
            shared_h[j, j] += 1 / u.tolerance**2
    return _Point(cost, shared_h, shared_g, own, sse, count, data_cost)


def _simulate_sensitive(
    problem: _Problem,
    i: int,
    values: np.ndarray,
    motion: np.ndarray,
    horizon: float,
    keep: bool = False,
) -> tuple[int, Normal, np.ndarray | None, np.ndarray | None]:
    """One trial: rows within the horizon, normal equations and, if kept, outputs and Jacobian.

    Columns: the trial's own initial motion, then the shared values (not coordinates).
    """
    trial, compiled, u = problem.trials[i], problem.compiled[i], problem.inputs[i]
    p = problem.vectors[i]
    p[problem.places[i]] = values
    n = int(np.searchsorted(trial.time, horizon, side='right'))
    x0, by_motion, by_free = compiled.initial_sensitivity(motion, u[0], p)
    m2 = len(motion)
    s0 = np.zeros((compiled.nx, m2 + len(values)))
    s0[:, :m2] = by_motion
    for f, column in enumerate(problem.columns[i]):
        if column >= 0:
            s0[:, column] = by_free[:, f]
    normal, y, jacobian = compiled.normal(
        trial.time[:n], u[:n], x0, s0, p, problem.columns[i], trial.outputs[:n], 1 / trial.sigma,
        keep=keep,
    )  # fmt: skip
    return n, normal, y, jacobian


def _reduce(point: _Point, damping: float) -> tuple[np.ndarray, np.ndarray, list]:
    """Schur complement on the shared unknowns, with Marquardt damping on every diagonal."""
    h = point.shared_hessian + damping * np.diag(np.diag(point.shared_hessian))
    g = point.shared_gradient.copy()
    factors = []
    for d, e, own_g in point.own:
        damped = d + damping * np.diag(np.diag(d))
        solved = np.linalg.solve(damped, np.column_stack([e, own_g]))
        h -= e.T @ solved[:, :-1]
        g -= e.T @ solved[:, -1]
        factors.append(solved)
    return h, g, factors


def _step(point: _Point, damping: float, frozen: np.ndarray) -> tuple[np.ndarray, list]:
    h, g, factors = _reduce(point, damping)
    free = ~frozen
    step = np.zeros(len(g))
    if free.any():
        scale = np.sqrt(np.maximum(np.diag(h)[free], 1e-300))
        scaled = h[np.ix_(free, free)] / np.outer(scale, scale)
        step[free] = -np.linalg.lstsq(scaled, g[free] / scale, rcond=1e-12)[0] / scale
    moves = [-(solved[:, -1] + solved[:, :-1] @ step) for solved in factors]
    return step, moves


def _minimise(
    problem: _Problem,
    theta: np.ndarray,
    motions: list[np.ndarray],
    horizon: float,
    weight: float,
    iterations: int,
    drift: float,
    leading: bool = False,
) -> tuple[np.ndarray, list[np.ndarray], _Point | None, bool]:
    lower = np.array([u.to_coordinate(max(u.lower, 1e-300) if u.logarithmic else u.lower)
                      for u in problem.unknowns])
    upper = np.array([u.to_coordinate(u.upper) for u in problem.unknowns])
    point = _evaluate(problem, theta, motions, horizon, weight)
    if point is None:
        return theta, motions, None, False
    damping = 1e-3
    for _ in range(iterations):
        _, gradient, _ = _reduce(point, 0.0)
        frozen = ((theta <= lower) & (gradient > 0)) | ((theta >= upper) & (gradient < 0))
        if leading:
            frozen |= _unseen(problem, theta, point, weight)
        step, moves = _step(point, damping, frozen)
        trial_theta = np.clip(theta + step, lower, upper)
        trial_motions = [m + d for m, d in zip(motions, moves, strict=True)]
        candidate = _evaluate(problem, trial_theta, trial_motions, horizon, weight)
        if candidate is not None and candidate.cost < point.cost:
            gain = point.cost - candidate.cost
            theta, motions, point = trial_theta, trial_motions, candidate
            damping = max(damping / 10, 1e-9)
            if gain < max(drift * candidate.cost, SMALL_GAIN):
                return theta, motions, point, True
        else:
            if candidate is not None and candidate.cost - point.cost < 1e-9 * point.cost:
                return theta, motions, point, True
            damping *= 10
            if damping > 1e8:
                return theta, motions, point, True
    return theta, motions, point, False


def _unseen(
    problem: _Problem, theta: np.ndarray, point: _Point, weight: float
) -> np.ndarray:
    """Unknowns whose typical change these few seconds do not notice, such as a late push."""
    values = problem.values(theta)
    scales = np.array([u.scale for u in problem.unknowns]) / problem.chain(values)
    return np.diag(point.shared_hessian) * scales**2 < weight


def fit(
    model: Model,
    trials: Sequence[Trial],
    only: Sequence[str] | None = None,
    iterations: int = 60,
    reweight: bool = True,
    horizon: float = np.inf,
    start: Fit | None = None,
    at: Mapping[str, float] | None = None,
) -> Fit:
    """Identify a model's parameters from trials.

    Args:
        model: What is believed: values, tolerances, bounds. The search sets out from there.
        trials: Prepared records (trial.prepare).
        only: Full names of the parameters to identify; by default all that are free.
        iterations: Limit for the last, full-length stage.
        reweight: Let the weights follow the residual that is left.
        horizon: Use only this much of each record, in s: a cheap first look.
        start: Set out from this fit of the same unknowns to a shorter horizon instead.
        at: Set out from these values (full name -> value) instead of those of the file.

    Raises:
        IdentificationError: if the model cannot be simulated along the data at all.
    """
    if not trials:
        raise IdentificationError('no record to identify from; at least one is needed')
    began = clock.perf_counter()
    unknowns = unknowns_of(model, only)
    problem = _Problem(model, trials, unknowns)
    values = [(at or {}).get(u.name, u.prior) for u in unknowns] if start is None else start.values
    theta = np.array([u.to_coordinate(v) for u, v in zip(unknowns, values, strict=True)])
    motions = [trial.motion for trial in trials] if start is None else list(start.motions)
    longest = min(max(trial.duration for trial in trials), horizon)
    weight = 1.0 if start is None else 1 / start.inflation
    stages = [h for h in HORIZONS if (start.horizon if start else 0.0) < h < 0.8 * longest]
    for horizon in stages:
        # The short horizons only lead the way; the belief of the file keeps them sober.
        found = _minimise(problem, theta, motions, horizon, weight, 12, 3e-2, True)
        if found[2] is not None:
            theta, motions = found[0], found[1]
            weight = _weight(found[2]) if reweight else 1.0
    for _ in range(max(1, iterations // BETWEEN_WEIGHTS)):
        theta, motions, point, converged = _minimise(
            problem, theta, motions, longest, weight, BETWEEN_WEIGHTS, DRIFT
        )
        if point is None:
            raise IdentificationError(
                f'model {model.name!r} runs away along the data '
                f'({", ".join(t.name for t in trials)}); its values are too far off, or the '
                'records are too long for an unstable motion: cut them into windows'
            )
        new = _weight(point) if reweight else 1.0
        if converged and abs(np.log(new / weight)) < 0.1:
            break
        weight = new
    assert point is not None
    values = problem.values(theta)
    covariance, information = _uncertainty(problem, theta, motions, longest, weight)
    fitted = _with_uncertainty(model, unknowns, values, covariance)
    result = Fit(
        model=fitted,
        unknowns=unknowns,
        values=values,
        covariance=covariance,
        information=information,
        motions=tuple(motions),
        cost=point.cost,
        mse=point.sse / np.maximum(point.count, 1),
        count=point.count,
        inflation=1 / weight,
        horizon=longest,
        evaluations=problem.evaluations,
        seconds=clock.perf_counter() - began,
        converged=converged,
    )
    return replace(result, warnings=tuple(_warnings(result)))


def _weight(point: _Point) -> float:
    # Residuals far above the noise are model error: correlated over many samples, so that each
    # sample says much less than white noise of that size would. One hundredth of the samples is
    # the order of a motion's correlation time (0.2 s at 500 Hz).
    excess = max(1.0, point.sse.sum() / point.count.sum())
    correlation = 1 + 99 * (1 - 1 / excess)
    return 1 / (excess * correlation)


def _uncertainty(
    problem: _Problem, theta: np.ndarray, motions: list[np.ndarray], horizon: float, weight: float
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance of the coordinates and the share of each that comes from data: theory.md, (COV).

    Two estimates, and the larger one counts: the curvature scaled by the size of the residual,
    right for white residuals, and the sandwich of scores summed over blocks longer than their
    correlation, right where the model leaves slow waves.
    """
    point = _evaluate(problem, theta, motions, horizon, weight)
    k = len(theta)
    if not k or point is None:
        return np.zeros((k, k)), np.zeros(k)
    belief = np.array(
        [1 / u.tolerance**2 if np.isfinite(u.tolerance) else 0.0 for u in problem.unknowns]
    )
    h, _, _ = _reduce(point, 0.0)
    excess = max(1.0, point.sse.sum() / point.count.sum())
    rescale = 1 / (excess * weight)
    h = (h - np.diag(belief)) * rescale + np.diag(belief)
    inverse, lost = _inverse(h)
    scores = _block_scores(problem, theta, motions, horizon, point, weight) * rescale
    sandwich = inverse @ (scores.T @ scores + np.diag(belief)) @ inverse
    ratio = np.sqrt(np.maximum(np.diag(sandwich) / np.maximum(np.diag(inverse), 1e-300), 1.0))
    covariance = inverse * np.outer(ratio, ratio)
    covariance[lost, lost] = np.inf
    certain = np.where(belief > 0, np.diag(covariance), 0.0)
    information = 1 - np.clip(certain * belief, 0, 1)
    information[lost] = 0.0
    return covariance, information


def _inverse(h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of the curvature, and which unknowns it leaves undetermined."""
    scale = np.sqrt(np.maximum(np.diag(h), 1e-300))
    eigenvalues, vectors = np.linalg.eigh(h / np.outer(scale, scale))
    # A direction that neither data nor belief determine has infinite variance, not a crash.
    kept = eigenvalues > 1e-13 * eigenvalues.max()
    inverse = (vectors[:, kept] / eigenvalues[kept]) @ vectors[:, kept].T
    lost = (vectors[:, ~kept] ** 2).sum(axis=1) > 1e-6
    return inverse / np.outer(scale, scale), lost


def _block_scores(
    problem: _Problem,
    theta: np.ndarray,
    motions: list[np.ndarray],
    horizon: float,
    point: _Point,
    weight: float,
) -> np.ndarray:
    """Gradient of the cost by the shared unknowns, block by block of time, shape (blocks, k)."""
    values = problem.values(theta)
    chain = problem.chain(values)
    blocks = []
    for i, trial in enumerate(problem.trials):
        n, _, y, jacobian = _simulate_sensitive(problem, i, values, motions[i], horizon, keep=True)
        assert y is not None
        assert jacobian is not None
        residual = np.nan_to_num((y - trial.outputs[:n]) / trial.sigma**2) * weight
        rows = np.einsum('kj,kjc->kc', residual, jacobian)
        edges = np.arange(0, n, max(1, int(n * SCORE_BLOCK / max(trial.time[n - 1], 1e-9))))
        sums = np.add.reduceat(rows, edges, axis=0)
        m2 = len(motions[i])
        own, cross, _ = point.own[i]
        blocks.append(sums[:, m2:] * chain - sums[:, :m2] @ np.linalg.solve(own, cross))
    return np.vstack(blocks)


def _with_uncertainty(
    model: Model, unknowns: tuple[Unknown, ...], values: np.ndarray, covariance: np.ndarray
) -> Model:
    model = model.with_values({u.name: v for u, v in zip(unknowns, values, strict=True)})
    quantities = dict(model.quantities)
    for j, (u, v) in enumerate(zip(unknowns, values, strict=True)):
        sigma = np.sqrt(max(covariance[j, j], 0.0)) * (abs(v) if u.logarithmic else 1.0)
        if np.isfinite(sigma):
            quantities[u.name] = replace(
                quantities[u.name], tolerance=float(sigma), source='identified'
            )
    return replace(model, quantities=quantities)


def _warnings(fit: Fit):
    sigmas = fit.sigmas
    for u, value, sigma, share in zip(
        fit.unknowns, fit.values, sigmas, fit.information, strict=True
    ):
        span = u.upper - u.lower
        if min(value - u.lower, u.upper - value) <= 1e-6 * span:
            yield f'{u.name} = {value:.4g} {u.unit} lies at the edge of its range'
        if not np.isfinite(sigma):
            yield f'{u.name} cannot be identified from these records'
        elif share < 0.2 and np.isfinite(u.tolerance):
            yield (
                f'{u.name} is hardly seen by these records: its value is mostly what the '
                'model file believed'
            )
        if np.isfinite(u.tolerance):
            away = abs(u.to_coordinate(value) - u.to_coordinate(u.prior)) / u.tolerance
            if away > 3:
                yield (
                    f'{u.name} = {value:.4g} {u.unit} is {away:.1f} tolerances away from what '
                    f'the model file believes ({u.prior:.4g})'
                )
    finite = np.isfinite(np.diag(fit.covariance))
    spread = np.sqrt(np.where(finite, np.diag(fit.covariance), 1))
    for a in range(len(spread)):
        for b in range(a):
            if finite[a] and finite[b] and spread[a] and spread[b]:
                r = fit.covariance[a, b] / (spread[a] * spread[b])
                if abs(r) > 0.98:
                    yield (
                        f'{fit.unknowns[b].name} and {fit.unknowns[a].name} are told apart only '
                        f'poorly: correlation {r:+.3f}'
                    )


def predict(model: Model, trial: Trial, motion: np.ndarray) -> np.ndarray:
    """Outputs that a model simulates along a trial from an initial motion, shape (n, ny)."""
    compiled = compile_model(model, trial.setup)
    p = parameter_vector(model, trial.setup)
    u = trial.inputs_for(compiled.input_names)
    x0 = compiled.initial_state(motion, u[0], p)
    states = compiled.simulate(trial.time, u, x0, p)
    return compiled.outputs(trial.time, u, states, p)


def score(model: Model, trials: Sequence[Trial]) -> Fit:
    """How well a model simulates trials that it was not fitted to.

    Only each trial's initial motion is fitted, as no recording states it exactly.
    """
    return fit(model, trials, only=())
