"""Rollouts of one model in machine code: rollout.c for its states, windows.c for sensitivities.

A rollout is simulated once, step by step. Its sensitivities obey linear equations along it, so
that windows of it are integrated side by side, eight in the lanes of one register, by the very
steps that the rollout took, and chained:

    S(t) = Phi_w(t) S(t_w) + Gamma_w(t)      for t in window w, which begins at t_w

with Phi_w, Gamma_w the derivatives by the window's first state and by the parameters.
"""

import ctypes
import functools
from pathlib import Path

import casadi as ca
import numpy as np

from cg_dynamics.assemble import Equations
from cg_dynamics.rollout.accuracy import HALVINGS, Accuracy
from cg_dynamics.rollout.compiler import object_file, shared_library
from cg_dynamics.rollout.fallback import (
    EASY,
    STABLE,
    STATE_LIMIT,
    InterpretedRollout,
    Simulated,
)
from cg_dynamics.rollout.lanes import Lanes, window_edges
from cg_dynamics.rollout.vector_code import (
    FLAGS,
    WIDTH,
    UnsupportedError,
    vector_code,
    vector_math,
)

ALONE = 2  # lanes of a vector that holds one rollout: the least there are


class NativeRollout:
    """The functions of rollout.c for one set of equations; arguments are those of fallback.py.

    Args:
        equations: The model.
        free: Names of the parameters with sensitivities.
    """

    def __init__(self, equations: Equations, free: tuple[str, ...]):
        self.equations, self.free = equations, free
        self.nx, self.ny = equations.x.shape[0], equations.outputs.shape[0]
        loaded = _bind(_states_library(equations))
        self.cgm_advance, self.cgm_simulate = loaded.cgm_advance, loaded.cgm_simulate
        self.cgm_outputs = loaded.cgm_outputs

    @functools.cached_property
    def _windows(self):
        """The function of windows.c, compiled when sensitivities are first asked for."""
        return _bind_windows(_windows_library(self.equations, self.free))

    @functools.cached_property
    def _interpreted(self) -> InterpretedRollout:
        return InterpretedRollout(self.equations, self.free)

    def cgm_follow(self, n, time, accuracy: Accuracy, u, x0, p, delay) -> Simulated:
        """The states and outputs of a record, up to where the state runs away.

        Args:
            n: Rows.
            time: Their stamps in s, shape (n,).
            accuracy: Of the integration.
            u: Inputs, each held until the next row, shape (n, nu).
            x0: State at the first row, shape (nx,).
            p: Parameter vector.
            delay: Of each output in s, shape (ny,).
        """
        states = np.empty((n, self.nx))
        rows = np.diff(time)
        most = max(1, int(np.ceil(rows.max(initial=0.0) / accuracy.longest)))
        steps = np.zeros((n, most), np.int32)
        done = self.cgm_simulate(n, rows, *accuracy, u, x0, p, states, most, steps)
        y = np.empty((done, self.ny))
        self.cgm_outputs(done, time, u, p, states, delay, y)
        return Simulated(y, states, steps)

    def cgm_normal(
        self, simulated, n, time, accuracy: Accuracy, u, du, delay_column, x0, S0, p, nc, column,
        measured, weight, delay, delay_to, H, g, Jacobian,
    ) -> None:  # fmt: skip
        """Normal equations of the simulation error (Eq. 4.13) of a record that was followed.

            H (nc, nc) += sum_kj w_j^2 J'J,  g (nc) += sum_kj w_j^2 J'r,  r = y_sim - y_measured

        Args:
            simulated: What `cgm_follow` said of the same arguments.
            n: Rows.
            time: Their stamps in s, shape (n,).
            accuracy: Of the integration.
            u: Inputs, each held until the next row, shape (n, nu).
            du: Their derivative by their delay, shape (n, nu).
            delay_column: Column of that delay, or -1.
            x0: State at the first row, shape (nx,).
            S0: Its derivative by the columns, shape (nx, nc).
            p: Parameter vector.
            nc: Number of columns.
            column: Column of each free parameter, -1 where it is held constant, shape (nf,).
            measured: Outputs, NaN where there is no sample, shape (n, ny).
            weight: Of each output, shape (ny,).
            delay: Of each output in s, shape (ny,).
            delay_to: Column of each output's delay or -1, shape (ny,).
            H: To be added to, as g.
            g: Shape (nc,).
            Jacobian: Filled with the derivatives of the outputs, shape (n, ny, nc), if not None.
        """
        residual = simulated.outputs - measured
        there = np.isfinite(residual)
        residual = np.where(there, residual, 0.0)
        steps = simulated.steps
        try:
            kernel = self._windows
        except UnsupportedError:
            self._interpreted.cgm_normal(
                simulated, n, time, accuracy, u, du, delay_column, x0, S0, p, nc, column,
                measured, weight, delay, delay_to, H, g, Jacobian,
            )  # fmt: skip
            return
        active = np.flatnonzero(column >= 0)
        late = float(delay.max(initial=0.0))
        taken = np.bitwise_count(steps[:-1].view(np.uint32)).sum(axis=1)
        # Windows of a late sensor begin early, and more of them would do more rows twice.
        edges = window_edges(taken if late == 0.0 else np.ones(n - 1))
        lanes = Lanes.of(time, edges, late, self.nx, len(active), delay_column)
        place = np.full(len(column), -1, np.int32)
        place[active] = self.nx + np.arange(len(active))
        own_delay = {column[f]: place[f] for f in active}
        late_outputs = np.array([own_delay.get(c, -1) for c in delay_to], np.int32)
        k, weights = lanes.columns, there * weight
        hessian, gradient = np.zeros((lanes.padded, k, k)), np.zeros((lanes.padded, k))
        handed = np.zeros((lanes.padded, self.nx, k))
        by_lane = None if Jacobian is None else np.zeros((n, self.ny, k))
        for a in range(0, lanes.padded, WIDTH):
            at = slice(a, a + WIDTH)
            if not kernel(
                lanes.first[at], lanes.length[at], lanes.start[at], lanes.until[at],
                lanes.handed[at], time, accuracy.longest, u, du, p, k, place, lanes.late,
                simulated.states, steps.shape[1], steps, residual, weights, delay,
                late_outputs, hessian[at], gradient[at], handed[at], by_lane,
            ):  # fmt: skip
                raise MemoryError(f'no memory for the sensitivities of {n} rows of late sensors')
        # d(a window's columns)/d(columns): those of its first state, and the same for all windows.
        S, shared = np.empty((lanes.count, self.nx, nc)), np.zeros((k - self.nx, nc))
        shared[np.arange(len(active)), column[active]] = 1.0
        if lanes.late >= 0:
            shared[-1, delay_column] = 1.0
        S[0] = S0
        own, rest = slice(self.nx), slice(self.nx, None)
        hessian, gradient = hessian[: lanes.count], gradient[: lanes.count]
        # Sensitivities of a motion that runs away do so too; whoever fits sees it by these sums.
        with np.errstate(over='ignore', invalid='ignore'):
            for w in range(1, lanes.count):
                passed = handed[w - 1]
                S[w] = passed[:, own] @ S[w - 1] + passed[:, rest] @ shared
            by_state = hessian[:, own, own] @ S + hessian[:, own, rest] @ shared
            by_shared = (hessian[:, rest, own] @ S).sum(axis=0)
            by_shared += hessian[:, rest, rest].sum(axis=0) @ shared
            H += (S.transpose(0, 2, 1) @ by_state).sum(axis=0) + shared.T @ by_shared
            g += np.einsum('wsc,ws->c', S, gradient[:, own])
            g += gradient[:, rest].sum(axis=0) @ shared
        if Jacobian is not None and by_lane is not None:
            for w in range(lanes.count):
                first = lanes.first[w]
                judged = slice(first + lanes.start[w], first + lanes.until[w])
                Jacobian[judged] = by_lane[judged][:, :, own] @ S[w]
                Jacobian[judged] += by_lane[judged][:, :, rest] @ shared


def symbols_of(e: Equations, free: tuple[str, ...]) -> ca.SX:
    """Symbols of some of a model's parameters, shape (len(free), 1)."""
    where = [e.parameter_names.index(name) for name in free]
    return ca.vertcat(*(e.p[i] for i in where)) if where else ca.SX(0, 1)


def states_source(e: Equations) -> str:
    """C of what rollout.c asks of a model.

    Raises:
        UnsupportedError: for an operation that has no vector form.
    """
    rates, shared_f = _vectorised(e, 'rates_of', 'prepare_rates', ca.densify(e.rates))
    outputs, shared_h = _vectorised(e, 'outputs_of', 'prepare_outputs', ca.densify(e.outputs))
    scales = ', '.join(map(str, e.state_scales))
    return _with_sizes({'WIDTH': ALONE}, '\n'.join([
        vector_math(), _file('rollout.h'), rates, outputs,
        f'const int parameter_count = {max(e.p.shape[0], 1)}, shared = {shared_f + shared_h};',
        f'const double state_scale[] = {{{scales}}};',
        _prepare(shared_f),
        'void rates(const vd *x, const vd *u, const vd *s, vd *dx) { rates_of(x, u, s, dx); }',
        'void outputs(const vd *x, const vd *u, const vd *s, vd *y)',
        f'{{ outputs_of(x, u, s + {shared_f}, y); }}',
    ]))  # fmt: skip


def _prepare(shared: int) -> str:
    """C of `prepare`: what rates need of the parameters, then what outputs do."""
    return (
        'void prepare(const vd *p, vd *s)\n'
        f'{{ prepare_rates(p, s); prepare_outputs(p, s + {shared}); }}'
    )


def windows_source(e: Equations, free: tuple[str, ...]) -> str:
    """C of what windows.c asks of a model.

    Raises:
        UnsupportedError: for an operation that has no vector form.
    """
    symbols = symbols_of(e, free)
    A, B, P = e.rates_by(e.x, e.u, symbols)
    C, D = (ca.jacobian(e.outputs, by) for by in (e.x, symbols))
    rates, shared_f = _vectorised(e, 'rates_by', 'prepare_rates', ca.densify(e.rates), A, B, P)
    outputs, shared_h = _vectorised(e, 'outputs_by', 'prepare_outputs', C, D)
    nx = e.x.shape[0]
    given = {
        'WIDTH': WIDTH, 'NX': nx, 'NU': e.u.shape[0], 'NP': max(e.p.shape[0], 1),
        'NF': len(free), 'NY': e.outputs.shape[0], 'SHARED': shared_f + shared_h,
        'LOCAL': nx + A.nnz() + B.nnz() + P.nnz(),
    }  # fmt: skip
    in_a, in_b = _places(A, nx), _places(B, nx + A.nnz())
    in_p = _places(P, nx + A.nnz() + B.nnz())
    in_c, in_d = _places(C, 0), _places(D, C.nnz())
    decay = [f'o[{k}]' for i, j, k in in_a if i == j]
    lines = [
        vector_math(), _file('windows.h'), rates, outputs,
        '#define COLUMNS (NX + NF + 1)',
        f'static {_prepare(shared_f)}',
        _entries('BY_INPUT', in_b), _entries('BY_FREE', in_p),
        'static inline void times(const vd *o, const vd *a, vd *b)',
        '{',
        *_product('b[{}]', nx, in_a, 'o[{}] * a[{}]'),
        '}',
        'static vd decay(const vd *o)',
        f'{{ return -({" + ".join(decay) or "SPLAT(0.0)"}); }}',
        'static void output_sensitive(const vd *x, const vd *S, const vd *u, const vd *s, int nc,'
        ' const int *place, vd *C, vd *J)',
        '{',
        f'    vd o[{C.nnz() + D.nnz() + 1}];',
        f'    outputs_by(x, u, s + {shared_f}, o);',
        '    for (int i = 0; i < NY * NX; i++) C[i] = SPLAT(0.0);',
        *(f'    C[{j} * NX + {i}] = o[{k}];' for j, i, k in in_c),
        '    for (int c = 0; c < nc; c++) {',
        *_product('J[{} * COLUMNS + c]', e.outputs.shape[0], in_c, 'o[{}] * S[{} * COLUMNS + c]'),
        '    }',
        *(f'    if (place[{f}] >= 0) J[{j} * COLUMNS + place[{f}]] += o[{k}];'
          for j, f, k in in_d),
        '}',
        _file('columns.c'),
        'const WindowModel window_model = {NX, NU, NP, NF, NY, SHARED, LOCAL, BY_INPUT, BY_FREE,'
        ' prepare, rates_by, decay, slopes, step, output_sensitive};',
    ]  # fmt: skip
    return _with_sizes(given, '\n'.join(lines))


def _vectorised(e: Equations, name: str, prepare: str, *results: ca.SX) -> tuple[str, int]:
    """C of what is not zero of some results, one after the other; and the size of `prepare`'s."""
    stacked = ca.vertcat(*(ca.vec(r.nz[:]) for r in results if r.nnz()))
    f = ca.Function(name, [e.x, e.u, e.p], [ca.densify(ca.cse(stacked))])
    # Inlined wherever they are called, these compile several times as long and run no faster.
    return vector_code(f, name, prepare, inline=False)


def _places(matrix: ca.SX, first: int) -> list[tuple[int, int, int]]:
    """(row, column, place in a vector of values from `first` on) of what is not zero."""
    rows, columns = matrix.sparsity().get_triplet()
    return [(i, j, first + k) for k, (i, j) in enumerate(zip(rows, columns, strict=True))]


def _entries(name: str, places: list[tuple[int, int, int]]) -> str:
    """C table of {row, column, place}, the columns in order, and an end beyond all columns."""
    rows = ', '.join(f'{{{i}, {j}, {k}}}' for i, j, k in [*places, (0, 1 << 30, 0)])
    return f'static const int {name}[][3] = {{{rows}}};'


def _product(target: str, rows: int, places: list[tuple[int, int, int]], term: str) -> list[str]:
    """C lines of a sparse matrix times S."""
    return [
        f'        {target.format(i)} = '
        f'{" + ".join(term.format(k, j) for a, j, k in places if a == i) or "SPLAT(0.0)"};'
        for i in range(rows)
    ]


def _file(name: str) -> str:
    return (Path(__file__).parent / name).read_text()


def _with_sizes(given: dict, source: str) -> str:
    defines = '\n'.join(f'#define {name} {value}' for name, value in given.items())
    return f'{defines}\n{source}'


def _states_library(e: Equations) -> Path:
    given = {
        'WIDTH': ALONE, 'NX': e.x.shape[0], 'NU': e.u.shape[0], 'NY': e.outputs.shape[0],
        'STATE_LIMIT': STATE_LIMIT, 'HALVINGS': HALVINGS, 'EASY': EASY,
    }  # fmt: skip
    rollout = _common_object(given, 'rollout')
    return shared_library(states_source(e), FLAGS, [rollout])


def _windows_library(e: Equations, free: tuple[str, ...]) -> Path:
    windows = _common_object({'WIDTH': WIDTH, 'HALVINGS': HALVINGS, 'STABLE': STABLE}, 'windows')
    return shared_library(windows_source(e, free), FLAGS, [windows])


def _common_object(given: dict, name: str) -> Path:
    """What models share: a C file below vector_math.c and its header."""
    lines = [vector_math(), _file(f'{name}.h'), _file(f'{name}.c')]
    return object_file(_with_sizes(given, '\n'.join(lines)), FLAGS)


_NUMBER, _COUNT = ctypes.c_double, ctypes.c_int
_ARRAY = np.ctypeslib.ndpointer(float, flags='C')
_WHOLE = np.ctypeslib.ndpointer(np.int32, flags='C')


def _optional(array):
    class Optional(array):  # type: ignore[misc, valid-type]
        @classmethod
        def from_param(cls, value):
            return None if value is None else super().from_param(value)

    return Optional


def _bind(library: Path) -> ctypes.CDLL:
    loaded = ctypes.CDLL(str(library))
    loaded.cgm_advance.argtypes = [_ARRAY, _ARRAY, _ARRAY, _NUMBER, _COUNT]
    loaded.cgm_advance.restype = None
    loaded.cgm_simulate.argtypes = [
        _COUNT, _ARRAY, _NUMBER, _NUMBER, _COUNT, _ARRAY, _ARRAY, _ARRAY, _ARRAY, _COUNT,
        _optional(_WHOLE),
    ]  # fmt: skip
    loaded.cgm_outputs.argtypes = [_COUNT, _ARRAY, _ARRAY, _ARRAY, _ARRAY, _ARRAY, _ARRAY]
    loaded.cgm_outputs.restype = None
    return loaded


def _bind_windows(library: Path):
    loaded = ctypes.CDLL(str(library))
    loaded.cgw_normal.argtypes = [
        *[_WHOLE] * 5, _ARRAY, _NUMBER, *[_ARRAY] * 3, _COUNT, _WHOLE, _COUNT, _ARRAY, _COUNT,
        _WHOLE,
        *[_ARRAY] * 3, _WHOLE, *[_ARRAY] * 3, _optional(_ARRAY),
    ]  # fmt: skip
    return loaded.cgw_normal
