"""Identification by torque error: what a measured motion takes, less what acted.

    r_k = S^-1 (<Q(x, u, p)>_k - ID(q_k, v_k, a_k, p)),   x = (q, v) and a measured           (TE)

Nothing is simulated, so that no start is too far off and nothing runs away: an arm of six joints
is fitted in a second. In return it is biased: derivatives of samples are smoothed, and sensors
that are late or wrong count as right. States that no sensor reads are simulated along the measured
motion where their joint and its motor are all that moves them (along_motion.py), and left out
elsewhere. So it says where a fit by simulation error sets out, and which candidates are worth one
(theory.md, "Torque error").

Each row is a window of the measured motion (measured_motion.py), in the mean of which the drives
and the friction of the joints count (window_torque.py). Where friction turns a row may be far off
still, so rows are distributed as Student's t (student_t.py).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from cg_dynamics.assemble import (
    Equations,
    acting_effects,
    assemble,
    overrides,
    parameter_vector,
)
from cg_dynamics.effects import Effect
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.identification import along_motion
from cg_sysid.identification.along_motion import AlongMotion
from cg_sysid.identification.along_rows import AlongRows
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.hope import out_of_reach
from cg_sysid.identification.measured_motion import Motion, motion_of, together
from cg_sysid.identification.student_t import deviance, row_scale, scale_of
from cg_sysid.identification.unknowns import Unknown, unknowns_of
from cg_sysid.identification.window_torque import WindowTorque

SHORTER = 0.5  # times the usual windows where a rotor moves by itself, which it does faster
ENOUGH_S = 10.0  # of all records together, to be followed by a rotor
ITERATIONS = 25
HEAT = 6  # iterations from each of many starts, before the best of them go on
SETTLED = 1e-4  # of the deviance, for each residual
DAMPING = 1e-3  # Levenberg-Marquardt, at first
MOST_DAMPING = 1e6
PATIENCE = 4  # steps that may gain little where a full one promises more
STRAINED = 2.5  # tolerances that a value lies off its belief


@dataclass(frozen=True)
class TorqueFit:
    """What the torques say.

    Attributes:
        values: Full parameter name -> value.
        rms: Of the residual of each coordinate of the robot, N m (N), shape (n,); NaN of one that
            is locked in all records.
        relative: That over the torque that acted there, shape (n,); NaN where nothing drives.
        deviance: (T) and the squared distance from the belief; infinite of a rotor that runs away.
        scale: s of (T), N m (N), shape (n,).
    """

    values: Mapping[str, float]
    rms: np.ndarray
    relative: np.ndarray
    deviance: float
    scale: np.ndarray


def can(model: Model) -> bool:
    """Whether this is of use: a robot of a URDF with an encoder at every joint that moves.

    Mechanisms of a few joints are followed by simulation from the start, and so are robots of
    which a drive holds a torque that nobody wrote down.
    """
    encoders = sum(kind == 'encoder' for kind in model.mechanism.sensor_kinds.values())
    told = not any(effect.states and effect.extra_inputs for effect in acting_effects(model))
    return (
        model.mechanism.dimensions == 3 and encoders >= len(model.mechanism.coordinates) and told
    )


def fit_by_torque(
    model: Model,
    data_sets: Sequence[DataSet],
    only: Sequence[str] | None = None,
    bounds: Mapping[str, float] | None = None,
    at: Mapping[str, float] | None = None,
) -> TorqueFit | None:
    """Identify what the torques show of a model; None where no record can be used.

    Args:
        model: What is believed, and where the search sets out.
        data_sets: Prepared records.
        only: As of `identify.fit`.
        bounds: As of `identify.fit`.
        at: Set out from these values (full name -> value) instead of those of the model.
    """
    found = fits_by_torque([model], data_sets, only, bounds, at)
    return found[0] if found else None


def fits_by_torque(
    models: Sequence[Model],
    data_sets: Sequence[DataSet],
    only: Sequence[str] | None = None,
    bounds: Mapping[str, float] | None = None,
    at: Mapping[str, float] | None = None,
    followed: int | None = None,
    quick: bool = False,
    beaten: float = np.inf,
) -> list[TorqueFit]:
    """The same for models that differ in their values only, from each; none without a record.

    Those that differ in nothing that the torques see, as in a delay, are fitted once. Of more than
    `followed` fits the best go on to their minimum, after the first few iterations of all. With
    `quick` the windows are those of a rotor that moves by itself, whether there is one or not:
    likelihoods are compared over the same. Fits that will not come below the deviance that is
    `beaten` are broken off.
    """
    names = seen_by_torques(models[0])
    unknowns = [
        tuple(u for u in unknowns_of(model, only, bounds) if u.name in names) for model in models
    ]
    problems = problems_of(models[0], data_sets, unknowns[0], quick)
    if not problems:
        return []
    seen = [p.sees() for p in problems]
    blind = np.logical_and.reduce(
        [~there[p.places] for p, there in zip(problems, seen, strict=True)]
    )
    starts = [[problem.at(model) for problem in problems] for model in models]
    keys = [
        tuple(x for p, there in zip(start, seen, strict=True) for x in p.vector[there])
        for start in starts
    ]
    firsts = {key: keys.index(key) for key in keys}
    many = followed is not None and len(firsts) > followed
    fitted = {
        key: _best(starts[k], unknowns[k], at or {}, HEAT if many else ITERATIONS, beaten)
        for key, k in firsts.items()
    }
    for key in sorted(fitted, key=lambda key: fitted[key].deviance)[:followed] if many else ():
        k = firsts[key]
        fitted[key] = _descend(starts[k], unknowns[k], fitted[key].values, ITERATIONS, beaten)
    found = []
    for key, own in zip(keys, unknowns, strict=True):
        # What the torques do not see is left where it was.
        left = {
            u.name: (at or {}).get(u.name, u.prior) for u, b in zip(own, blind, strict=True) if b
        }
        found.append(replace(fitted[key], values={**fitted[key].values, **left}))
    return found


def _best(
    problems: Sequence['Problem'],
    unknowns: Sequence[Unknown],
    at: Mapping[str, float],
    iterations: int,
    beaten: float,
) -> TorqueFit:
    """From given values and, where these strain the belief, from what is believed as well.

    What an effect more could take over from strained numbers lies far off, along a curved valley
    of numbers that the torques cannot tell apart.
    """
    found = _descend(problems, unknowns, at, iterations, beaten)
    strained = any(
        abs(u.to_coordinate(at[u.name]) - u.to_coordinate(u.prior)) > STRAINED * u.tolerance
        for u in unknowns if u.name in at
    )  # fmt: skip
    if not strained:
        return found
    afresh = _descend(problems, unknowns, {}, iterations, beaten)
    return min(found, afresh, key=lambda fitted: fitted.deviance)


def _descend(
    problems: Sequence['Problem'],
    unknowns: Sequence[Unknown],
    at: Mapping[str, float],
    iterations: int,
    beaten: float,
) -> TorqueFit:
    """From a start to the minimum: Gauss-Newton, damped, with the weights of (T).

    A start from which a rotor runs away stays where it is, at an infinite deviance; so does one
    whose sensitivities run away, at its own.
    """
    prior = np.array([u.to_coordinate(u.prior) for u in unknowns])
    theta = np.array([
        np.clip(u.to_coordinate(at.get(u.name, u.prior)), *u.ends) for u in unknowns
    ])  # fmt: skip
    tolerance = np.array([u.tolerance for u in unknowns])

    def deviance_of(residual: np.ndarray, theta: np.ndarray) -> float:
        return deviance(residual) + float((((theta - prior) / tolerance) ** 2).sum())

    residual = residuals(problems, unknowns, theta)
    damping, patience = DAMPING, PATIENCE
    cost, little_is = deviance_of(residual, theta), SETTLED * residual.size
    costs = [cost]
    for _ in range(iterations if np.isfinite(cost) else 0):
        if out_of_reach(costs, beaten):
            break
        of_rows = row_scale(residual, scale_of(residual))
        r, of_rows = np.nan_to_num((residual / of_rows).ravel()), np.nan_to_num(of_rows, nan=1.0)
        with np.errstate(over='ignore', invalid='ignore'):
            jacobian = derivatives(problems, unknowns, theta)
            j = (jacobian / of_rows[:, :, None]).reshape(len(r), -1)
            h = j.T @ j + np.diag(1 / tolerance**2)
            g = j.T @ r + (theta - prior) / tolerance**2
        if not (np.isfinite(h).all() and np.isfinite(g).all()):
            break  # the rotor's neighbours run away
        promised = float(g @ np.linalg.lstsq(h, g, rcond=None)[0])
        better = False
        while not better and damping < MOST_DAMPING:
            step = np.linalg.lstsq(h + damping * np.diag(np.diag(h) + 1e-12), -g, rcond=None)[0]
            tried = np.array([
                np.clip(t + s, *u.ends) for t, s, u in zip(theta, step, unknowns, strict=True)
            ])  # fmt: skip
            new_residual = residuals(problems, unknowns, tried)
            new_cost = deviance_of(new_residual, tried)
            better = new_cost < cost
            damping = damping / 5 if better else 5 * damping
        if not better:
            break
        # Along what only the belief knows a damped step is short, and gains little.
        little = cost - new_cost < little_is
        patience -= little
        settled = little and (promised < little_is or not patience)
        theta, residual, cost = tried, new_residual, new_cost
        costs.append(cost)
        if settled:
            break
    acted = _rms(np.vstack([p.of_all(p.acted) for p in problems]))
    rms = _rms(residual)  # infinite where a start ran away
    with np.errstate(divide='ignore', invalid='ignore'):
        relative = np.where(acted > 0, rms / acted, np.nan)
    values = {u.name: u.to_value(float(t)) for u, t in zip(unknowns, theta, strict=True)}
    return TorqueFit(values, rms, relative, cost, scale_of(residual))


def _rms(values: np.ndarray) -> np.ndarray:
    """Of each column, of the rows that have a number; NaN where none has."""
    with np.errstate(invalid='ignore', over='ignore'):
        return np.sqrt(np.nansum(values**2, axis=0) / np.isfinite(values).sum(axis=0))


@dataclass(frozen=True)
class Problem:
    """Motions of one set-up, and (TE) along them.

    Attributes:
        equations: Of the model without states.
        error: (TE) of that at the mean motion of each window, in one column.
        slope: Its derivative by the unknowns that it has.
        within: What the joints do in the mean of each window beside that.
        motion: What was measured.
        vector: Parameters: of the model without states, then those of each of `followed`.
        places: Of the unknowns among them.
        acted: Torque that was applied on each free coordinate, shape (k, m).
        free: Which of the robot's n coordinates these are, true or false, shape (n,).
        followed: Effects whose states are simulated along the motion.
    """

    equations: Equations
    error: AlongRows
    slope: AlongRows
    within: WindowTorque
    motion: Motion
    vector: np.ndarray
    places: list[int]
    acted: np.ndarray
    free: np.ndarray
    followed: tuple[AlongMotion, ...] = ()

    def of_all(self, values: np.ndarray, locked: float = np.nan) -> np.ndarray:
        """Values of the free coordinates among those of all, shape (k, m, ...) -> (k, n, ...)."""
        if self.free.all():
            return values
        found = np.full((len(values), len(self.free), *values.shape[2:]), locked)
        found[:, self.free] = values
        return found

    def at(self, model: Model) -> 'Problem':
        """The same with the values of a model of this structure."""
        return replace(self, vector=_vector(model, self.motion.setup))

    def sees(self) -> np.ndarray:
        """Which of the parameters change (TE)."""
        e = self.equations
        plain = np.array(ca.which_depends(e.imbalance, e.p))
        return np.concatenate([plain, np.ones(len(self.vector) - len(plain), bool)])

    def residual(self, vector: np.ndarray) -> np.ndarray:
        """(TE) of each row with these parameters, shape (k, m)."""
        plain = self.equations.p.shape[0]
        found = self.error(vector[:plain])[:, :, 0] + self.within(vector[:plain])
        for effect, own in self._followed(vector):
            force, _ = effect(vector[:plain], vector[own])
            with np.errstate(invalid='ignore'):
                found = found + force[:, None] * effect.direction
        return np.where(np.isnan(found), np.inf, found)  # of one that ran away

    def derivative(self, vector: np.ndarray) -> np.ndarray:
        """Its derivative by the unknowns, shape (k, m, unknowns)."""
        plain = self.equations.p.shape[0]
        k, m = self.motion.position.shape
        found = np.zeros((k, m, len(self.places)))
        found[:, :, [place < plain for place in self.places]] = self.slope(
            vector[:plain]
        ) + self.within.slope(vector[:plain])
        for effect, own in self._followed(vector):
            _, slope = effect(vector[:plain], vector[own])
            for i, place in enumerate(self.places):
                if place in range(own.start, own.stop):
                    found[:, :, i] += slope[:, place - own.start, None] * effect.direction
        return found

    def _followed(self, vector: np.ndarray) -> Iterator[tuple[AlongMotion, slice]]:
        """Each of them, and where its parameters are."""
        first = self.equations.p.shape[0]
        for effect in self.followed:
            last = first + len(effect.names)
            yield effect, slice(first, last)
            first = last


def problems_of(
    model: Model, data_sets: Sequence[DataSet], unknowns: Sequence[Unknown], quick: bool = False
) -> list[Problem]:
    """What is measured, by set-up; unknowns are those that torques see (seen_by_torques)."""
    plain, effects = apart(model)
    quick = quick or bool(effects)
    shorter, longest = (SHORTER, ENOUGH_S / len(data_sets)) if quick else (1.0, np.inf)
    by_setup: dict[Setup, list[DataSet]] = {}
    for data_set in data_sets:
        by_setup.setdefault(data_set.setup, []).append(data_set)
    found = []
    for setup, own in by_setup.items():
        e = assemble(plain, setup)
        motions = [motion_of(plain, data_set, e.input_names, shorter, longest) for data_set in own]
        usable = [motion for motion in motions if motion is not None]
        if not usable:
            continue
        every = together(usable)
        basis = np.asarray(plain.mechanism.kinematics(setup).basis)
        followed = tuple(
            AlongMotion(plain, effect, e.p, e.parameter_names, e.input_names, basis, every.records)
            for effect in effects
        )
        names = [*e.parameter_names, *(name for effect in followed for name in effect.names)]
        places = [names.index(u.name) for u in unknowns]
        own_places = [k for k in places if k < e.p.shape[0]]
        moved = ca.vertcat(*(e.p[k] for k in own_places)) if own_places else ca.SX(0, 1)
        vector, acted = _vector(model, setup), _acted(plain, e, every)
        units = _units(plain, e, setup, np.sqrt(np.mean(acted**2, axis=0)))
        balance, x = e.imbalance / units, np.hstack([every.position, every.rate])
        error, slope = (
            AlongRows(e, ca.densify(wanted), x, every.inputs, every.acceleration)
            for wanted in (balance, ca.jacobian(balance, moved))
        )
        within = WindowTorque(e, e.torques / units, every, own_places)
        moving = plain.mechanism.kinematics(setup).names
        free = np.array([name in moving for name in plain.mechanism.coordinates])
        found.append(
            Problem(e, error, slope, within, every, vector, places, acted, free, followed)
        )
    return found


def _units(model: Model, e: Equations, setup: Setup, typical: np.ndarray) -> ca.SX:
    """What (TE) counts in, (m, 1): what was measured.

    Of what a drive moves that is the torque that it reports: that it delivers nothing, and nothing
    weighs anything, would leave no error. Of what nothing drives it is the acceleration, times the
    inertia of the bodies of the URDF, as there all terms grow with the masses. That inertia is the
    same whatever a model says: else a payload, or masses that a fit has moved, would seem wrong.

    Args:
        model: Without states.
        e: Its equations.
        setup: The set-up.
        typical: Torque on each free coordinate, N m (N), shape (m,).
    """
    own = ca.diag(e.mass_matrix)
    neutral = {n: q.neutral for n, q in model.declarations.items() if q.neutral is not None}
    believed = ca.substitute(own, e.p, parameter_vector(model.with_values(neutral), setup))
    driving = _driving(model, setup) != 0
    units = []
    for k in range(e.coordinates):
        drives = [joint for joint, on in zip(model.mechanism.joints, driving[:, k], strict=True)
                  if on]  # fmt: skip
        if not drives:
            units.append(own[k] / believed[k])
        elif len(drives) == 1 and typical[k] > 0:
            units.append(_delivered(model, e, drives[0], float(typical[k])))
        else:
            units.append(ca.SX(1))
    return ca.vertcat(*units)


def _delivered(model: Model, e: Equations, joint: str, typical: float) -> ca.SX:
    """What the drive of a joint delivers of a torque that it reports, [1]."""
    symbols = dict(zip(e.parameter_names, ca.vertsplit(e.p), strict=True))

    def through(torque: ca.SX) -> ca.SX:
        for effect in acting_effects(model):
            if effect.site == joint and overrides(effect, 'deliver'):
                own = {q.name: symbols[f'{effect.label}.{q.name}'] for q in effect.parameters}
                torque, _ = effect.deliver(torque, [], own)
        return torque

    return (through(ca.SX(typical)) - through(ca.SX(-typical))) / (2 * typical)


def _vector(model: Model, setup: Setup) -> np.ndarray:
    """Parameters of a model without states, then those of the effects that are followed."""
    plain, effects = apart(model)
    own = [model.values[f'{e.label}.{q.name}'] for e in effects for q in e.parameters]
    return np.concatenate([parameter_vector(plain, setup), own])


def _acted(model: Model, e: Equations, motion: Motion) -> np.ndarray:
    """Torque that was applied on each free coordinate, shape (k, m)."""
    driving = _driving(model, motion.setup)
    return motion.inputs[:, : len(driving)] @ driving


def _driving(model: Model, setup: Setup) -> np.ndarray:
    """What one unit of each drive is on each free coordinate, shape (drives, m)."""
    body = model.mechanism
    rows = np.array([body.joints[joint] for joint in body.joints])
    return rows @ np.asarray(body.kinematics(setup).basis)


def residuals(
    problems: Sequence[Problem], unknowns: Sequence[Unknown], theta: np.ndarray
) -> np.ndarray:
    """(TE) of all rows, shape (rows, n), NaN of joints that a set-up locks."""
    return np.vstack([p.of_all(p.residual(_parameters(p, unknowns, theta))) for p in problems])


@dataclass(frozen=True)
class Left:
    """What a model leaves of the torques along one record.

    Attributes:
        error: (TE), N m (N), shape (rows, n), NaN of joints that a set-up locks.
        stride: From one row to the next, s.
    """

    error: np.ndarray
    stride: float


def left_by(model: Model, data_sets: Sequence[DataSet]) -> list[Left]:
    """(TE) of a model as it is along each record that can be used."""
    found: list[Left] = []
    for p in problems_of(model, data_sets, ()):
        begins = np.flatnonzero(p.motion.first)
        errors = np.split(p.of_all(p.residual(p.vector)), begins[1:])
        found += map(Left, errors, p.motion.stride[begins].tolist())
    return found


def all_rows(left: Sequence[Left]) -> np.ndarray:
    """The errors of all records, shape (rows, n)."""
    return np.vstack([one.error for one in left])


def derivatives(
    problems: Sequence[Problem], unknowns: Sequence[Unknown], theta: np.ndarray
) -> np.ndarray:
    """Its derivative by the coordinates of the unknowns, shape (rows, n, unknowns), 0 of those."""
    values = [u.to_value(float(t)) for u, t in zip(unknowns, theta, strict=True)]
    chain = [v if u.logarithmic else 1.0 for v, u in zip(values, unknowns, strict=True)]
    by_value = [p.of_all(p.derivative(_parameters(p, unknowns, theta)), 0.0) for p in problems]
    return np.vstack(by_value) * np.array(chain)


def _parameters(problem: Problem, unknowns: Sequence[Unknown], theta: np.ndarray) -> np.ndarray:
    p = problem.vector.copy()
    p[problem.places] = [u.to_value(float(t)) for u, t in zip(unknowns, theta, strict=True)]
    return p


def apart(model: Model) -> tuple[Model, tuple[Effect, ...]]:
    """A model without states, and of its effects those that are followed along a motion."""
    followed = tuple(e for e in acting_effects(model) if along_motion.follows(e))
    for effect in followed:
        model = model.without_effect(effect.label)
    return without_states(model), followed


def seen_by_torques(model: Model) -> frozenset[str]:
    """Full names of the parameters that (TE) may depend on."""
    plain, followed = apart(model)
    own = {f'{effect.label}.{q.name}' for effect in followed for q in effect.parameters}
    return frozenset(own).union(plain.declarations)


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
