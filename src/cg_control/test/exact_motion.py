"""The exact hybrid model, integrated by scipy over phase or time, many states side by side."""

from dataclasses import replace

import numpy as np
from scipy.integrate import solve_ivp

from cg_control.orbits.surfaces import between
from cg_control.trajectories.trajectory import Phase
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model

TIGHT = {'method': 'DOP853', 'rtol': 1e-12, 'atol': 1e-13}


def rates(design, stance, x, u):
    """f for states (m, 4) and torques (m,), shape (m, 4)."""
    setup = Setup(stance=stance)
    f = compile_model(design, setup).f.map(len(x))
    p = np.tile(parameter_vector(design, setup)[:, None], len(x))
    return np.asarray(f(x.T, u[None], p)).T


def densified(trajectory, design, parts):
    """The same motion with so many times the intervals, integrated from knot to knot.

    What a trajectory means between knots, a cubic, errs by the fourth power of their distance.
    """
    phases = []
    for phase in trajectory.phases:
        time, states, torque = [], [], []
        for k in range(len(phase.time) - 1):
            h, u0, u1 = phase.time[k + 1] - phase.time[k], *phase.torque[k : k + 2]

            def f(t, x, h=h, u0=u0, u1=u1, stance=phase.stance):
                return rates(design, stance, x[None], np.array([u0 + t / h * (u1 - u0)]))[0]

            shares = np.arange(parts) / parts
            done = solve_ivp(f, (0.0, h), phase.states[k], t_eval=shares * h, **TIGHT)
            time += [*(phase.time[k] + shares * h)]
            states += [*done.y.T]
            torque += [*(u0 + shares * (u1 - u0))]
        time, states = np.array([*time, phase.end]), np.array([*states, phase.states[-1]])
        torque = np.array([*torque, phase.torque[-1]])
        f = rates(design, phase.stance, states, torque)
        phases.append(Phase(phase.stance, time, states, f, torque))
    return trajectory.with_phases(tuple(phases))


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
