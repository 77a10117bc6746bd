"""Identification by simulation error: ours beside Nelder-Mead and scipy least_squares, one run.

    ./cg exec python bench/identification.py [--starts 100] [--limit 150] [--out FILE]

The problem: 8 parameters (six lumps, viscous and dry friction), four records of 5 s at 500 Hz
(one per set-up) of a robot whose parameters are known, with sensor noise. Every method minimises
the same cost (Eq. 4.13 weighted by the noise, plus the file's belief) from the same starts, in
which every parameter is off by up to 30 %. A start counts as converged when its cost comes within
1 % of the best that any method found. All times are CPU time of this process.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import least_squares, minimize

from cg_bringup.hidden import perturb
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.rollout.compiled import compile_model
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.identification.unknowns import unknowns_of

SETUPS = (
    'spring_stabilised_inner',
    'spring_stabilised_outer',
    'swing_inner_fixed',
    'swing_outer_fixed',
)
SECONDS = 5.0
OFF = 0.3
CONVERGED = 1.01
FAR = 1e9  # cost where the simulation runs away, for methods that cannot be told


class Problem:
    """One cost function for all methods.

    The unknowns are the eight parameters and, record by record, the initial motion (12 numbers).
    """

    def __init__(self, model, data_sets):
        self.model, self.data_sets = model, data_sets
        self.unknowns = unknowns_of(model)
        self.names = [u.name for u in self.unknowns]
        self.compiled = [compile_model(model, data_set.setup) for data_set in data_sets]
        self.vectors = [parameter_vector(model, data_set.setup) for data_set in data_sets]
        self.places = [
            [c.parameter_names.index(name) for name in self.names] for c in self.compiled
        ]
        self.sizes = [len(data_set.motion) for data_set in data_sets]
        self.lower = np.array([u.lower for u in self.unknowns])
        self.upper = np.array([u.upper for u in self.unknowns])
        self.calls = 0

    def pack(self, values, motions=None):
        """All unknowns in one vector."""
        return np.concatenate(
            [values, *(motions or [data_set.motion for data_set in self.data_sets])]
        )

    def residuals(self, z, integrate=None):
        """Weighted residuals of all records, then those of the beliefs."""
        self.calls += 1
        k = len(self.names)
        values = z[:k]
        parts, at = [], k
        real = all(
            c > 0
            for c in self.model.mechanism.consistency(
                self.model.values | dict(zip(self.names, values, strict=True))
            )
        )
        if (values < self.lower).any() or (values > self.upper).any() or not real:
            return None
        for i, (data_set, compiled) in enumerate(zip(self.data_sets, self.compiled, strict=True)):
            p = self.vectors[i]
            p[self.places[i]] = values
            motion = z[at : at + self.sizes[i]]
            at += self.sizes[i]
            try:
                states = (integrate or _compiled_states)(compiled, data_set, motion, p)
                y = compiled.outputs(data_set.time, data_set.inputs, states, p)
            except DynamicsError:
                return None
            parts.append(((y - data_set.outputs) / data_set.sigma).ravel())
            parts.append((motion - data_set.motion) / data_set.motion_sigma)
        belief = [(v - u.prior) / u.tolerance for u, v in zip(self.unknowns, values, strict=True)]
        return np.concatenate([*parts, belief])

    def cost(self, z, integrate=None):
        """Sum of squared residuals."""
        r = self.residuals(z, integrate)
        return FAR if r is None else float(r @ r)


def _compiled_states(compiled, data_set, motion, p):
    return compiled.simulate(data_set.time, data_set.inputs, motion, p)


def _solve_ivp_states(compiled, data_set, motion, p):
    """The way of the thesis: a general-purpose integrator around a Python right-hand side."""
    step = data_set.time[1] - data_set.time[0]

    def rates(t, x):
        k = min(int(t / step + 1e-9), len(data_set.time) - 1)
        return np.asarray(compiled.f(x, data_set.inputs[k], p)).ravel()

    solution = solve_ivp(
        rates, (0, data_set.time[-1]), motion, t_eval=data_set.time, rtol=1e-6, atol=1e-8,
        max_step=4 * step,
    )  # fmt: skip
    return np.ascontiguousarray(solution.y.T)


def records_of(machine, seed):
    found = []
    for i, name in enumerate(SETUPS):
        e = load_experiment(name)
        settings = ExcitationSettings(**e.excitation, duration=SECONDS, seed=10 * seed + i)
        found.append(
            rehearse(
                name,
                machine,
                e.setup,
                e.initial_state,
                [make_signal(settings)],
                SECONDS,
                seed=100 * seed + i,
            )
        )
    return found


def start_models(nominal, truth, count):
    """Models whose unknowns are off the truth by up to 30 %, each a real robot."""
    rng = np.random.default_rng(20)
    names = [u.name for u in unknowns_of(nominal)]
    while count:
        factors = 1 + rng.uniform(-OFF, OFF, len(names))
        try:
            model = nominal.with_values(
                {n: truth.values[n] * f for n, f in zip(names, factors, strict=True)}
            )
            model.require_consistency()
        except DynamicsError:
            continue
        count -= 1
        yield model


def ours(problem, model, start, data_sets):
    """Our fit: set out from `start`, believing what the nominal file believes."""
    began = time.process_time()
    at = {name: start.values[name] for name in problem.names}
    found = fit(model, data_sets, at=at)
    spent = time.process_time() - began
    cost = problem.cost(problem.pack(found.values, list(found.motions)))
    return spent, cost, found.values, found.evaluations


def nelder_mead(problem, model, limit, integrate=None):
    z0 = problem.pack([model.values[n] for n in problem.names])
    began, best = time.process_time(), [FAR, z0]

    def timed(z):
        value = problem.cost(z, integrate)
        if value < best[0]:
            best[:] = value, z.copy()
        if time.process_time() - began > limit:
            raise TimeoutError
        return value

    problem.calls = 0
    scale = np.where(np.abs(z0) > 1e-6, 0.05 * np.abs(z0), 0.01)
    simplex = np.vstack([z0, z0 + np.diag(scale)])
    try:
        minimize(
            timed,
            z0,
            method='Nelder-Mead',
            options={
                'initial_simplex': simplex,
                'maxiter': 100000,
                'maxfev': 100000,
                'adaptive': True,
                'xatol': 1e-7,
                'fatol': 1.0,
            },
        )
    except TimeoutError:
        pass
    return time.process_time() - began, best[0], best[1][: len(problem.names)], problem.calls


def scipy_least_squares(problem, model):
    z0 = problem.pack([model.values[n] for n in problem.names])
    far = np.full(len(problem.residuals(z0)), np.sqrt(FAR / len(problem.residuals(z0))))
    problem.calls = 0

    def safe(z):
        r = problem.residuals(z)
        return far if r is None else r

    free = np.inf * np.ones(sum(problem.sizes))
    began = time.process_time()
    found = least_squares(
        safe, z0, x_scale='jac', max_nfev=60,
        bounds=(np.concatenate([problem.lower, -free]), np.concatenate([problem.upper, free])),
    )  # fmt: skip
    spent = time.process_time() - began
    return spent, problem.cost(found.x), found.x[: len(problem.names)], problem.calls


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--starts', type=int, default=100)
    parser.add_argument('--slow-starts', type=int, default=3)
    parser.add_argument('--limit', type=float, default=150.0, help='CPU s for one slow run')
    parser.add_argument('--out', type=Path)
    options = parser.parse_args()
    nominal = Model.load(model_path(NOMINAL_MODEL))
    truth, _ = perturb(nominal, np.random.default_rng(1))
    records = records_of(truth, 1)
    data_sets = prepare(nominal, records)
    true = np.array([truth.values[u.name] for u in unknowns_of(nominal)])
    models = list(start_models(nominal, truth, options.starts))
    # Every start believes the same: the belief is part of the cost, the start is not.
    problem = Problem(nominal, data_sets)
    fit(nominal, data_sets)  # compile before the clock runs

    rows = {'ours': [ours(problem, nominal, m, data_sets) for m in models]}
    best = min(cost for _, cost, _, _ in rows['ours'])
    few = models[: options.slow_starts]
    rows['least_squares, finite differences, same compiled simulator'] = [
        scipy_least_squares(problem, m) for m in models[: 4 * options.slow_starts]
    ]
    rows['Nelder-Mead, same compiled simulator'] = [
        nelder_mead(problem, m, options.limit) for m in few
    ]
    rows['Nelder-Mead, solve_ivp'] = [
        nelder_mead(problem, few[0], options.limit, _solve_ivp_states)
    ]
    best = min(best, *(cost for runs in rows.values() for _, cost, _, _ in runs))
    reference = np.median([spent for spent, *_ in rows['ours']])
    lines = [
        f'8 parameters, {len(SETUPS)} records of {SECONDS:g} s at 500 Hz, starts {OFF:.0%} off.',
        f'Best cost of all methods {best:.1f}.',
        '',
        '| method | starts | converged | CPU median s | of ours | cost / best | '
        'parameter error, rms % | evaluations |',
        '|---|---|---|---|---|---|---|---|',
    ]
    for name, runs in rows.items():
        spent = np.median([r[0] for r in runs])
        costs = np.array([r[1] for r in runs])
        error = np.median([np.sqrt(np.mean((r[2] / true - 1) ** 2)) for r in runs])
        lines.append(
            f'| {name} | {len(runs)} | {(costs < CONVERGED * best).sum()} | {spent:.3f} '
            f'| {spent / reference:.1f}x | {np.median(costs) / best:.4g} | {100 * error:.2g} '
            f'| {np.median([r[3] for r in runs]):.0f} |'
        )
    text = '\n'.join(lines) + '\n'
    print(text)
    if options.out:
        command = f'python bench/identification.py --limit {options.limit:g}'
        options.out.write_text(
            f'# Identification\n\nCommand: `{command}`. A slow run is cut off after '
            f'{options.limit:g} s of CPU.\n\n{text}'
        )


if __name__ == '__main__':
    main()
