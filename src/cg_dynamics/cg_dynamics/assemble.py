"""From mechanism, effects and set-up to one set of equations: dx/dt = f(x, u, p), y = h(x, u, p).

x = (s, ds/dt, z): free coordinates, their rates, extra states of the effects. The parameter
vector p is the mechanism's parameters, then those of each effect, then those of the springs.
"""

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import casadi as ca
import numpy as np

from cg_dynamics.effects import Body, Effect
from cg_dynamics.effects.effect import CLOCKS, SPRING_FIELDS, reading_rate
from cg_dynamics.lagrange import manipulator, solve_small
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup


@dataclass(frozen=True)
class Equations:
    """The assembled model in symbols.

    Attributes:
        x: State, shape (nx, 1).
        u: Inputs: torques as the drive reports them in N m, then extra ones, shape (nu, 1).
        p: Parameters, shape (np, 1).
        rates: dx/dt.
        outputs: What the sensors report, before any delay, shape (ny, 1).
        initial: x at the start, given (s, ds/dt) in the first entries of x and the held u. The
            others say how far extra states are from settled, in their `start_spreads`.
        input_delay: Delay of the inputs in s.
        output_delays: Delay of each output in s, shape (ny, 1).
        mass_matrix: Of the free coordinates.
        load: Generalised forces less bias, so that mass_matrix times acceleration is load: (m, 1).
        acceleration: Symbol of an acceleration of the free coordinates, (m, 1).
        torques: What drives and friction do on each free coordinate, a part of `load`: (m, 1).
        imbalance: Generalised forces less what that acceleration takes; 0 of the true one: (m, 1).
        energy: Kinetic plus potential energy of bodies and springs in J.
        state_names: Names of x.
        parameter_names: Full names of p.
        input_names: Names of u: torques, then inputs that effects ask for.
        channels: Output channels, the order of `outputs`.
        coordinates: Number m of free coordinates.
        state_scales: Errors of the entries of x that matter alike, shape (nx,).
        largest_step: Longest step in s with which integrators of fixed steps still do well.
    """

    x: ca.SX
    u: ca.SX
    p: ca.SX
    rates: ca.SX
    outputs: ca.SX
    initial: ca.SX
    input_delay: ca.SX
    output_delays: ca.SX
    mass_matrix: ca.SX
    load: ca.SX
    acceleration: ca.SX
    torques: ca.SX
    imbalance: ca.SX
    energy: ca.SX
    state_names: tuple[str, ...]
    parameter_names: tuple[str, ...]
    input_names: tuple[str, ...]
    channels: tuple[str, ...]
    coordinates: int
    state_scales: tuple[float, ...]
    largest_step: float

    def rates_by(self, *symbols: ca.SX) -> list[ca.SX]:
        """Jacobians of the rates.

        Of a mechanism of many joints by its implicit equations: with imbalance(a, x) = 0 and
        M = -d(imbalance)/da,

            da/dx = M^-1 d(imbalance)/dx,

        which is many times shorter than what differentiating the solution would write out.
        """
        m = self.coordinates
        if m <= 2:
            return [ca.jacobian(self.rates, by) for by in symbols]
        every = ca.vertcat(*symbols)
        by = ca.jacobian(self.imbalance, every)
        factors = ca.ldl(self.mass_matrix)
        moving = [c for c in range(by.shape[1]) if by[:, c].nnz()]
        solved = ca.SX(m, by.shape[1])
        if moving:
            solved[:, moving] = ca.ldl_solve(ca.densify(by[:, moving]), *factors)
        solved = ca.substitute(solved, self.acceleration, self.rates[m : 2 * m])
        jacobian = ca.vertcat(
            ca.jacobian(self.rates[:m], every),
            solved,
            ca.jacobian(self.rates[2 * m :], every),
        )
        edges = np.cumsum([0, *(by.shape[0] for by in symbols)])
        return [jacobian[:, a:b] for a, b in itertools.pairwise(map(int, edges))]


def acting_effects(model: Model) -> tuple[Effect, ...]:
    """The effects of a model that are not at their neutral value."""
    return tuple(effect for effect in model.effects if effect.acts(model.values_of(effect)))


def parameter_names(model: Model, setup: Setup) -> tuple[str, ...]:
    """Full names of the parameter vector of a model in a set-up."""
    springs = (f'spring{i}.{field}' for i in range(len(setup.springs)) for field in SPRING_FIELDS)
    return (*model.declarations, *springs)


def parameter_vector(model: Model, setup: Setup) -> np.ndarray:
    """Values of the parameter vector, SI units."""
    springs = [
        value
        for spring in setup.springs
        for value in (spring.point, *spring.anchor, spring.stiffness, spring.free_length)
    ]
    values = model.values
    return np.array([*(values[name] for name in model.declarations), *springs], dtype=float)


def assemble(model: Model, setup: Setup) -> Equations:
    """Build the equations of a model in a set-up; only acting effects take part."""
    made = _Assembly(model, setup)
    torques = made.torques()
    dynamics = made.dynamics(torques)
    acceleration = solve_small(dynamics.mass_matrix, dynamics.load)
    outputs = made.readings()
    input_delay, output_delays = made.delays(outputs)
    names, effects = made.kinematics.names, made.effects
    return Equations(
        x=made.x,
        u=made.u,
        p=made.p,
        rates=ca.vertcat(made.ds, acceleration, *made.state_rates()),
        outputs=ca.vertcat(*outputs.values()),
        initial=ca.vertcat(made.s, made.ds, *made.starts()),
        input_delay=input_delay,
        output_delays=ca.vertcat(*output_delays),
        mass_matrix=dynamics.mass_matrix,
        load=dynamics.load,
        acceleration=dynamics.acceleration,
        torques=ca.mtimes(made.joint_rows.T, ca.vertcat(*torques)),
        imbalance=dynamics.imbalance,
        energy=dynamics.energy,
        state_names=(*names, *(f'd{name}/dt' for name in names), *made.extra_states),
        parameter_names=made.parameter_names,
        input_names=made.input_names,
        channels=tuple(outputs),
        coordinates=len(names),
        state_scales=(
            *(1.0 for _ in range(2 * len(names))),
            *(scale for e in effects for scale in e.state_scales or (1.0,) * len(e.states)),
        ),
        largest_step=min((e.largest_step for e in effects), default=float('inf')),
    )


@dataclass(frozen=True)
class _Dynamics:
    """Of the bodies, in free coordinates; as the attributes of `Equations`."""

    mass_matrix: ca.SX
    load: ca.SX
    acceleration: ca.SX
    imbalance: ca.SX
    energy: ca.SX


class _Assembly:
    """Equations in the making: their symbols, and what effects have said of their states so far.

    Effects are asked in the order of the path: torques, bodies, readings; then `state_rates` and
    `starts` are complete.

    Attributes:
        own: Label of an effect -> name of a parameter or of an extra input -> its symbol.
        states: Label of an effect -> symbols of its states.
        rates: Label -> rates of these.
        settled: Label -> these at rest, in the order of the path.
    """

    def __init__(self, model: Model, setup: Setup):
        self.mechanism, self.setup = model.mechanism, setup
        self.effects = acting_effects(model)
        self.parameter_names = parameter_names(model, setup)
        self.p = ca.SX.sym('p', len(self.parameter_names))
        self.by_name = dict(zip(self.parameter_names, ca.vertsplit(self.p), strict=True))
        asked = dict.fromkeys(name for e in self.effects for name in e.extra_inputs)
        inputs = self.mechanism.inputs
        self.input_names = (*inputs, *(name for name in asked if name not in inputs))
        self.u = ca.SX.sym('u', len(self.input_names))
        self.input = dict(zip(self.input_names, ca.vertsplit(self.u), strict=True))
        self.own = {
            e.label: {q.name: self.by_name[f'{e.label}.{q.name}'] for q in e.parameters}
            | {name: self.input[name] for name in e.extra_inputs}
            for e in self.effects
        }
        self.kinematics = self.mechanism.kinematics(setup)
        m = len(self.kinematics.names)
        self.extra_states = [f'{e.label}.{state}' for e in self.effects for state in e.states]
        self.x = ca.SX.sym('x', 2 * m + len(self.extra_states))
        self.s, self.ds = self.x[:m], self.x[m : 2 * m]
        extra = ca.vertsplit(self.x[2 * m :]) if self.extra_states else []
        z = dict(zip(self.extra_states, extra, strict=True))
        self.states = {e.label: [z[f'{e.label}.{state}'] for state in e.states]
                       for e in self.effects}  # fmt: skip
        self.rates: dict[str, list[ca.SX]] = {}
        self.settled: dict[str, list[ca.SX]] = {}
        # All coordinates and their rates: symbols, and what they are in free ones.
        coordinates = self.kinematics.basis.shape[0]
        # Angle of each joint, by the free coordinates.
        joints = ca.DM([list(row) for row in self.mechanism.all_joints.values()])
        self.joint_rows = ca.mtimes(joints, self.kinematics.basis)
        self.q, self.v = ca.SX.sym('q', coordinates), ca.SX.sym('v', coordinates)
        self.full = [
            ca.mtimes(self.kinematics.basis, self.s) + self.kinematics.offset,
            ca.mtimes(self.kinematics.basis, self.ds),
        ]

    def _passed(self, effect: Effect, result: tuple[Any, list[ca.SX]]) -> Any:
        """What an effect makes of a value; the rates of its states are kept."""
        value, rates = result
        if rates:
            self.rates[effect.label] = rates
        return value

    def torques(self) -> list[ca.SX]:
        """Torque at each joint: what the drive reports, if there is one, motor, transmission."""
        driving = {j: self.input[i] for j, i in zip(
            self.mechanism.joints, self.mechanism.inputs, strict=True)}  # fmt: skip
        return [
            self._torque(joint, row, driving.get(joint, ca.SX(0)))
            for joint, row in self.mechanism.all_joints.items()
        ]

    def _torque(self, joint: str, row: Sequence[float], load: ca.SX) -> ca.SX:
        here, own = [e for e in self.effects if e.site == joint or e.site == 'all'], self.own
        joint_row = ca.mtimes(ca.DM([row]), self.kinematics.basis)
        angle, rate, share = ca.mtimes(joint_row, self.s), ca.mtimes(joint_row, self.ds), ca.SX(0)
        for e in here:
            load = e.command(load, angle, rate, own[e.label])
        for hook in ('deliver', 'transmit', 'joint_torque'):
            added = 0
            for e in here:
                if not overrides(e, hook):
                    continue
                zs, ps = self.states[e.label], own[e.label]
                at_start = load
                if hook == 'transmit' and (rotor := e.rotor(zs, ps)) is not None:
                    a, w, on_rotor = rotor
                    opposing = on_rotor * (1 - share) * friction(here, a, w, load, own)
                    # A record begins with the rotor moving as the joint does.
                    at_start += ca.substitute(opposing, ca.vertcat(a, w), ca.vertcat(angle, rate))
                    load += opposing
                    share += on_rotor * (1 - share)
                if e.states:
                    self.settled[e.label] = e.initial_states(angle, rate, at_start, ps)
                if hook == 'deliver':
                    load = self._passed(e, e.deliver(load, zs, ps))
                elif hook == 'transmit':
                    load = self._passed(e, e.transmit(load, angle, rate, zs, ps))
                else:
                    torque = self._passed(e, e.joint_torque(angle, rate, load, zs, ps))
                    added += torque * (1 - share) if divides(e) else torque
            load = load + added
        return load

    def dynamics(self, torques: Sequence[ca.SX]) -> _Dynamics:
        """What bodies, springs and forces make of the torques at the joints."""
        mechanism, basis, q, v = self.mechanism, self.kinematics.basis, self.q, self.v
        up = mechanism.up(self.setup)
        for e in self.effects:
            up = e.up(up, self.own[e.label])
        still = ca.SX.zeros(mechanism.dimensions)
        body = Body(mechanism, self.setup, q, v, self.by_name, up, foot=still)
        moved = [e.foot(body, self.own[e.label]) for e in self.effects if overrides(e, 'foot')]
        body = replace(body, foot=sum(moved, body.foot))
        a = ca.SX.sym('a', *self.s.shape)
        loads = {e.label: tied for e in self.effects if (tied := e.load(self.own[e.label]))}
        recursion = mechanism.recursion(
            q, v, ca.mtimes(basis, a), self.by_name, up, tuple(loads.values())
        )
        kinetic, potential = mechanism.energies(q, v, self.by_name, self.setup, up, body.foot)
        # What recursion does not give is derived from the energies.
        given = ca.SX(0)
        if recursion is not None:
            given, kinetic, potential = kinetic + potential, ca.SX(0), ca.SX(0)
        for stretch, stiffness in body.springs():
            potential += stiffness * stretch**2 / 2
        for e in self.effects:
            more_kinetic, more_potential = e.energies(body, self.own[e.label])
            if recursion is not None and e.label in loads:
                given += more_kinetic + more_potential
            else:
                kinetic, potential = kinetic + more_kinetic, potential + more_potential
        force = self._force(body, torques)
        kinetic, potential, force = self._in_free([kinetic, potential, force])
        mass_matrix, bias = manipulator(kinetic, potential, self.s, self.ds)
        load = ca.mtimes(basis.T, force) - bias
        imbalance = load - ca.mtimes(mass_matrix, a)
        energy = kinetic + potential
        if recursion is not None:
            own_mass, taken = recursion
            taken, own_mass, own_energy = self._in_free(
                [
                    ca.mtimes(basis.T, taken),
                    ca.mtimes([basis.T, own_mass, basis]),
                    given,
                ]
            )
            load -= ca.substitute(taken, a, ca.SX.zeros(a.shape))
            imbalance -= taken
            mass_matrix += own_mass
            energy += own_energy
        return _Dynamics(mass_matrix, load, a, imbalance, energy)

    def _force(self, body: Body, torques: Sequence[ca.SX]) -> ca.SX:
        """Generalised force of effects on bodies and of the torques at the joints."""
        force = ca.SX.zeros(self.q.shape)
        for e in self.effects:
            if not overrides(e, 'force'):
                continue
            force += self._passed(e, e.force(body, self.states[e.label], self.own[e.label]))
            if e.states:
                lean, rate = (value[body.stance] for value in self.full)
                self.settled[e.label] = e.initial_states(lean, rate, ca.SX(0), self.own[e.label])
        for row, torque in zip(self.mechanism.all_joints.values(), torques, strict=True):
            force += ca.DM(row) * torque
        return force

    def readings(self) -> dict[str, ca.SX]:
        """What the sensors report, before any delay, by channel."""
        outputs = self.mechanism.sensors(*self.full)
        moving = {reading_rate(c): ca.jtimes(y, self.s, self.ds) for c, y in outputs.items()}
        for e in self.effects:
            if not overrides(e, 'read'):
                continue
            zs, ps = self.states[e.label], self.own[e.label]
            if e.states:
                self.settled[e.label] = e.initial_readings(outputs, ps)
            outputs = self._passed(e, e.read(outputs, zs, ps | moving))
        return outputs

    def delays(self, channels: Iterable[str]) -> tuple[ca.SX, list[ca.SX]]:
        """Delay of the inputs and of each output, s."""
        late_input, late = ca.SX(0), dict.fromkeys(channels, ca.SX(0))
        for e in self.effects:
            delay = e.input_delay(self.own[e.label])
            late_input += 0 if delay is None else delay
            for channel in late:
                delay = e.output_delay(channel, self.own[e.label])
                late[channel] = late[channel] + (0 if delay is None else delay)
        return late_input, list(late.values())

    def state_rates(self) -> list[ca.SX]:
        """Rates of the extra states, in the order of the effects."""
        rates = [self._in_free(self.rates[e.label]) for e in self.effects if e.states]
        return [r for group in rates for r in group]

    def starts(self) -> list[ca.SX]:
        """Extra states at the start, in the order of the effects.

        Their symbols say here how far they are from settled.
        """
        by_label = {e.label: e for e in self.effects}
        before: list[ca.SX] = []
        at_start: list[ca.SX] = []
        found = {}
        for label, settled in self.settled.items():
            # What comes before starts first: a spring is wound up by the lagging torque's start.
            if before:
                settled = ca.substitute(settled, before, at_start)
            spreads = by_label[label].start_spreads(self.own[label])
            found[label] = [
                start + spread * away
                for start, spread, away in zip(settled, spreads, self.states[label], strict=True)
            ]
            before += self.states[label]
            at_start += found[label]
        return [start for e in self.effects if e.states for start in found[e.label]]

    def _in_free(self, expressions: list[ca.SX]) -> list[ca.SX]:
        """Expressions of all coordinates in free ones."""
        return ca.substitute(expressions, [self.q, self.v], self.full)


def divides(effect: Effect) -> bool:
    """Whether a rotor takes its share of an effect: of friction; bristles stay at the joint."""
    return bool(effect.friction) and not effect.states and overrides(effect, 'joint_torque')


def friction(
    effects: Sequence[Effect],
    angle: ca.SX,
    rate: ca.SX,
    load: ca.SX,
    own: Mapping[str, Mapping[str, ca.SX]],
) -> ca.SX:
    """Torque in N m of the friction without states, at an angle in rad and a rate in rad/s."""
    shared = [e for e in effects if divides(e)]
    return sum((e.joint_torque(angle, rate, load, [], own[e.label])[0] for e in shared), ca.SX(0))


def overrides(effect: Effect, hook: str) -> bool:
    """True if an effect does something at that place."""
    return getattr(type(effect), hook) is not getattr(Effect, hook)


def stamped(u: np.ndarray, input_names: Sequence[str], time: float) -> np.ndarray:
    """The inputs u, shape (nu,), with the clocks set where a model has one.

    A session begins with the machine that runs.
    """
    if not set(CLOCKS).intersection(input_names):
        return u
    return np.array([time if n in CLOCKS else v for n, v in zip(input_names, u, strict=True)])
