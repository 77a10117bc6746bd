"""Thousands of rollouts at once: other starts, parameters or torques of one model.

The right-hand side is written out as C on vectors of eight doubles, so that eight rollouts run
side by side in the lanes of one register; what depends on parameters alone is computed once. The
results are those of `CompiledModel.simulate` to rounding. Without a C compiler the rollouts run
one after the other.
"""

import ctypes
import functools
import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np

from cg_dynamics.c_compiler import compiler, shared_library
from cg_dynamics.compiled import CompiledModel, compile_model
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup

log = logging.getLogger(__name__)

WIDTH = 8
# No -fassociative-math: vector_math.c rounds by adding and subtracting a large number.
FLAGS = (
    '-O2', '-march=native', '-fno-math-errno', '-fno-trapping-math', '-fno-signed-zeros',
    '-freciprocal-math', '-ffp-contract=fast',
)  # fmt: skip

BINARY = {
    ca.OP_ADD: '{0} + {1}',
    ca.OP_SUB: '{0} - {1}',
    ca.OP_MUL: '{0} * {1}',
    ca.OP_DIV: '{0} / {1}',
    ca.OP_POW: 'v_pow({0}, {1})',
    ca.OP_CONSTPOW: 'v_pow({0}, {1})',
    ca.OP_ATAN2: 'v_atan2({0}, {1})',
    ca.OP_HYPOT: 'v_hypot({0}, {1})',
    ca.OP_FMIN: 'v_fmin({0}, {1})',
    ca.OP_FMAX: 'v_fmax({0}, {1})',
    ca.OP_LT: 'v_truth({0} < {1})',
    ca.OP_LE: 'v_truth({0} <= {1})',
    ca.OP_EQ: 'v_truth({0} == {1})',
    ca.OP_NE: 'v_truth({0} != {1})',
    ca.OP_AND: 'v_truth(({0} != 0.0) & ({1} != 0.0))',
    ca.OP_OR: 'v_truth(({0} != 0.0) | ({1} != 0.0))',
    ca.OP_COPYSIGN: 'v_copysign({0}, {1})',
    ca.OP_IF_ELSE_ZERO: 'v_select({0} != 0.0, {1}, SPLAT(0.0))',
}
UNARY = {
    ca.OP_NEG: '-{0}',
    ca.OP_SQ: '{0} * {0}',
    ca.OP_TWICE: '{0} + {0}',
    ca.OP_INV: '1.0 / {0}',
    ca.OP_NOT: 'v_truth({0} == 0.0)',
    ca.OP_ASSIGN: '{0}',
    **{
        getattr(ca, f'OP_{name.upper()}'): f'v_{name}({{0}})'
        for name in (
            'sqrt', 'exp', 'log', 'tan', 'tanh', 'sinh', 'cosh', 'asin', 'acos', 'atan', 'fabs',
            'floor', 'ceil', 'sign',
        )
    },
}  # fmt: skip


class UnsupportedError(DynamicsError):
    """An expression with an operation that has no vector form."""


@dataclass(frozen=True)
class Feedback:
    """A time-varying linear feedback on top of the torques, as TVLQR gives it.

    Row k holds u_k - K_k (x - reference_k), limited to +-limit.

    Attributes:
        gains: K, shape (n, nu, nx).
        reference: Nominal states, shape (n, nx).
        limit: Largest torque in N m, shape (nu,).
    """

    gains: np.ndarray
    reference: np.ndarray
    limit: np.ndarray


def simulate_batch(
    model: Model,
    setup: Setup,
    time: np.ndarray,
    u: np.ndarray,
    x0: np.ndarray,
    p: np.ndarray,
    trajectories: bool = False,
    feedback: Feedback | None = None,
    threads: int = 1,
    largest_step: float | None = None,
) -> np.ndarray:
    """States of many rollouts: at the last row (B, nx), or at all rows (B, n, nx).

    Rollouts that run away have NaN from where they do; no error is raised for them.

    Args:
        model: Its structure counts; its values are in p.
        setup: The set-up.
        time: Stamps of the rows in s, shape (n,), shared by all.
        u: Held inputs in N m, shape (n, nu) for all or (B, n, nu).
        x0: States at the first row, shape (B, nx).
        p: Parameter vectors, shape (np,) for all or (B, np).
        trajectories: Return all rows.
        feedback: Closes the loop, with the true state.
        threads: Share the rollouts among so many threads.
        largest_step: Of the integration, s; None takes the model's. Longer ones are for rough
            answers.
    """
    compiled = compile_model(model, setup)
    time = np.ascontiguousarray(time, float)
    x0, p, u = (np.ascontiguousarray(a, float) for a in (x0, p, u))
    batch, n = len(x0), len(time)
    u_each, p_each = u.ndim == 3, p.ndim == 2
    _expect('x0', x0, (batch, compiled.nx))
    _expect('p', p, (batch, compiled.np) if p_each else (compiled.np,))
    _expect('u', u, (batch, n, compiled.nu) if u_each else (n, compiled.nu))
    if feedback is not None:
        _expect('gains', feedback.gains, (n, compiled.nu, compiled.nx))
        _expect('reference', feedback.reference, (n, compiled.nx))
        _expect('limit', feedback.limit, (compiled.nu,))
    if compiled.has_delays:
        u, u_each = _delayed(compiled, time, u, p, batch, feedback is not None)
    library = batch_library(compiled)
    if library is None:
        return _one_by_one(compiled, time, u, x0, p, trajectories, feedback)
    shape = (batch, n, compiled.nx) if trajectories else (batch, compiled.nx)
    states = np.empty(shape)
    # C sees addresses only: every array must be held by a name until it returns.
    rows, longest = np.diff(time), largest_step or compiled.largest_step
    pointers: list[np.ndarray | None] = [None] * 3
    if feedback is not None:
        pointers = [
            np.ascontiguousarray(a, float)
            for a in (feedback.gains, feedback.reference, feedback.limit)
        ]

    def run(first: int, last: int) -> None:
        library.cgb_simulate(
            first, last, n, _pointer(rows), longest, _pointer(u), u_each,
            _pointer(x0), _pointer(p), p_each, *map(_pointer, pointers), trajectories,
            _pointer(states),
        )  # fmt: skip

    if threads <= 1 or batch < 2 * WIDTH:
        run(0, batch)
    else:
        # Whole blocks each; ctypes lets go of the interpreter while C runs.
        edges = np.linspace(0, -(-batch // WIDTH), threads + 1).astype(int) * WIDTH
        edges[-1] = batch
        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(run, edges[:-1], edges[1:]))
    states[~(np.abs(states) < 1e6)] = np.nan
    return states


@functools.cache
def batch_library(compiled: CompiledModel) -> ctypes.CDLL | None:
    """The vector code of a model, built when first needed; None where that cannot be."""
    if compiler() is None:
        return None
    try:
        source = batch_source(compiled)
    except UnsupportedError as error:
        log.warning('rollouts run one by one: %s', error)
        return None
    library = ctypes.CDLL(str(shared_library(source, FLAGS)))
    number, count, index, array = (
        ctypes.c_double, ctypes.c_int, ctypes.c_long, ctypes.c_void_p,
    )  # fmt: skip
    library.cgb_simulate.argtypes = [
        index, index, count, array, number, array, count, array, array, count, array, array,
        array, count, array,
    ]  # fmt: skip
    library.cgb_simulate.restype = None
    library.cgb_elementary.argtypes = [index, *[array] * 5]
    library.cgb_elementary.restype = None
    return library


def batch_source(compiled: CompiledModel, width: int = WIDTH) -> str:
    """C source of the vector rollouts of a model."""
    e = compiled.equations
    f = ca.Function('f', [e.x, e.u, e.p], [ca.densify(ca.cse(e.rates))])
    rates, shared = vector_code(f, 'rates', 'prepare')
    here = Path(__file__).parent
    sizes = {
        'WIDTH': width, 'NX': compiled.nx, 'NU': compiled.nu, 'NP': max(compiled.np, 1),
        'SHARED': shared,
    }  # fmt: skip
    return '\n'.join([
        *(f'#define {name} {value}' for name, value in sizes.items()),
        vector_math(),
        rates,
        (here / 'batch.c').read_text(),
    ])  # fmt: skip


def vector_math() -> str:
    """C source of the elementary functions that vector code calls; WIDTH is defined before it."""
    return (Path(__file__).parent / 'vector_math.c').read_text()


def vector_code(f: ca.Function, name: str, prepare: str) -> tuple[str, int]:
    """A function (x, u, p) -> y as two C functions on vectors.

    Args:
        f: The function; its result is dense.
        name: Of name(x, u, s, dx), which fills dx with y.
        prepare: Of prepare(p, s), which fills s with what depends on the parameters alone.

    Returns:
        The source, and how many values s holds.

    Raises:
        UnsupportedError: for an operation that has no vector form.
    """
    before, statements, shared = _vector_form(f)
    return '\n'.join([
        f'static void {prepare}(const vd *p, vd *s)\n{{',
        *before,
        f'}}\nstatic inline __attribute__((always_inline)) void {name}(const vd *x, const vd *u,'
        ' const vd *s, vd *dx)\n{',
        *statements,
        '}',
    ]), shared  # fmt: skip


def _vector_form(f: ca.Function) -> tuple[list[str], list[str], int]:
    """Statements of `prepare` and of `rates`, and the number of values that they share."""
    prepare: list[str] = []
    rates: list[str] = []
    value: dict[int, str] = {}  # work place of the function -> name of the value it holds now
    still: dict[str, bool] = {}  # name -> depends on no state and no input
    shared: dict[str, int] = {}
    angles: dict[str, str] = {}  # name of an angle -> suffix of its sine and cosine

    def seen_from(name: str, calm: bool) -> str:
        """The value under the name that it has in `prepare` (calm) or in `rates`."""
        if calm or not still[name] or name.startswith('SPLAT'):
            return name
        if name not in shared:
            shared[name] = len(shared)
            prepare.append(f'    s[{shared[name]}] = {name};')
        return f's[{shared[name]}]'

    for k in range(f.n_instructions()):
        op = f.instruction_id(k)
        inputs, outputs = f.instruction_input(k), f.instruction_output(k)
        if op == ca.OP_CONST:
            name = f'SPLAT({f.instruction_constant(k)!r})'
            value[outputs[0]], still[name] = name, True
            continue
        if op == ca.OP_INPUT:
            which, index = inputs
            name = f'{"xup"[which]}[{index}]'
            value[outputs[0]], still[name] = name, which == 2
            continue
        if op == ca.OP_OUTPUT:
            name = value[inputs[0]]
            rates.append(f'    dx[{outputs[1]}] = {seen_from(name, False)};')
            continue
        names = [value[place] for place in inputs]
        calm = all(still[name] for name in names)
        body = prepare if calm else rates
        operands = [seen_from(name, calm) for name in names]
        if op in (ca.OP_SIN, ca.OP_COS):
            if names[0] not in angles:
                angles[names[0]] = str(k)
                body.append(f'    vd s{k}, c{k}; v_sincos({operands[0]}, &s{k}, &c{k});')
            name = f'{"s" if op == ca.OP_SIN else "c"}{angles[names[0]]}'
        else:
            form = BINARY.get(op) or UNARY.get(op)
            if form is None:
                raise UnsupportedError(f'no vector form of the operation {op} of {f.name()!r}')
            name = f'a{k}'
            body.append(f'    const vd {name} = {form.format(*operands)};')
        value[outputs[0]], still[name] = name, calm
    return prepare, rates, len(shared)


def _expect(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if np.shape(array) != shape:
        raise ValueError(f'{name} has shape {np.shape(array)}, expected {shape}')


def _pointer(array: np.ndarray | None):
    return None if array is None else array.ctypes.data


def _delayed(compiled, time, u, p, batch: int, closed: bool) -> tuple[np.ndarray, bool]:
    """Inputs as they act, each rollout's by its own delay."""
    delays = [compiled.delays(row)[0] for row in np.atleast_2d(p)]
    if closed and any(delays):
        raise ValueError('feedback through an actuator delay needs the scalar simulation')
    if u.ndim == 2 and len(set(delays)) == 1:
        return np.ascontiguousarray(compiled.delayed_inputs(time, u, delays[0])[0]), False
    rows = u if u.ndim == 3 else [u] * batch
    delays = delays if len(delays) == batch else delays * batch
    late = [compiled.delayed_inputs(time, a, d)[0] for a, d in zip(rows, delays, strict=True)]
    return np.array(late), True


def _one_by_one(compiled, time, u, x0, p, trajectories, feedback) -> np.ndarray:
    """The same without vector code."""
    batch, n = len(x0), len(time)
    states = np.full((batch, n, compiled.nx), np.nan)
    rows = np.diff(time)
    steps = np.maximum(1, np.ceil(rows / compiled.largest_step * (1 - 1e-9)).astype(int))
    for b in range(batch):
        parameters = p[b] if p.ndim == 2 else p
        torque = u[b] if u.ndim == 3 else u
        x = states[b, 0] = x0[b]
        for k in range(n - 1):
            held = torque[k]
            if feedback is not None:
                held = held - feedback.gains[k] @ (x - feedback.reference[k])
                held = np.clip(held, -feedback.limit, feedback.limit)
            x = x.copy()
            compiled.advance(
                x, np.ascontiguousarray(held), parameters, rows[k] / steps[k], steps[k]
            )
            if not (np.abs(x) < 1e6).all():
                break
            states[b, k + 1] = x
    return states if trajectories else states[:, -1].copy()


__all__ = [
    'FLAGS', 'WIDTH', 'Feedback', 'UnsupportedError', 'batch_library', 'batch_source',
    'simulate_batch', 'vector_code', 'vector_math',
]  # fmt: skip
