"""Compiled models: CasADi expressions to C, built once, cached by content, called on arrays.

Rollouts of a model structure in a set-up are machine code (rollout.py); parameter values are
arguments, so a fit never compiles. Where no C compiler is found the same
interface runs on CasADi's virtual machine (fallback.py), slower, and says so once.
"""

import logging
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from cg_dynamics.assemble import Equations, acting_effects, assemble, parameter_vector
from cg_dynamics.effects.effect import CLOCKS
from cg_dynamics.errors import SimulationError
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.accuracy import REFERENCE_STEP, Accuracy
from cg_dynamics.rollout.compiler import compiler
from cg_dynamics.rollout.fallback import InterpretedRollout
from cg_dynamics.rollout.native import NativeRollout, symbols_of
from cg_dynamics.rollout.vector_code import UnsupportedError

log = logging.getLogger(__name__)

SMALLEST_STEP = 1e-4
SAME_INSTANT = 1e-9  # s
STIFFNESS = 1.0  # step times fastest rate; Runge-Kutta's fourth order is unstable beyond 2.8


@dataclass(frozen=True)
class Normal:
    """Normal equations of one record (Judged.normal).

    Attributes:
        hessian: Sum of J'WJ, shape (nc, nc).
        gradient: Sum of J'Wr, shape (nc,).
        sse: Weighted squared error of each output, shape (ny,).
        count: Samples of each output, shape (ny,).
        rows: Rows simulated before the state ran away.
    """

    hessian: np.ndarray
    gradient: np.ndarray
    sse: np.ndarray
    count: np.ndarray
    rows: int


@dataclass(frozen=True)
class _Rows:
    """Rows of a simulation.

    Attributes:
        time: Their stamps in s, shape (m,).
        inputs: Inputs from each row to the next, late ones late, shape (m, nu).
        slope: Their derivative by the delay, as if it went on over the recorded row, (m, nu).
        recorded: Which of them were recorded, shape (n,).
    """

    time: np.ndarray
    inputs: np.ndarray
    slope: np.ndarray
    recorded: np.ndarray


class CompiledModel:
    """A model structure in a set-up, as numeric functions of state, inputs and parameters.

    Attributes:
        equations: The symbolic equations.
        free: Names of the parameters with sensitivities, in the order of `column`.

    Args:
        native: To machine code; else for CasADi's virtual machine.
    """

    def __init__(self, equations: Equations, free: tuple[str, ...], native: bool = True):
        self.equations = equations
        self.free = free
        self.state_names = equations.state_names
        self.parameter_names = equations.parameter_names
        self.input_names = equations.input_names
        self._never_late = [i for i, name in enumerate(self.input_names) if name in CLOCKS]
        self.channels = equations.channels
        self.nx, self.nu = equations.x.shape[0], equations.u.shape[0]
        self.np, self.ny = equations.p.shape[0], equations.outputs.shape[0]
        e = equations
        self.largest_step = min(e.largest_step, REFERENCE_STEP)
        free_symbols = symbols_of(e, free)
        delays = ca.vertcat(e.input_delay, e.output_delays)
        self._delays = ca.Function('delays', [e.p], [delays, ca.jacobian(delays, free_symbols)])
        self._initial = ca.Function(
            'initial',
            [e.x, e.u, e.p],
            [e.initial, ca.jacobian(e.initial, e.x), ca.jacobian(e.initial, free_symbols)],
        )
        self.f = ca.Function('f', [e.x, e.u, e.p], [e.rates], ['x', 'u', 'p'], ['dx'])
        self.h = ca.Function('h', [e.x, e.u, e.p], [e.outputs], ['x', 'u', 'p'], ['y'])
        self._stiffness = ca.Function('stiffness', [e.x, e.u, e.p], e.rates_by(e.x))
        self.has_delays = not delays.is_zero()
        self._instant, self._on_time = np.zeros(1), np.zeros(self.ny)
        self._c: Any = (NativeRollout if native else InterpretedRollout)(equations, free)

    def delays(self, p: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        """Input delay in s, output delays in s (ny,), and their Jacobian (1 + ny, nf)."""
        if not self.has_delays:
            return 0.0, np.zeros(self.ny), np.zeros((1 + self.ny, len(self.free)))
        values, jacobian = self._delays(p)
        values = np.asarray(values).ravel()
        return float(values[0]), values[1:], np.asarray(jacobian)

    def initial_state(self, motion: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
        """Full state at the start: shape (nx,).

        Args:
            motion: Free coordinates and their rates, shape (2 m,), extra states settled; or
                (nx,), how far these are from that behind, in their spreads (`start_spreads`).
            u: Inputs held at the start, shape (nu,).
            p: Parameter vector.
        """
        return self.initial_sensitivity(motion, u, p)[0]

    def initial_sensitivity(self, motion, u, p) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `initial_state`, with d/d(motion), shape of motion, and d/d(free) (nx, nf)."""
        m2 = 2 * self.equations.coordinates
        if self.nx == m2:
            return np.array(motion, float), np.eye(m2), np.zeros((m2, len(self.free)))
        x = np.zeros(self.nx)
        x[: len(motion)] = motion
        full, by_x, by_p = self._initial(x, u, p)
        return np.asarray(full).ravel(), np.asarray(by_x)[:, : len(motion)], np.asarray(by_p)

    def step_for(self, x0: np.ndarray, u: np.ndarray, p: np.ndarray) -> float:
        """Longest of equal integration steps in s at which this motion is simulated well.

        Dry friction, smoothed, is stiffest at standstill under load: there a time constant of
        the linearised model can be far below a sample, and Runge-Kutta's step has to follow it.

        Args:
            x0: State whose pose counts, shape (nx,).
            u: Inputs, shape (n, nu); the largest of each counts.
            p: Parameter vector.
        """
        m = self.equations.coordinates
        still = np.array(x0, float)
        still[m : 2 * m] = 0.0
        matrix = np.asarray(self._stiffness(still, np.abs(u).max(axis=0), p))
        if not np.isfinite(matrix).all():
            return self.largest_step
        fastest = np.abs(np.linalg.eigvals(matrix)).max()
        return max(SMALLEST_STEP, min(self.largest_step, STIFFNESS / max(fastest, 1e-9)))

    def delayed_inputs(
        self, time: np.ndarray, u: np.ndarray, delay: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Mean of u(t - delay) over each row's interval, and its derivative by the delay.

        Args:
            time: Stamps of the rows in s, shape (n,).
            u: Held inputs, shape (n, nu). Before the first row the first value counts.
            delay: In s.
        """
        if not self.has_delays:
            return u, np.zeros_like(u)
        slope = np.zeros_like(u)
        held = u[_row_at(time, time - delay)]
        slope[:-1] = -np.diff(held, axis=0) / np.diff(time)[:, None]
        slope[:, self._never_late] = 0.0
        return self._means(time, time, u, delay), slope

    def _means(
        self, rows: np.ndarray, time: np.ndarray, u: np.ndarray, delay: float
    ) -> np.ndarray:
        """Mean of u(t - delay) from each of `rows` to the next; u is held from `time` on."""
        edges, row, own = rows - delay, _row_at(time, rows - delay), _row_at(time, rows)
        area = np.cumsum(u[:-1] * np.diff(time)[:, None], axis=0)
        area = np.vstack([np.zeros(u.shape[1]), area])
        integral = area[row] + u[row] * (edges - time[row])[:, None]
        mean = u[own]
        mean[:-1] = np.diff(integral, axis=0) / np.diff(rows)[:, None]
        mean[:, self._never_late] = u[own][:, self._never_late]
        return mean

    def _late_rows(
        self, time: np.ndarray, u: np.ndarray, p: np.ndarray, refinement: float
    ) -> '_Rows':
        delay = self.delays(p)[0]
        late, slope = self.delayed_inputs(time, u, delay)
        if refinement <= 1 or delay <= 0:
            return _Rows(time, late, slope, np.arange(len(time)))
        changes = time[1:] + delay
        changes = changes[changes < time[-1]]
        row = _row_at(time, changes)
        gap = np.minimum(changes - time[row], time[row + 1] - changes)
        rows = np.sort(np.concatenate([time, changes[gap > SAME_INSTANT]]))
        means, slopes = self._means(rows, time, u, delay), slope[_row_at(time, rows)]
        return _Rows(rows, means, slopes, np.searchsorted(rows, time))

    def simulate(
        self,
        time: np.ndarray,
        u: np.ndarray,
        x0: np.ndarray,
        p: np.ndarray,
    ) -> np.ndarray:
        """States at the rows, shape (n, nx), from x0 under held inputs.

        Args:
            time: Stamps in s, increasing, shape (n,).
            u: Inputs, each held until the next row, shape (n, nu), N m.
            x0: State at the first row, shape (nx,).
            p: Parameter vector (assemble.parameter_vector), shape (np,).

        Raises:
            SimulationError: if the state runs away.
        """
        time, u, x0, p = self._checked(time, u, x0, p)
        return self._states(self._late_rows(time, u, p, 1.0), x0, p, 1.0)

    def outputs(
        self, time: np.ndarray, u: np.ndarray, states: np.ndarray, p: np.ndarray
    ) -> np.ndarray:
        """What the sensors report at the rows, shape (n, ny), delays included."""
        time, u, _, p = self._checked(time, u, np.zeros(self.nx), p)
        states = _shaped('states', states, (len(time), self.nx))
        return self._outputs(self._late_rows(time, u, p, 1.0), states, p)

    def read(self, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> np.ndarray:
        """What the sensors report in one state, before any delay, shape (ny,)."""
        self._one_row(x, u, p)
        y = np.empty(self.ny)
        self._c.cgm_outputs(1, self._instant, u[None], p, x[None], self._on_time, y[None])
        return y

    def readings(
        self,
        time: np.ndarray,
        u: np.ndarray,
        x0: np.ndarray,
        p: np.ndarray,
        refinement: float = 1.0,
    ) -> np.ndarray:
        """What the sensors report along a simulation, shape (n, ny): the `y` of `normal`."""
        time, u, x0, p = self._checked(time, u, x0, p)
        rows = self._late_rows(time, u, p, refinement)
        states = self._states(rows, x0, p, refinement)
        return self._outputs(rows, states, p)[rows.recorded]

    def _states(
        self, rows: '_Rows', x0: np.ndarray, p: np.ndarray, refinement: float
    ) -> np.ndarray:
        time, n = rows.time, len(rows.time)
        states = np.empty((n, self.nx))
        inputs = _array(rows.inputs)
        done = self._c.cgm_simulate(
            n, _array(np.diff(time)), *Accuracy.of(refinement), inputs, x0, p, states, 0, None
        )
        if done < n:
            raise SimulationError(
                f'the state runs away after {time[done - 1] - time[0]:.3f} s', time[done - 1]
            )
        return states

    def _outputs(self, rows: '_Rows', states: np.ndarray, p: np.ndarray) -> np.ndarray:
        time, n, delays = rows.time, len(rows.time), _array(self.delays(p)[1])
        y = np.empty((n, self.ny))
        self._c.cgm_outputs(n, time, _array(rows.inputs), p, states, delays, y)
        return y

    def advance(self, x: np.ndarray, u: np.ndarray, p: np.ndarray, step: float, n: int) -> None:
        """Integrate x in place over n Runge-Kutta steps of `step` s with inputs held."""
        self._one_row(x, u, p)
        self._c.cgm_advance(x, u, p, step, n)

    def _one_row(self, x: np.ndarray, u: np.ndarray, p: np.ndarray) -> None:
        # C reads as many numbers as the model has, whatever it is handed.
        if x.shape != (self.nx,) or u.shape != (self.nu,) or p.shape != (self.np,):
            raise ValueError(
                f'x, u, p have shapes {x.shape}, {u.shape}, {p.shape}; '
                f'expected ({self.nx},), ({self.nu},), ({self.np},)'
            )

    def judge(
        self,
        time: np.ndarray,
        u: np.ndarray,
        x0: np.ndarray,
        p: np.ndarray,
        measured: np.ndarray,
        weight: np.ndarray,
        refinement: float = 1.0,
    ) -> 'Judged':
        """A simulation beside a record.

        Args:
            time: Stamps of the rows in s, shape (n,).
            u: Held inputs, shape (n, nu).
            x0: Initial state, shape (nx,).
            p: Parameter vector, shape (np,).
            measured: Outputs, NaN where there is no sample, shape (n, ny).
            weight: 1 / standard deviation of each output, shape (ny,).
            refinement: Integration steps in place of one (`Accuracy.of`). If more than one,
                inputs that come late change at their instants, else a row has their mean.
        """
        time, u, x0, p = self._checked(time, u, x0, p)
        measured = _shaped('measured', measured, (len(time), self.ny))
        weight = _shaped('weight', weight, (self.ny,))
        return Judged(self, self._late_rows(time, u, p, refinement), x0, p, measured, weight,
                      Accuracy.of(refinement))  # fmt: skip

    def normal(
        self,
        time: np.ndarray,
        u: np.ndarray,
        x0: np.ndarray,
        s0: np.ndarray,
        p: np.ndarray,
        column: np.ndarray,
        measured: np.ndarray,
        weight: np.ndarray,
        keep: bool = False,
        refinement: float = 1.0,
    ) -> tuple[Normal, np.ndarray | None, np.ndarray | None]:
        """Normal equations of the simulation error of one record: `judge`, then Judged.normal."""
        judged = self.judge(time, u, x0, p, measured, weight, refinement)
        return judged.normal(s0, column, keep)

    def _checked(self, time, u, x0, p) -> tuple[np.ndarray, ...]:
        time = _array(time)
        return (
            time,
            _shaped('u', u, (len(time), self.nu)),
            _shaped('x0', x0, (self.nx,)),
            _shaped('p', p, (self.np,)),
        )


class Judged:
    """A simulation beside a record: its error at once, the derivatives when they are asked for.

    Attributes:
        sse: Weighted squared error of each output, shape (ny,).
        count: Samples of each output, shape (ny,).
        rows: Rows simulated before the state ran away.
    """

    def __init__(
        self,
        compiled: CompiledModel,
        rows: _Rows,
        x0: np.ndarray,
        p: np.ndarray,
        measured: np.ndarray,
        weight: np.ndarray,
        accuracy: Accuracy,
    ):
        self._compiled, self._rows, self._x0, self._p = compiled, rows, x0, p
        self._weight, self._accuracy = weight, accuracy
        self._samples = np.full((len(rows.time), compiled.ny), np.nan)
        self._samples[rows.recorded] = measured
        _, self._delays, self._delays_by = compiled.delays(p)
        self._simulated = compiled._c.cgm_follow(
            len(rows.time), rows.time, accuracy, _array(rows.inputs), x0, p,
            _array(self._delays),
        )  # fmt: skip
        done = len(self._simulated.outputs)
        residual = self._simulated.outputs - self._samples[:done]
        there = np.isfinite(residual)
        self.sse = ((weight * np.where(there, residual, 0.0)) ** 2).sum(axis=0)
        self.count = there.sum(axis=0).astype(float)
        self.rows = int(np.searchsorted(rows.recorded, done))

    def normal(
        self, s0: np.ndarray, column: np.ndarray, keep: bool = False
    ) -> tuple[Normal, np.ndarray | None, np.ndarray | None]:
        """Normal equations of the simulation error (Eq. 4.13).

        Args:
            s0: Derivative of the initial state by the columns, shape (nx, nc).
            column: Column of each free parameter, -1 where it is held constant, shape (nf,).
            keep: Return the simulated outputs and the Jacobian too.
        """
        compiled, rows = self._compiled, self._rows
        nc, m, ny = np.shape(s0)[1], len(rows.time), compiled.ny
        s0 = _shaped('s0', s0, (compiled.nx, nc))
        column = np.ascontiguousarray(column, dtype=np.int32)
        if column.shape != (len(compiled.free),) or column.max(initial=-1) >= nc:
            raise ValueError(f'column must place {len(compiled.free)} parameters below {nc}')
        first, *others = (_delay_column(row, column) for row in self._delays_by)
        normal = Normal(np.zeros((nc, nc)), np.zeros(nc), self.sse, self.count, self.rows)
        j = np.zeros((m, ny, nc)) if keep else None
        done = len(self._simulated.outputs)
        if done == m:
            compiled._c.cgm_normal(
                self._simulated, m, rows.time, self._accuracy, _array(rows.inputs),
                _array(rows.slope), first, self._x0, s0, self._p, nc, column, self._samples,
                self._weight, _array(self._delays), np.array(others, dtype=np.int32),
                normal.hessian, normal.gradient, j,
            )  # fmt: skip
        if j is None:
            return normal, None, None
        y = np.full((m, ny), np.nan)
        y[:done] = self._simulated.outputs
        return normal, y[rows.recorded], j[rows.recorded]


def compile_model(
    model: Model, setup: Setup, free: tuple[str, ...] | None = None
) -> CompiledModel:
    """The compiled form of a model's structure in a set-up; quick when it was built before.

    Args:
        model: Its structure counts, its values do not (but for effects at neutral).
        setup: Its structure counts: stance, fixture, number and bodies of springs; of a URDF where
            joints are locked, and gravity.
        free: Parameters with sensitivities; by default all that are declared free.
    """
    if free is None:
        acting = {effect.label for effect in acting_effects(model)}
        free = tuple(
            name
            for name, parameter in model.declarations.items()
            if parameter.free and ('.' not in name or name.rpartition('.')[0] in acting)
        )
    key = (
        model.mechanism.identity,
        tuple((e.name, e.at) for e in model.effects),
        tuple(e.label for e in acting_effects(model)),
        setup.stance,
        setup.fixture,
        tuple(spring.body for spring in setup.springs),
        setup.locked,
        setup.gravity,
        free,
    )
    if key not in _built:
        _built[key] = _build(model, setup, free)
    return _built[key]


_built: dict[tuple, CompiledModel] = {}


def simulate(
    model: Model, setup: Setup, time: np.ndarray, u: np.ndarray, motion: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """States (n, nx) and outputs (n, ny) of a model from its initial motion (2m,)."""
    compiled, p = compile_model(model, setup), parameter_vector(model, setup)
    x0 = compiled.initial_state(motion, u[0], p)
    states = compiled.simulate(time, u, x0, p)
    return states, compiled.outputs(time, u, states, p)


def _array(a) -> np.ndarray:
    return np.ascontiguousarray(a, dtype=float)


def _row_at(time: np.ndarray, t: np.ndarray) -> np.ndarray:
    """The row that holds at each instant; before the first row it is the first."""
    return np.clip(np.searchsorted(time, t, side='right') - 1, 0, len(time) - 1)


def _shaped(name: str, a, shape: tuple[int, ...]) -> np.ndarray:
    a = _array(a)
    if a.shape != shape:
        raise ValueError(f'{name} has shape {a.shape}, expected {shape}')
    return a


def _delay_column(row: np.ndarray, column: np.ndarray) -> int:
    # A delay is the sum of delays of effects; two of them on one path are not told apart here.
    active = [int(c) for value, c in zip(row, column, strict=True) if value != 0 and c >= 0]
    return active[0] if active else -1


def _build(model: Model, setup: Setup, free: tuple[str, ...]) -> CompiledModel:
    equations = assemble(model, setup)
    if compiler() is None:
        log.warning('no C compiler found: models run on the CasADi virtual machine, slower')
        return CompiledModel(equations, free, native=False)
    try:
        return CompiledModel(equations, free)
    except UnsupportedError as error:
        log.warning('the model runs on the CasADi virtual machine, slower: %s', error)
        return CompiledModel(equations, free, native=False)
