"""The exact hybrid model, integrated by scipy over phase or time, many states side by side."""

from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp

from cg_control.surfaces import between
from cg_control.transverse import design_of
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.compiled import compile_model
from cg_dynamics.impact import impact
from cg_dynamics.rig import Setup

TIGHT = {'method': 'DOP853', 'rtol': 1e-12, 'atol': 1e-13}


def rates(design, stance, x, u):
    """f for states (m, 4) and torques (m,), shape (m, 4)."""
    setup = Setup(stance=stance)
    f = compile_model(design, setup).f.map(len(x))
    p = np.tile(parameter_vector(design, setup)[:, None], len(x))
    return np.asarray(f(x.T, u[None], p)).T


def by_clock(design, phase, x, stretched=1.0):
    """States at the knots, (n, m, 4), under the nominal torque over time, from x (m, 4)."""
    knots = [x]
    for k in range(len(phase.time) - 1):
        h = (phase.time[k + 1] - phase.time[k]) * stretched

        def f(t, y, k=k, h=h):
            u = phase.torque[k] + t / h * (phase.torque[k + 1] - phase.torque[k])
            y = y.reshape(-1, 4)
            return rates(design, phase.stance, y, np.full(len(y), u)).ravel()

        done = solve_ivp(f, (0.0, h), knots[-1].ravel(), **TIGHT)
        knots.append(done.y[:, -1].reshape(-1, 4))
    return np.array(knots)


def refined(trajectory, model, parts=1):
    """The periodic motion that the exact model makes near a planned one, with finer knots.

    Newton's method on the state at the start and the lengths of the phases.
    """
    design = design_of(trajectory, model)
    slope = trajectory.provenance['slope']
    phases = [_finer(phase, parts) for phase in trajectory.phases]
    unknown = np.append(trajectory.states[0], np.ones(len(phases)))

    def missed(unknown):
        x, rows, knots = unknown[:4], [], []
        for phase, stretched in zip(phases, unknown[4:], strict=True):
            knots.append(by_clock(design, phase, x[None], stretched)[:, 0])
            end = knots[-1][-1]
            rows.append(end[0] + end[1] - 2 * slope)
            x = impact(design, phase.stance, end).x_plus
        return np.append(x - unknown[:4], rows), knots

    for _ in range(6):
        residual, knots = missed(unknown)
        if np.abs(residual).max() < 1e-12:
            break
        jacobian = np.column_stack([
            (missed(unknown + 1e-6 * d)[0] - missed(unknown - 1e-6 * d)[0]) / 2e-6
            for d in np.eye(len(unknown))
        ])  # fmt: skip
        unknown = unknown - np.linalg.solve(jacobian, residual)
    assert np.abs(residual).max() < 1e-11
    start, exact = 0.0, []
    for phase, stretched, states in zip(phases, unknown[4:], knots, strict=True):
        time = start + (phase.time - phase.time[0]) * stretched
        f = rates(design, phase.stance, states, phase.torque)
        exact.append(replace(phase, time=time, states=states, rates=f))
        start = time[-1]
    return trajectory.with_phases(tuple(exact))


def _finer(phase, parts):
    index = np.arange((len(phase.time) - 1) * parts + 1) / parts
    old = np.arange(len(phase.time))
    time = np.interp(index, old, phase.time)
    at = [phase.at(t) for t in time]
    states = np.array([point.state for point in at])
    return replace(
        phase, time=time, states=states, rates=np.zeros_like(states),
        torque=np.array([point.torque for point in at]), gains=[], cost_to_go=[], normals=[],
    )  # fmt: skip


def over_phase(design, phase, x, first=0, last=None):
    """States (m, 4) on the surface of a later knot, from states on that of an earlier one.

    The torque is u0(s) - K(s) (x - x0(s)), s the phase by projection: dx/ds = f / (ds/dt).
    """
    for k in range(first, len(phase.time) - 1 if last is None else last):
        h = phase.time[k + 1] - phase.time[k]
        part = replace(
            phase, **{
                name: getattr(phase, name)[k : k + 2]
                for name in ('time', 'states', 'rates', 'torque', 'gains', 'cost_to_go', 'normals')
            },
        )  # fmt: skip

        def f(s, y, part=part, h=h):
            point, share = between(part, s / h), s / h
            deviation = y.reshape(-1, 4) - point.states
            gain = (1 - share) * part.gains[0] + share * part.gains[1]
            u = point.torque - deviation @ gain
            velocity = rates(design, part.stance, y.reshape(-1, 4), u)
            crossing = point.normals[0] @ point.rates[0] - deviation @ point.turning[0]
            return (velocity * (crossing / (velocity @ point.normals[0]))[:, None]).ravel()

        x = solve_ivp(f, (0.0, h), x.ravel(), **TIGHT).y[:, -1].reshape(-1, 4)
    return x
