"""Grey box ranked by BIC: what a careful engineer would script around our simulator.

For each effect of our library scipy's least_squares minimises the simulation error, from the best
nominal model and the first start of the effect; exact sensitivities, the model file's tolerances
as a prior, the initial motion of each record unknown. The effect with the lowest

    BIC = N log(SSE/N) + k log N,

the residual taken for white noise, is the cause, if that is 10 below the nominal model's.
"""

from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.effects import LIBRARY
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.rollout.compiled import compile_model
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.unknowns import unknowns_of
from peers import Answer, Case, effects_for

ACCEPTED = 10.0  # fall of BIC
EVALUATIONS = 40
FIRST_S = 2.0  # the nominal model is fitted to so much of each record first
FAR = 1e4  # residual in standard deviations where the simulation runs away


class SimulationError:
    """Residuals over noise of a model on data sets, and their Jacobian.

    The unknowns are the coordinates of the model's parameters, then the initial motion of each
    data set.
    """

    def __init__(self, model: Model, data_sets: tuple[DataSet, ...], horizon: float, fixed=False):
        self.model = model
        self.unknowns = () if fixed else unknowns_of(model)
        self.data_sets, self.parts = data_sets, []
        names = [u.name for u in self.unknowns]
        for data_set in data_sets:
            compiled = compile_model(model, data_set.setup)
            m2 = 2 * compiled.equations.coordinates
            n = int(np.searchsorted(data_set.time, horizon, side='right'))
            u = data_set.inputs_for(compiled.input_names)
            column = [m2 + names.index(f) if f in names else -1 for f in compiled.free]
            places = [compiled.parameter_names.index(name) for name in names]
            p = parameter_vector(model, data_set.setup)
            self.parts.append((data_set, compiled, n, u[:n], np.array(column), places, p))

    def bounds(self):
        """Ranges of the unknowns."""
        low = [
            u.to_coordinate(u.lower) if u.lower > 0 or not u.logarithmic else -np.inf
            for u in self.unknowns
        ]
        high = [u.to_coordinate(u.upper) for u in self.unknowns]
        own = [np.inf] * sum(len(t.motion) for t in self.data_sets)
        return np.array(low + [-x for x in own]), np.array(high + own)

    def values(self, z):
        """Parameter values at a point."""
        return [u.to_value(c) for u, c in zip(self.unknowns, z[: len(self.unknowns)], strict=True)]

    def __call__(self, z):
        """(residuals, Jacobian, of which so many are data); residuals FAR off the road."""
        k, values = len(self.unknowns), self.values(z)
        chain = np.array(
            [v if u.logarithmic else 1.0 for u, v in zip(self.unknowns, values, strict=True)]
        )
        numbers = self.model.values | {
            u.name: v for u, v in zip(self.unknowns, values, strict=True)
        }
        real = all(c > 0 for c in self.model.mechanism.consistency(numbers))
        rows, slopes, at = [], [], k
        for data_set, compiled, n, u, column, places, p in self.parts:
            m2 = len(data_set.motion)
            motion = z[at : at + m2]
            p[places] = values
            x0, by_motion, by_free = compiled.initial_sensitivity(motion, u[0], p)
            s0 = np.zeros((compiled.nx, m2 + k))
            s0[:, :m2] = by_motion
            for f, c in enumerate(column):
                if c >= 0:
                    s0[:, c] = by_free[:, f]
            seen = np.isfinite(data_set.outputs[:n])
            ok = False
            if real:
                normal, y, jacobian = compiled.normal(
                    data_set.time[:n],
                    u,
                    x0,
                    s0,
                    p,
                    column,
                    data_set.outputs[:n],
                    1 / data_set.sigma,
                    keep=True,
                )
                ok = normal.rows == n and np.isfinite(jacobian).all()
            slope = np.zeros((seen.sum(), len(z)))
            if ok:
                r = ((y - data_set.outputs[:n]) / data_set.sigma)[seen]
                j = (jacobian / data_set.sigma[:, None])[seen]
                slope[:, at : at + m2] = j[:, :m2]
                slope[:, :k] = j[:, m2:] * chain
            else:
                r = np.full(seen.sum(), FAR)
            rows.append(r)
            slopes.append(slope)
            at += m2
        data = sum(len(r) for r in rows)
        # What is believed: the initial motion as measured, the parameters as the file says.
        at = k
        for data_set in self.data_sets:
            m2 = len(data_set.motion)
            rows.append((z[at : at + m2] - data_set.motion) / data_set.motion_sigma)
            slope = np.zeros((m2, len(z)))
            slope[:, at : at + m2] = np.diag(1 / data_set.motion_sigma)
            slopes.append(slope)
            at += m2
        for i, u in enumerate(self.unknowns):
            if np.isfinite(u.tolerance):
                rows.append([(z[i] - u.to_coordinate(u.prior)) / u.tolerance])
                slope = np.zeros((1, len(z)))
                slope[0, i] = 1 / u.tolerance
                slopes.append(slope)
        return np.concatenate(rows), np.vstack(slopes), data


@dataclass(frozen=True)
class Fitted:
    """A minimum: values by name, initial motions, and the squared error of the data."""

    values: dict[str, float]
    motions: list[np.ndarray]
    squared: float
    samples: int

    def bic(self, parameters: int) -> float:
        """Less is better."""
        n = self.samples
        return n * np.log(self.squared / n) + parameters * np.log(n)


def minimise(
    model: Model, data_sets, at=None, motions=None, horizon=np.inf, fixed=False
) -> Fitted:
    """least_squares from the values `at` and the motions, by default those measured."""
    error = SimulationError(model, data_sets, horizon, fixed)
    at = at or {}
    start = [u.to_coordinate(at.get(u.name, u.prior)) for u in error.unknowns]
    z0 = np.concatenate([start, *(motions or [data_set.motion for data_set in data_sets])])
    low, high = error.bounds()
    last = {}

    def evaluate(z):
        key = z.tobytes()
        if last.get('key') != key:
            last.update(key=key, value=error(z))
        return last['value']

    found = least_squares(
        lambda z: evaluate(z)[0], np.clip(z0, low, high), lambda z: evaluate(z)[1],
        bounds=(low, high), x_scale='jac', max_nfev=EVALUATIONS, ftol=1e-5, xtol=1e-6,
    )  # fmt: skip
    rows, _, data = evaluate(found.x)
    values = {u.name: v for u, v in zip(error.unknowns, error.values(found.x), strict=True)}
    cuts = np.cumsum([len(error.unknowns), *(len(data_set.motion) for data_set in data_sets)])
    return Fitted(values, np.split(found.x, cuts)[1:-1], float(rows[:data] @ rows[:data]), data)


def held_error(model: Model, data_sets) -> float:
    """chi2/N of a model on data sets, of which only the initial motion is fitted."""
    found = minimise(model, data_sets, fixed=True)
    return found.squared / found.samples


def first_start(name: str) -> dict[str, float]:
    """The value that each parameter of an effect declares first."""
    return {p.name: p.default for p in LIBRARY[name].parameters}


def identify_nominal(case: Case) -> Fitted:
    """The nominal model on the training data sets: straight, or by way of a short horizon."""
    straight = minimise(case.nominal, case.train)
    lead = minimise(case.nominal, case.train, horizon=FIRST_S)
    led = minimise(case.nominal, case.train, lead.values, lead.motions)
    return min(straight, led, key=lambda found: found.squared)


def name_cause(case: Case) -> Answer:
    """Fit every effect on top of the nominal model; the lowest BIC wins."""
    base = identify_nominal(case)
    best, best_model, best_bic, cause = base, case.nominal, base.bic(0) - ACCEPTED, ''
    for name, at in effects_for(case):
        try:
            model = case.nominal.with_effect(name, at, **first_start(name))
            found = minimise(model, case.train, base.values, base.motions)
        except DynamicsError:
            continue
        bic = found.bic(len(found.values) - len(base.values))
        if bic < best_bic:
            best, best_model, best_bic, cause = found, model, bic, name
    strength = base.bic(0) - best_bic if cause else 0.0
    return Answer(cause, held_error(best_model.with_values(best.values), case.held), strength)
