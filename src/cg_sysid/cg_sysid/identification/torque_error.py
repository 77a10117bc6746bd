"""Identification by torque error: what a measured motion takes, less what acted.

    r_k = S^-1 (Q(x_k, u_k, p) - ID(q_k, v_k, a_k, p)),   x_k = (q_k, v_k) and a_k measured   (TE)

Nothing is simulated, so that no start is too far off and nothing runs away: an arm of six joints
is fitted in a second. In return it is biased: derivatives of samples are smoothed, sensors that
are late or wrong count as right, and states that no sensor reads are left out. So it says where a
fit by simulation error sets out, and which candidates are worth one (theory.md, ID).

Position, rate and acceleration come from local polynomials; the torques are averaged with the same
weights, so that both sides have seen the same window.
"""

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from cg_dynamics.assemble import Equations, acting_effects, assemble, parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.unknowns import Unknown, unknowns_of

HALF_WIDTH_S = 0.06  # of the window of a local polynomial: motions up to some 5 Hz
LEAST_HALF_WIDTH = 3  # samples
DEGREE = 4  # of the polynomial
STRIDE_S = 0.04  # between rows: windows that share less than half of their samples
ITERATIONS = 25
SETTLED = 1e-4  # relative change of the cost
DAMPING = 1e-3  # Levenberg-Marquardt, at first
MOST_DAMPING = 1e6
PATIENCE = 4  # steps that may gain little where a full one promises more
STRAINED = 2.5  # tolerances that a value lies off its belief
CAP = 4.0  # standard deviations from which a row counts less: rates that turn within a window


@dataclass(frozen=True)
class Motion:
    """What was measured of one data set, at rows STRIDE_S apart.

    Attributes:
        position: Free coordinates, shape (k, m).
        rate: Shape (k, m).
        acceleration: Shape (k, m).
        inputs: Averages, shape (k, nu).
        first: Rows with which a record begins, shape (k,).
        setup: The set-up.
    """

    position: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray
    inputs: np.ndarray
    first: np.ndarray
    setup: Setup


@dataclass(frozen=True)
class TorqueFit:
    """What the torques say.

    Attributes:
        values: Full parameter name -> value.
        rms: Of the residual of each free coordinate, N m (N), shape (m,).
        relative: That over the torque that acted there, shape (m,); NaN where nothing drives.
        cost: Sum of squared residuals over `scale`, large ones capped, and of the belief.
        rows: Number of rows.
        scale: Standard deviation of the residual of each coordinate, N m (N), shape (m,).
    """

    values: Mapping[str, float]
    rms: np.ndarray
    relative: np.ndarray
    cost: float
    rows: int
    scale: np.ndarray


def can(model: Model) -> bool:
    """Whether this is of use: a robot of a URDF with an encoder at every joint that moves.

    Mechanisms of a few joints are followed by simulation from the start.
    """
    encoders = sum(kind == 'encoder' for kind in model.mechanism.sensor_kinds.values())
    return model.mechanism.dimensions == 3 and encoders >= len(model.mechanism.coordinates)


def tells_all(model: Model) -> bool:
    """Whether, besides, all that acts shows in the torques along the measured motion.

    A rotor behind a gap or a spring moves by itself, and torques say nothing of the gap.
    """
    return can(model) and not any(effect.elastic for effect in acting_effects(model))


def motion_of(model: Model, data_set: DataSet, names: Sequence[str]) -> Motion | None:
    """The measured motion of a data set; None where it is too short or samples are missing.

    Args:
        model: Its mechanism counts.
        data_set: The record.
        names: Inputs wanted.
    """
    body = model.mechanism
    kinematics = body.kinematics(data_set.setup)
    basis = np.asarray(kinematics.basis)
    offset = np.broadcast_to(np.asarray(kinematics.offset).ravel(), (len(basis),))
    count = len(body.coordinates)
    seen = data_set.outputs[:, :count]
    spacing = float(np.median(np.diff(data_set.time)))
    half = max(LEAST_HALF_WIDTH, round(HALF_WIDTH_S / spacing))
    grid = np.arange(0.0, data_set.duration, spacing)
    if len(grid) <= 2 * half + 1:
        return None
    place, rate, acceleration = (_weights(half, spacing, order) for order in range(3))
    stride = max(1, round(STRIDE_S / spacing))
    free = np.linalg.pinv(basis)
    angles = []
    for channel in seen.T:
        there = np.isfinite(channel)
        if there.sum() <= 2 * half + 1:
            return None
        angles.append(np.interp(grid, data_set.time[there], channel[there]))
    s = (np.column_stack(angles) - offset) @ free.T
    row = np.clip(np.searchsorted(data_set.time, grid, side='right') - 1, 0, None)
    inputs = data_set.inputs_for(names)[row]

    def over(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
        columns = [np.correlate(column, weights, 'valid')[::stride] for column in values.T]
        return np.column_stack(columns)

    position = over(s, place)
    return Motion(
        position, over(s, rate), over(s, acceleration), over(inputs, place),
        np.arange(len(position)) == 0, data_set.setup,
    )  # fmt: skip


@functools.cache
def _weights(half: int, spacing: float, order: int) -> np.ndarray:
    """Weights of samples that give a derivative at the middle of a local polynomial."""
    t = np.arange(-half, half + 1) * spacing
    design = np.vander(t / t[-1], DEGREE + 1, increasing=True)
    factor = (1.0, 1.0, 2.0)[order] / t[-1] ** order
    return factor * np.linalg.pinv(design)[order]


def fit_by_torque(
    model: Model,
    data_sets: Sequence[DataSet],
    only: Sequence[str] | None = None,
    bounds: Mapping[str, float] | None = None,
    scale: np.ndarray | None = None,
    at: Mapping[str, float] | None = None,
) -> TorqueFit | None:
    """Identify what the torques show of a model; None where no record can be used.

    Args:
        model: What is believed, and where the search sets out.
        data_sets: Prepared records.
        only: As of `identify.fit`.
        bounds: As of `identify.fit`.
        scale: Standard deviation of the residual of each coordinate, N m (N), shape (m,), by which
            fits are compared; by default what is left of this one.
        at: Set out from these values (full name -> value) instead of those of the model.
    """
    found = fits_by_torque([model], data_sets, only, bounds, scale, at)
    return found[0] if found else None


def fits_by_torque(
    models: Sequence[Model],
    data_sets: Sequence[DataSet],
    only: Sequence[str] | None = None,
    bounds: Mapping[str, float] | None = None,
    scale: np.ndarray | None = None,
    at: Mapping[str, float] | None = None,
) -> list[TorqueFit]:
    """The same for models that differ in their values only, from each; none without a record.

    Those that differ in nothing that the torques see, as in a delay, are fitted once.
    """
    plain = [without_states(model) for model in models]
    declared = plain[0].declarations
    unknowns = [
        tuple(u for u in unknowns_of(model, only, bounds) if u.name in declared)
        for model in models
    ]
    problems = problems_of(plain[0], data_sets, unknowns[0])
    if not problems:
        return []
    seen = [np.array(ca.which_depends(p.equations.imbalance, p.equations.p)) for p in problems]
    blind = np.logical_and.reduce(
        [~there[p.places] for p, there in zip(problems, seen, strict=True)]
    )
    fitted: dict[tuple, TorqueFit] = {}
    found = []
    for model, own in zip(plain, unknowns, strict=True):
        from_here = [problem.at(model) for problem in problems]
        key = tuple(x for p, there in zip(from_here, seen, strict=True) for x in p.vector[there])
        if key not in fitted:
            fitted[key] = _best(from_here, own, scale, at or {})
        # What the torques do not see is left where it was.
        left = {
            u.name: (at or {}).get(u.name, u.prior) for u, b in zip(own, blind, strict=True) if b
        }
        found.append(replace(fitted[key], values={**fitted[key].values, **left}))
    return found


def _best(
    problems: Sequence['Problem'],
    unknowns: Sequence[Unknown],
    scale: np.ndarray | None,
    at: Mapping[str, float],
) -> TorqueFit:
    """From given values and, where these strain the belief, from what is believed as well.

    What an effect more could take over from strained numbers lies far off, along a curved valley
    of numbers that the torques cannot tell apart.
    """
    found = _descend(problems, unknowns, scale, at)
    strained = any(
        abs(u.to_coordinate(at[u.name]) - u.to_coordinate(u.prior)) > STRAINED * u.tolerance
        for u in unknowns if u.name in at
    )  # fmt: skip
    if not strained:
        return found
    afresh = _descend(problems, unknowns, found.scale, {})
    return min(found, afresh, key=lambda fitted: fitted.cost)


def _descend(
    problems: Sequence['Problem'],
    unknowns: Sequence[Unknown],
    scale: np.ndarray | None,
    at: Mapping[str, float],
) -> TorqueFit:
    """From a start to the minimum: Gauss-Newton, damped."""
    prior = np.array([u.to_coordinate(u.prior) for u in unknowns])
    theta = np.array([
        np.clip(u.to_coordinate(at.get(u.name, u.prior)), *_range(u)) for u in unknowns
    ])  # fmt: skip
    tolerance = np.array([u.tolerance for u in unknowns])
    own_scale = scale is None
    residual = residuals(problems, unknowns, theta)
    if scale is None:
        scale = spread_of(residual)
    damping, patience = DAMPING, PATIENCE
    cost = _cost(residual, scale, theta, prior, tolerance)
    for _ in range(ITERATIONS):
        jacobian = derivatives(problems, unknowns, theta)
        weight = 1 / beyond(residual / scale)
        r = (weight * residual / scale).ravel()
        j = (weight[:, :, None] * jacobian / scale[:, None]).reshape(len(r), -1)
        h = j.T @ j + np.diag(1 / tolerance**2)
        g = j.T @ r + (theta - prior) / tolerance**2
        promised = float(g @ np.linalg.lstsq(h, g, rcond=None)[0])
        better = False
        while not better and damping < MOST_DAMPING:
            step = np.linalg.lstsq(h + damping * np.diag(np.diag(h) + 1e-12), -g, rcond=None)[0]
            tried = np.array([
                np.clip(t + s, *_range(u)) for t, s, u in zip(theta, step, unknowns, strict=True)
            ])  # fmt: skip
            new_residual = residuals(problems, unknowns, tried)
            new_cost = _cost(new_residual, scale, tried, prior, tolerance)
            better = new_cost < cost
            damping = damping / 5 if better else 5 * damping
        if not better:
            break
        # Along what only the belief knows a damped step is short, and gains little.
        little = cost - new_cost < SETTLED * cost
        patience -= little
        settled = little and (promised < SETTLED * cost or not patience)
        theta, residual, cost = tried, new_residual, new_cost
        if own_scale:
            scale = spread_of(residual)
            cost = _cost(residual, scale, theta, prior, tolerance)
        if settled:
            break
    acted = np.sqrt(np.mean(np.vstack([p.acted for p in problems]) ** 2, axis=0))
    rms = np.sqrt(np.mean(residual**2, axis=0))
    with np.errstate(divide='ignore', invalid='ignore'):
        relative = np.where(acted > 0, rms / acted, np.nan)
    values = {u.name: u.to_value(float(t)) for u, t in zip(unknowns, theta, strict=True)}
    return TorqueFit(values, rms, relative, cost, len(residual), scale)


class AlongRows:
    """A function of (x, u, a, p) along the rows of a motion, for ever other p.

    It reads and writes these arrays in place: to hand matrices over would take longer than to
    work them out.
    """

    def __init__(self, e: Equations, motion: Motion, result: ca.SX):
        k, m = motion.position.shape
        every = ca.Function('along_rows', [e.x, e.u, e.acceleration, e.p], [ca.cse(result)]).map(k)
        self._p = np.empty((k, e.p.shape[0]))
        self._result = np.empty((k, result.shape[1], m))
        # casadi counts by columns, so that each row here is one of its columns.
        self._given = [
            np.ascontiguousarray(a)
            for a in (np.hstack([motion.position, motion.rate]), motion.inputs,
                      motion.acceleration, self._p)
        ]  # fmt: skip
        self._buffer, self._run = every.buffer()
        for i, array in enumerate(self._given):
            self._buffer.set_arg(i, array.data)  # type: ignore[call-arg]
        if self._result.size:
            self._buffer.set_res(0, self._result.data)  # type: ignore[call-arg]

    def __call__(self, p: np.ndarray) -> np.ndarray:
        """Of each row, shape (k, m, columns); it holds until the next call."""
        self._p[:] = p
        self._run()
        return self._result.transpose(0, 2, 1)


@dataclass(frozen=True)
class Problem:
    """Motions of one set-up, and (TE) along them.

    Attributes:
        equations: Of the model.
        error: (TE), in one column.
        slope: Its derivative by the unknowns.
        motion: What was measured.
        vector: Parameters.
        places: Of the unknowns among them.
        acted: Torque that was applied on each free coordinate, shape (k, m).
    """

    equations: Equations
    error: AlongRows
    slope: AlongRows
    motion: Motion
    vector: np.ndarray
    places: list[int]
    acted: np.ndarray

    def at(self, model: Model) -> 'Problem':
        """The same with the values of a model of this structure."""
        return replace(self, vector=parameter_vector(model, self.motion.setup))


def problems_of(
    model: Model, data_sets: Sequence[DataSet], unknowns: Sequence[Unknown]
) -> list[Problem]:
    """What is measured, by set-up; unknowns are those of a model without states."""
    by_setup: dict[Setup, list[DataSet]] = {}
    for data_set in data_sets:
        by_setup.setdefault(data_set.setup, []).append(data_set)
    found = []
    for setup, own in by_setup.items():
        e = assemble(model, setup)
        motions = [motion_of(model, data_set, e.input_names) for data_set in own]
        usable = [motion for motion in motions if motion is not None]
        if not usable:
            continue
        every = Motion(
            np.vstack([m.position for m in usable]), np.vstack([m.rate for m in usable]),
            np.vstack([m.acceleration for m in usable]), np.vstack([m.inputs for m in usable]),
            np.concatenate([m.first for m in usable]), setup,
        )  # fmt: skip
        places = [e.parameter_names.index(u.name) for u in unknowns]
        moved = ca.vertcat(*(e.p[k] for k in places)) if places else ca.SX(0, 1)
        error, slope = (
            AlongRows(e, every, ca.densify(x))
            for x in (e.imbalance, ca.jacobian(e.imbalance, moved))
        )
        vector, acted = parameter_vector(model, setup), _acted(model, e, every)
        found.append(Problem(e, error, slope, every, vector, places, acted))
    return found


def _acted(model: Model, e: Equations, motion: Motion) -> np.ndarray:
    """Torque that was applied on each free coordinate, shape (k, m)."""
    body = model.mechanism
    basis = np.asarray(body.kinematics(motion.setup).basis)
    rows = np.array([body.joints[joint] for joint in body.joints])
    return motion.inputs[:, : len(rows)] @ rows @ basis


def residuals(
    problems: Sequence[Problem], unknowns: Sequence[Unknown], theta: np.ndarray
) -> np.ndarray:
    """(TE) of all rows, shape (rows, m)."""
    return np.vstack([p.error(_parameters(p, unknowns, theta))[:, :, 0] for p in problems])


def derivatives(
    problems: Sequence[Problem], unknowns: Sequence[Unknown], theta: np.ndarray
) -> np.ndarray:
    """Its derivative by the coordinates of the unknowns, shape (rows, m, unknowns)."""
    values = [u.to_value(float(t)) for u, t in zip(unknowns, theta, strict=True)]
    chain = [v if u.logarithmic else 1.0 for v, u in zip(values, unknowns, strict=True)]
    by_value = [p.slope(_parameters(p, unknowns, theta)) for p in problems]
    return np.vstack(by_value) * np.array(chain)


def _parameters(problem: Problem, unknowns: Sequence[Unknown], theta: np.ndarray) -> np.ndarray:
    p = problem.vector.copy()
    p[problem.places] = [u.to_value(float(t)) for u, t in zip(unknowns, theta, strict=True)]
    return p


def _range(u: Unknown) -> tuple[float, float]:
    if not u.logarithmic:
        return u.lower, u.upper
    return u.to_coordinate(max(u.lower, 1e-300)), u.to_coordinate(u.upper)


def spread_of(residual: np.ndarray) -> np.ndarray:
    """Standard deviation of most of the rows, shape (m,)."""
    return np.maximum(1.4826 * np.median(np.abs(residual), axis=0), 1e-12)


def beyond(error: np.ndarray) -> np.ndarray:
    """By how much less rows count that are beyond CAP: of errors in standard deviations, >= 1."""
    return np.maximum(1.0, np.abs(error) / CAP)


def _cost(
    residual: np.ndarray,
    scale: np.ndarray,
    theta: np.ndarray,
    prior: np.ndarray,
    tolerance: np.ndarray,
) -> float:
    """Squares near zero, straight on beyond CAP (Huber), and the belief."""
    size = np.abs(residual / scale)
    capped = np.where(size <= CAP, size**2, CAP * (2 * size - CAP))
    return float(capped.sum() + (((theta - prior) / tolerance) ** 2).sum())


def without_states(model: Model) -> Model:
    """The model less what has states of its own, of which something simpler may be left."""
    for effect in model.effects:
        if not effect.states:
            continue
        simpler = effect.without_states(model.values_of(effect))
        model = model.without_effect(effect.label)
        for name, values in simpler.items():
            if all(e.label != f'{name}@{effect.at}' and e.name != name for e in model.effects):
                model = model.with_effect(name, effect.at, **values)
    return model


def noise_gains(spacing: float) -> tuple[float, float, float]:
    """Noise of position, rate and acceleration over that of a sample, 1, 1/s and 1/s^2."""
    half = max(LEAST_HALF_WIDTH, round(HALF_WIDTH_S / spacing))
    place, rate, acceleration = (
        float(np.linalg.norm(_weights(half, spacing, order))) for order in range(3)
    )
    return place, rate, acceleration
