"""Equations along measured motion: what a hypothesis leaves of the measured accelerations.

Angles and rates are smoothed and differentiated by Savitzky and Golay; the same filter smooths the
accelerations that a model computes along the motion, so that both sides of the equation are bent
alike. Rows are what is left of the smoothed angles (where sensors agree or do not), of their rates
and of their accelerations, each over its noise.
"""

import casadi as ca
import numpy as np
from scipy.signal import savgol_coeffs, savgol_filter

from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.mechanisms import Mechanism
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.identification.data_set import DataSet, sensor_matrix

WINDOW = 31  # samples
DEGREE = 4
KEEP = 5  # every so many rows: neighbours share their window


class Along:
    """A model's equations along measured motion, in one set-up."""

    def __init__(self, model: Model, setup: Setup):
        e = assemble(model, setup)
        self.m, self.step = e.coordinates, e.largest_step
        m2 = 2 * self.m
        self.names, self.inputs = e.parameter_names, e.input_names
        self.states = e.x.shape[0] - m2
        self.delays = ca.Function('delays', [e.p], [e.input_delay, e.output_delays])
        self.read = ca.Function('read', [e.x, e.u, e.p], [e.rates[self.m : m2], e.outputs])
        self.initial = ca.Function('initial', [e.x, e.u, e.p], [e.initial])
        motion, z = e.x[:m2], e.x[m2:]
        self.drive = ca.Function('drive', [z, motion, e.u, e.p], [e.rates[m2:]])

    def extra_states(self, time, motion, u, p):
        """States of effects, driven by the motion (n, 2m): shape (n, states)."""
        if not self.states:
            return np.zeros((len(time), 0))
        dt = float(np.median(np.diff(time)))
        parts = max(1, round(dt / min(self.step, dt)))
        z, a = ca.SX.sym('z', self.states), ca.SX.sym('a', 2 * self.m)
        b = ca.SX.sym('b', 2 * self.m)
        held, q = ca.SX.sym('u', u.shape[1]), ca.SX.sym('p', len(p))
        h, x = dt / parts, z
        for i in range(parts):
            at = [a + (b - a) * (i + share) / parts for share in (0.0, 0.5, 1.0)]
            k1 = self.drive(x, at[0], held, q)
            k2 = self.drive(x + h / 2 * k1, at[1], held, q)
            k3 = self.drive(x + h / 2 * k2, at[1], held, q)
            k4 = self.drive(x + h * k3, at[2], held, q)
            x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        step = ca.Function('step', [z, a, b, held, q], [x]).mapaccum(len(time) - 1)
        full = np.concatenate([motion[0], np.zeros(self.states)])
        first = np.asarray(self.initial(full, u[0], p)).ravel()[2 * self.m :]
        same = np.tile(p[:, None], len(time) - 1)
        rest = step(first, motion[:-1].T, motion[1:].T, u[:-1].T, same)
        return np.vstack([first, np.asarray(rest).T])


_models: dict[tuple, Along] = {}


def along(model: Model, setup) -> Along:
    """Equations of a model in a set-up, assembled once for each structure."""
    springs = tuple(s.body for s in setup.springs)
    key = (tuple(e.label for e in model.effects), setup.stance, setup.fixture, springs)
    if key not in _models:
        _models[key] = Along(model, setup)
    return _models[key]


def filled(outputs):
    """Outputs without gaps: the first sample stands for what is missing before it."""
    found = outputs.copy()
    for column in found.T:
        seen = np.flatnonzero(np.isfinite(column))
        if len(seen):
            column[:] = np.interp(np.arange(len(column)), seen, column[seen])
    return np.nan_to_num(found)


def late(u, delay, step):
    """Held inputs (n, nu) that act late by `delay` s."""
    rows, share = divmod(delay / step, 1.0)
    at = np.arange(len(u)) - int(rows)
    return (1 - share) * u[np.maximum(at, 0)] + share * u[np.maximum(at - 1, 0)]


class Measured:
    """One data set, and the rows that it is to a hypothesis."""

    def __init__(self, body: Mechanism, data_set: DataSet):
        self.data_set = data_set
        self.step = float(np.median(np.diff(data_set.time)))
        c = sensor_matrix(body, data_set.setup)
        m = c.shape[1] // 2
        self.matrix = c
        angles = np.array([unit == 'rad' for unit in body.output_units])
        seen = np.isfinite(data_set.outputs).any(axis=0)
        self.angles, self.rates = np.flatnonzero(angles & seen), np.flatnonzero(~angles & seen)
        gain = [
            np.linalg.norm(savgol_coeffs(WINDOW, DEGREE, deriv=d, delta=self.step))
            for d in range(3)
        ]
        sa, sr = data_set.sigma[self.angles], data_set.sigma[self.rates]
        self.c = [c[self.angles][:, :m], c[self.rates][:, m:]]
        self.noise = [
            sa * gain[0],
            np.r_[sa * gain[1], sr * gain[0]],
            np.r_[sa * gain[2], sr * gain[1]],
        ]
        self.maps = [self.c[0], np.vstack(self.c), np.vstack(self.c)]
        self.solvers = [
            np.linalg.pinv(a / n[:, None]) / n for a, n in zip(self.maps, self.noise, strict=True)
        ]

    def motion(self, outputs, window=WINDOW):
        """Coordinates and rates (n, 2m) from outputs, and the smoothed channels."""

        def smooth(values, derivative):
            return savgol_filter(values, window, DEGREE, derivative, self.step, axis=0)

        a, r = outputs[:, self.angles], outputs[:, self.rates]
        levels = [
            smooth(a, 0),
            np.hstack([smooth(a, 1), smooth(r, 0)]),
            np.hstack([smooth(a, 2), smooth(r, 1)]),
        ]
        s, ds = (x @ solver.T for x, solver in zip(levels[:2], self.solvers[:2], strict=True))
        return np.hstack([s, ds]), levels

    def rows(self, model: Model) -> np.ndarray:
        """Everything that the hypothesis leaves unexplained, in standard deviations."""
        data_set, equations = self.data_set, along(model, self.data_set.setup)
        p = parameter_vector(model, data_set.setup)
        input_delay, output_delays = (np.asarray(d).ravel() for d in equations.delays(p))
        # What delays all sensors is an early torque. A held torque changes at a row, where a
        # smoothed acceleration sees half of the change.
        common = output_delays.min()
        u = late(data_set.inputs_for(equations.inputs), input_delay[0] + common + self.step / 2,
                 self.step)  # fmt: skip
        measured = filled(data_set.outputs)
        # Corrections of sensors come from motion that is smoothed more: with the noise of the
        # target in it a column would seem to explain that noise.
        sensors = any(effect.place in ('sensor', 'timing') for effect in model.effects)
        motion, _ = self.motion(measured, 3 * WINDOW if sensors else WINDOW)
        z = equations.extra_states(data_set.time, motion, u, p)
        _, reported = self._read(equations, np.hstack([motion, z]), u, p)
        ideal = motion @ self.matrix.T
        for j, delay in enumerate(output_delays - common):
            reported[:, j] = np.interp(data_set.time - delay, data_set.time, reported[:, j])
        motion, levels = self.motion(measured - (reported - ideal))
        acceleration, _ = self._read(equations, np.hstack([motion, z]), u, p)
        smooth = savgol_filter(acceleration, WINDOW, DEGREE, axis=0)
        expected = [motion[:, : equations.m], motion[:, equations.m :], smooth]
        left = [
            (level - x @ a.T) / n
            for level, x, a, n in zip(levels, expected, self.maps, self.noise, strict=True)
        ]
        return np.hstack(left)[2 * WINDOW : -2 * WINDOW : KEEP].ravel()

    @staticmethod
    def _read(equations, x, u, p):
        found = equations.read.map(len(x))(x.T, u.T, np.tile(p[:, None], len(x)))
        return (np.asarray(part).T for part in found)
