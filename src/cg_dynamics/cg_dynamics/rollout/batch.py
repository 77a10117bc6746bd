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

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import CompiledModel, compile_model
from cg_dynamics.rollout.compiler import compiler, shared_library
from cg_dynamics.rollout.vector_code import (
    FLAGS,
    WIDTH,
    UnsupportedError,
    vector_code,
    vector_math,
)

log = logging.getLogger(__name__)


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
