"""MuJoCo's system-identification toolbox, mujoco.sysid, on a MuJoCo model of the same robot.

`sysid.optimize` fits rigid bodies, viscous and dry friction and the initial motions. Each native
parameter (mujoco_natives.py) is then looked at once: the fall of the squared error that the
linearised problem promises if it is added and the rest adapts. The most promising ones are fitted
with the rest by `sysid.optimize`, and the one with the lowest BIC is the cause.
"""

import io
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
from absl import logging
from mujoco import sysid

from cg_dynamics.model import Model
from cg_sysid.identification.data_set import DataSet
from peers import Answer, Case
from peers.mujoco_natives import Native, natives
from peers.mujoco_robot import CHANNELS, channels_of, mjcf, put_inertias, soften, start_of

logging.set_verbosity(logging.ERROR)  # our sensors are computed from the state

LOOKED_AT = 6  # candidates that are fitted, of those that were linearised
AT_NOISE = 1.2  # chi2/N at which no candidate, or no other, could do better
ITERATIONS = 12
FIRST_S = 2.0  # the nominal robot is fitted to so much of each record first
FD_STEP = 1e-3  # all parameters are in units of a change worth noticing
ACCEPTED = 0.02  # fall of log(SSE/N): what healthy robots show by chance and model error
FAR = 1e4  # residual in standard deviations where the simulation runs away


class Problem:
    """Residuals over noise of a robot with one native parameter, as `sysid.optimize` wants them.

    Unknowns: `base`, the six lumps and the frictions that the nominal model has, in tolerances;
    `motion`, the initial motions, in their standard deviations; `native`.
    """

    def __init__(self, nominal: Model, data_sets: Sequence[DataSet], horizon=np.inf,
                 native: Native | None = None):  # fmt: skip
        self.nominal, self.data_sets, self.native = nominal, data_sets, native
        self.believed = [n for n in ('c1', 'c2', 'c3', 'c4', 'c5', 'c6',
                                     'viscous_friction.coefficient', 'coulomb_friction.torque')
                         if n in nominal.quantities]  # fmt: skip
        self.rows = [int(np.searchsorted(t.time, horizon, side='right')) for t in data_sets]
        self.residuals = [self._residual(i) for i in range(len(data_sets))]
        self.samples = sum(np.isfinite(t.outputs[1:n]).sum()
                           for t, n in zip(data_sets, self.rows, strict=True))  # fmt: skip

    def parameters(self, base=None, motion=None, fixed=False) -> sysid.ParameterDict:
        """All unknowns, at zero or at these values."""
        made = sysid.ParameterDict()
        k, m = len(self.believed), sum(len(t.motion) for t in self.data_sets)
        made.add(sysid.Parameter('base', np.zeros(k), -6 * np.ones(k), 6 * np.ones(k),
                                 modifier=self._write_base, frozen=False))  # fmt: skip
        made.add(sysid.Parameter('motion', np.zeros(m), -100 * np.ones(m), 100 * np.ones(m)))
        if self.native:
            n = self.native
            made.add(sysid.Parameter('native', n.start, n.low, n.high,
                                     modifier=self._write_native, frozen=False))  # fmt: skip
        if base is not None:
            made['base'].value = np.array(base)
        if motion is not None:
            made['motion'].value = np.array(motion)
        return made

    def values(self, z) -> dict[str, float]:
        """Parameter values by name."""
        q = self.nominal.quantities
        return self.nominal.values | {
            n: q[n].value + x * q[n].tolerance for n, x in zip(self.believed, z, strict=True)
        }

    def _write_base(self, spec, parameter) -> None:
        values = self.values(parameter.value)
        put_inertias(spec, values)
        hip = spec.joint('hip')
        hip.damping = [values.get('viscous_friction.coefficient', 0.0), 0.0, 0.0]
        hip.frictionloss = values.get('coulomb_friction.torque', 0.0)

    def _write_native(self, spec, parameter) -> None:
        if self.native.write:
            self.native.write(spec, parameter.value)

    def _residual(self, i):
        data_set, n = self.data_sets[i], self.rows[i]
        step = float(np.median(np.diff(data_set.time)))
        spec = mujoco.MjSpec.from_string(mjcf(self.nominal, data_set.setup, step))
        start = self.parameters()
        time = np.arange(n) * step
        mapping = {c: (sysid.SignalType.CustomObs, np.array([k])) for k, c in enumerate(CHANNELS)}
        measured = sysid.TimeSeries(time[1:], data_set.outputs[1:n], mapping)
        at = sum(len(t.motion) for t in self.data_sets[:i])
        own = slice(at, at + len(data_set.motion))

        def build(parameters, spec):
            # Frozen ones too, which the toolbox leaves out.
            for name in parameters.keys():
                parameters[name].apply_modifier(spec)
            return soften(spec.compile())

        def rollout(*, models, datas, control_signal, initial_states, param_dicts, **rest):
            states = [
                start_of(
                    model,
                    data_set,
                    data_set.motion + p['motion'].value[own] * data_set.motion_sigma,
                )
                for model, p in zip(models, param_dicts, strict=True)
            ]
            return sysid.sysid_rollout(models=models, datas=datas, control_signal=control_signal,
                                       initial_states=states, **rest)  # fmt: skip

        def residual(parameters, predicted, measured, model, return_pred_all, state=None, **_):
            simulated = sysid.TimeSeries(
                time[1:], channels_of(model, data_set.setup, state), mapping
            )
            if self.native and self.native.read:
                simulated = self.native.read(simulated, parameters['native'].value)
            r = np.nan_to_num((simulated.data - measured.data) / data_set.sigma, nan=FAR)
            r = np.where(np.isfinite(measured.data), r.clip(-FAR, FAR), 0.0)
            return r, simulated, measured

        model = build(start, spec)
        torque = np.zeros((n, model.nu))
        torque[:, 0] = data_set.inputs[:n, 0]
        sequence = sysid.ModelSequences(
            data_set.name, spec, data_set.name, start_of(model, data_set, data_set.motion),
            sysid.TimeSeries(time, torque), measured, allow_missing_sensors=True,
        )  # fmt: skip
        return sysid.build_residual_fn(
            models_sequences=[sequence], build_model=build, modify_residual=residual,
            custom_rollout=rollout, resample_true=False, n_threads=2,
        )  # fmt: skip

    def __call__(self, x, parameters):
        """Residuals of all data sets, then of the beliefs."""
        base = 0 if parameters['base'].frozen else len(self.believed)
        motions = np.cumsum([base, *(len(t.motion) for t in self.data_sets)])
        parts, predicted, measured = [], [], []
        for i, residual in enumerate(self.residuals):
            # Columns that differ in the motion of other data sets only are one and the same.
            mine = np.array(x, float)
            mine[base : motions[i]] = mine[motions[i + 1] : motions[-1]] = 0.0
            if x.ndim == 1:
                back = slice(None)
            else:
                mine, back = np.unique(mine, axis=1, return_inverse=True)
            r, p, m = residual(mine, parameters)
            parts += [r[0] if x.ndim == 1 else r[0][:, back]]
            predicted += p
            measured += m
        parts.append(np.array(x[: motions[-1]]))
        return parts, predicted, measured

    def squared(self, parameters) -> float:
        """Squared error of the data."""
        parts, _, _ = self(parameters.as_vector(), parameters)
        return float(sum((r**2).sum() for r in parts[:-1]))

    def optimize(self, parameters, iterations=ITERATIONS):
        """The toolbox's own least squares."""
        return sysid.optimize(parameters, self, optimizer='mujoco', verbose=False,
                              max_iters=iterations, eps=FD_STEP, xtol=1e-5,
                              output=io.StringIO())  # fmt: skip


def promise(problem: Problem, found, jacobian, group: list[Native], case: Case):
    """Fall of the squared residuals if this is added and all adapts, linearised; and where to."""
    x = found.as_vector()
    here = np.concatenate(problem(x, found)[0])
    columns = []
    for native in group:
        other = Problem(case.nominal, case.train, native=native)
        there = other.parameters(found['base'].value, found['motion'].value)
        columns.append(np.concatenate(other(there.as_vector(), there)[0][:-1]) - here[: -len(x)])
    d = np.vstack([np.column_stack(columns), np.zeros((len(x), len(columns)))])
    q, _ = np.linalg.qr(jacobian)
    d -= q @ (q.T @ d)
    left = here - q @ (q.T @ here)
    size, *_ = np.linalg.lstsq(d, -left, rcond=1e-9)
    native = group[0]
    start = np.array(native.start, float)
    if len(group) == 2:
        # Sine and cosine of one ripple.
        start[0], start[2] = np.hypot(*size), np.arctan2(size[1], size[0])
    elif native.effect != 'torque_saturation':
        start[0] *= size[0]
    if not (native.low[0] <= start[0]):
        return 0.0, start
    start = np.clip(start, native.low, native.high)
    return float(left @ left - np.sum((left + d @ size) ** 2)), start


def name_cause(case: Case) -> Answer:
    """The nominal robot, a look at every native parameter, fits of the promising ones."""
    first = Problem(case.nominal, case.train, FIRST_S)
    lead, _ = first.optimize(first.parameters())
    problem = Problem(case.nominal, case.train)
    found, result = problem.optimize(problem.parameters(lead['base'].value, lead['motion'].value))
    n = problem.samples
    base = n * np.log(problem.squared(found) / n)
    looks = {}
    for group in natives(case) if base > n * np.log(AT_NOISE) else ():
        fall, start = promise(problem, found, result.jac, group, case)
        if fall > looks.get(group[0].effect, (0.0,))[0]:
            looks[group[0].effect] = fall, replace(group[0], start=start)
    best = (base, problem, found, '')
    for _, native in sorted(looks.values(), key=lambda look: -look[0])[:LOOKED_AT]:
        other = Problem(case.nominal, case.train, native=native)
        try:
            fitted, _ = other.optimize(
                other.parameters(found['base'].value, found['motion'].value)
            )
        except (ValueError, np.linalg.LinAlgError):
            continue
        bic = n * np.log(other.squared(fitted) / n) + len(native.start) * np.log(n)
        if bic < best[0]:
            best = bic, other, fitted, native.effect
        if other.squared(fitted) < AT_NOISE * n:
            break
    bic, final, fitted, cause = best
    strength = (base - bic) / n
    if strength < ACCEPTED:
        final, fitted, cause = problem, found, ''
    return Answer(cause, held_error(final, fitted, case), strength)


def held_error(final: Problem, fitted, case: Case) -> float:
    """chi2/N on the held-out data sets, of which only the initial motion is fitted."""
    held = Problem(case.nominal, case.held, native=final.native)
    parameters = held.parameters(fitted['base'].value)
    parameters['base'].frozen = True
    if final.native:
        parameters['native'].value = fitted['native'].value
        parameters['native'].frozen = True
    moved, _ = held.optimize(parameters)
    return held.squared(moved) / held.samples
