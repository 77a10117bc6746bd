"""States that no sensor reads, simulated along a measured motion.

    dz/dt = g(z, q, dq/dt, tau, p),   f = h(z, q, dq/dt, tau, p) - tau                   (ALONG)

A rotor behind a gap moves by itself, but nothing moves it besides its motor and its joint. The
torque tau of the one and the motion q of the other are measured. So it is simulated alone: two
states in place of a robot, and nothing that runs away. f is what the effect adds to the torque on
its joint. Of each interval between two samples the mean of f counts, as teeth may meet for less
time than that.

Between samples the motion is a cubic through positions and rates, and the torque is held.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from cg_dynamics.assemble import acting_effects, overrides
from cg_dynamics.effects import Effect
from cg_dynamics.model import Model
from cg_dynamics.rollout.compiler import compiler, shared_library

HOOKS = 'deliver', 'transmit', 'joint_torque'  # in the order in which they act
LONGEST_STEP = 1e-3  # s
AT_ONCE = 250  # intervals that are simulated in one call


@dataclass(frozen=True)
class Samples:
    """A measured motion at all samples of a record, evenly spaced.

    Attributes:
        position: Free coordinates, shape (n, m).
        rate: Shape (n, m).
        inputs: Shape (n, nu), each held until the next sample.
        spacing: Between samples, s.
        weights: Of the samples of a window in the average of its middle.
        stride: Samples from one window to the next.
    """

    position: np.ndarray
    rate: np.ndarray
    inputs: np.ndarray
    spacing: float
    weights: np.ndarray
    stride: int


def follows(effect: Effect) -> bool:
    """Whether an effect has states that only its joint and its motor move."""
    joined = effect.place in ('command', 'transmission', 'joint')
    return bool(effect.states) and joined and not effect.extra_inputs


class AlongMotion:
    """One effect along the records of a set-up.

    Attributes:
        names: Of its parameters, full ones.
        direction: What one unit of its torque is on each free coordinate, shape (m,).

    Args:
        model: The model without it.
        effect: The effect.
        p: Symbols of the model's parameters.
        parameter_names: Their names.
        input_names: Of the inputs in the records.
        basis: Full coordinates by free ones, shape (n, m).
        records: What was measured.
    """

    def __init__(
        self, model: Model, effect: Effect, p: ca.SX, parameter_names: Sequence[str],
        input_names: Sequence[str], basis: np.ndarray, records: Sequence[Samples],
    ):  # fmt: skip
        body = model.mechanism
        self.names = tuple(f'{effect.label}.{q.name}' for q in effect.parameters)
        self.direction = np.asarray(body.all_joints[effect.site], float) @ basis
        self._records = records
        drives = dict(zip(body.joints, body.inputs, strict=True))
        drive = drives.get(effect.site)
        self._column = None if drive is None else list(input_names).index(drive)
        by_name = dict(zip(parameter_names, ca.vertsplit(p), strict=True))
        angle, rate, torque = (ca.SX.sym(n) for n in ('angle', 'rate', 'torque'))
        before = _before(model, effect, torque, angle, rate, by_name)
        self._motor = ca.Function('motor', [torque, angle, rate, p], [before])
        self._told = np.array(ca.which_depends(before, p, 1, False), bool)
        own = ca.SX.sym('own', len(self.names))
        start = ca.vertcat(*effect.initial_states(angle, rate, torque, _named(effect, own)))
        self._start = ca.Function(
            'start', [angle, rate, torque, own], [start, ca.jacobian(start, own)]
        )
        spacing = max((samples.spacing for samples in records), default=LONGEST_STEP)
        steps = int(np.ceil(spacing / min(effect.largest_step, LONGEST_STEP) - 1e-9))
        self._run = _compiled(_interval(effect, steps).mapaccum('along', AT_ONCE))
        self._last: tuple[bytes, tuple[np.ndarray, np.ndarray]] = b'', (np.empty(0), np.empty(0))

    def __call__(self, p: np.ndarray, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The mean torque f of each window, and its derivative by the effect's parameters.

        Args:
            p: Parameters of the model without it.
            own: Those of the effect.

        Returns:
            N m (N), shapes (k,) and (k, len(own)).
        """
        asked = np.concatenate([p[self._told], own]).tobytes()
        if asked == self._last[0]:  # a derivative where a step has been tried, or others moved
            return self._last[1]
        forces, slopes = [], []
        for samples in self._records:
            simulated = self.simulated(samples, p, own)
            averages = np.column_stack(
                [
                    np.correlate(column, samples.weights, 'valid')[:: samples.stride]
                    for column in simulated.T
                ]
            )
            forces.append(averages[:, 0])
            slopes.append(averages[:, 1:])
        self._last = asked, (np.concatenate(forces), np.vstack(slopes))
        return self._last[1]

    def simulated(self, samples: Samples, p: np.ndarray, own: np.ndarray) -> np.ndarray:
        """Mean f and its derivatives in the interval that each sample begins, (n, 1 + len(own)).

        No numbers where a state runs away.
        """
        angle, rate = samples.position @ self.direction, samples.rate @ self.direction
        held = np.zeros(len(angle)) if self._column is None else samples.inputs[:, self._column]
        torque = np.asarray(self._motor(held[None], angle[None], rate[None], p)).ravel()
        count = len(angle) - 1
        given = np.vstack([
            angle[:-1], rate[:-1], angle[1:], rate[1:], torque[:-1],
            np.full(count, samples.spacing),
        ])  # fmt: skip
        start, by_own = map(np.asarray, self._start(angle[0], rate[0], torque[0], own))
        state = np.concatenate([start.ravel(), by_own.ravel(order='F')])
        numbers = np.repeat(own[:, None], AT_ONCE, axis=1)
        found = []
        for first in range(0, count, AT_ONCE):
            piece = given[:, first : first + AT_ONCE]
            short = AT_ONCE - piece.shape[1]
            # The last piece goes on at rest, and what comes of that is left out.
            states, means = self._run(state, np.pad(piece, ((0, 0), (0, short)), 'edge'), numbers)
            state = np.asarray(states)[:, -1]
            found.append(np.asarray(means)[:, : AT_ONCE - short])
        every = np.hstack(found).T
        return np.vstack([every, every[-1:]])


def _named(effect: Effect, own: ca.SX) -> dict[str, ca.SX]:
    return dict(zip((q.name for q in effect.parameters), ca.vertsplit(own), strict=True))


def _before(
    model: Model, effect: Effect, torque: ca.SX, angle: ca.SX, rate: ca.SX, p: dict[str, ca.SX]
) -> ca.SX:
    """What the drive reports, as it comes to an effect: through those before it without states."""
    here = [e for e in acting_effects(model) if e.site == effect.site and not e.extra_inputs]
    own = {e.label: {q.name: p[f'{e.label}.{q.name}'] for q in e.parameters} for e in here}
    for e in here:
        torque = e.command(torque, angle, rate, own[e.label])
    for e in here if _hook(effect) != 'deliver' else ():
        if not e.states:
            torque, _ = e.deliver(torque, [], own[e.label])
    return torque


def _hook(effect: Effect) -> str:
    return next(hook for hook in HOOKS if overrides(effect, hook))


def _law(effect: Effect, z: ca.SX, angle: ca.SX, rate: ca.SX, torque: ca.SX, own: ca.SX) -> ca.SX:
    """Rates of its states, then what it adds to the torque, in one column."""
    states, p, hook = ca.vertsplit(z), _named(effect, own), _hook(effect)
    if hook == 'deliver':
        passed, rates = effect.deliver(torque, states, p)
    elif hook == 'transmit':
        passed, rates = effect.transmit(torque, angle, rate, states, p)
    else:
        added, rates = effect.joint_torque(angle, rate, torque, states, p)
        passed = torque + added
    return ca.vertcat(*rates, passed - torque)


def _interval(effect: Effect, steps: int) -> ca.Function:
    """From one sample to the next, by Runge and Kutta's fourth order: (ALONG) with sensitivities.

    (states and their derivatives by the parameters in one column; angle and rate at either end,
    torque, duration; parameters) -> the first at the next sample; mean of f and its derivatives.
    """
    nz, count = len(effect.states), len(effect.parameters)
    z, own = ca.SX.sym('z', nz), ca.SX.sym('own', count)
    by_own = ca.SX.sym('by_own', nz, count)
    given = ca.SX.sym('given', 6)
    q0, v0, q1, v1, torque, span = ca.vertsplit(given)
    step = span / steps

    def rates(at: float, state: ca.SX) -> ca.SX:
        """At a part of the interval; the last state is the integral of f."""
        angle = (
            (1 + 2 * at) * (1 - at) ** 2 * q0 + at * (1 - at) ** 2 * span * v0
            + at**2 * (3 - 2 * at) * q1 + at**2 * (at - 1) * span * v1
        )  # fmt: skip
        rate = (
            6 * at * (at - 1) * (q0 - q1) / span
            + (1 - at) * (1 - 3 * at) * v0 + at * (3 * at - 2) * v1
        )  # fmt: skip
        return _law(effect, state[:nz], angle, rate, torque, own)

    state = ca.vertcat(z, 0)
    for k in range(steps):
        at = [(k + part) / steps for part in (0.0, 0.5, 1.0)]
        k1 = rates(at[0], state)
        k2 = rates(at[1], state + step / 2 * k1)
        k3 = rates(at[1], state + step / 2 * k2)
        k4 = rates(at[2], state + step * k3)
        state += step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    after = ca.vertcat(state[:nz], state[nz] / span)
    slope = ca.jacobian(after, ca.vertcat(z, own))
    moved = ca.mtimes(slope[:, :nz], by_own) + slope[:, nz:]
    return ca.Function(
        'interval',
        [ca.vertcat(z, ca.vec(by_own)), given, own],
        [
            ca.densify(ca.vertcat(after[:nz], ca.vec(moved[:nz, :]))),
            ca.densify(ca.vertcat(after[nz], moved[nz, :].T)),
        ],
        {'cse': True},
    )


def _compiled(function: ca.Function) -> ca.Function:
    """The same in machine code, where there is a compiler."""
    if compiler() is None:
        return function
    generator = ca.CodeGenerator('along.c')
    generator.add(function)
    return ca.external(function.name(), str(shared_library(generator.dump())))
