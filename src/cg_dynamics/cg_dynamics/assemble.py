"""From mechanism, effects and set-up to one set of equations: dx/dt = f(x, u, p), y = h(x, u, p).

x = (s, ds/dt, z): free coordinates, their rates, extra states of the effects. The parameter
vector p is the mechanism's parameters, then those of each effect, then those of the springs.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

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
    mechanism = model.mechanism
    names = parameter_names(model, setup)
    p = ca.SX.sym('p', len(names))
    by_name = dict(zip(names, ca.vertsplit(p), strict=True))
    effects = acting_effects(model)
    own = {
        effect.label: {q.name: by_name[f'{effect.label}.{q.name}'] for q in effect.parameters}
        for effect in effects
    }
    asked = dict.fromkeys(name for e in effects for name in e.extra_inputs)
    extra_inputs = tuple(name for name in asked if name not in mechanism.inputs)
    u = ca.SX.sym('u', len(mechanism.inputs) + len(extra_inputs))
    torque_inputs = ca.vertsplit(u)[: len(mechanism.inputs)]
    measured = dict(zip((*mechanism.inputs, *extra_inputs), ca.vertsplit(u), strict=True))
    for e in effects:
        own[e.label] |= {name: measured[name] for name in e.extra_inputs}
    kinematics = mechanism.kinematics(setup)
    m = len(kinematics.names)
    extra = [f'{effect.label}.{state}' for effect in effects for state in effect.states]
    x = ca.SX.sym('x', 2 * m + len(extra))
    s, ds = x[:m], x[m : 2 * m]
    z = dict(zip(extra, ca.vertsplit(x[2 * m :]), strict=True)) if extra else {}
    z_of = {e.label: [z[f'{e.label}.{state}'] for state in e.states] for e in effects}
    dz: dict[str, list[ca.SX]] = {}

    def pass_through(effect, result):
        value, rates = result
        if rates:
            dz[effect.label] = rates
        return value

    # Torque path: what the drive reports, if there is one -> motor -> transmission -> joint.
    torques, starts = [], {}
    driving = dict(zip(mechanism.joints, torque_inputs, strict=True))
    for joint, row in mechanism.all_joints.items():
        here = [e for e in effects if e.site == joint or e.site == 'all']
        joint_row = ca.mtimes(ca.DM([row]), kinematics.basis)
        angle, rate = ca.mtimes(joint_row, s), ca.mtimes(joint_row, ds)
        load, share = driving.get(joint, ca.SX(0)), ca.SX(0)
        for e in here:
            load = e.command(load, angle, rate, own[e.label])
        for hook in ('deliver', 'transmit', 'joint_torque'):
            added = 0
            for e in here:
                if not overrides(e, hook):
                    continue
                zs, ps = z_of[e.label], own[e.label]
                at_start = load
                if hook == 'transmit' and (rotor := e.rotor(zs, ps)) is not None:
                    a, w, on_rotor = rotor
                    opposing = on_rotor * (1 - share) * friction(here, a, w, load, own)
                    # A record begins with the rotor moving as the joint does.
                    at_start += ca.substitute(opposing, ca.vertcat(a, w), ca.vertcat(angle, rate))
                    load += opposing
                    share += on_rotor * (1 - share)
                if e.states:
                    starts[e.label] = e.initial_states(angle, rate, at_start, own[e.label])
                if hook == 'deliver':
                    load = pass_through(e, e.deliver(load, zs, ps))
                elif hook == 'transmit':
                    load = pass_through(e, e.transmit(load, angle, rate, zs, ps))
                else:
                    torque = pass_through(e, e.joint_torque(angle, rate, load, zs, ps))
                    added += torque * (1 - share) if divides(e) else torque
            load = load + added
        torques.append(load)

    # Bodies: energies, springs, forces.
    q, v = ca.SX.sym('q', kinematics.basis.shape[0]), ca.SX.sym('v', kinematics.basis.shape[0])
    up = mechanism.up(setup)
    for e in effects:
        up = e.up(up, own[e.label])
    body = Body(mechanism, setup, q, v, by_name, up, foot=ca.SX.zeros(mechanism.dimensions))
    displaced = [e.foot(body, own[e.label]) for e in effects if overrides(e, 'foot')]
    body = replace(body, foot=sum(displaced, body.foot))
    a = ca.SX.sym('a', *s.shape)
    recursion = mechanism.recursion(q, v, ca.mtimes(kinematics.basis, a), by_name, up)
    energies = mechanism.energies(q, v, by_name, setup, up, body.foot)
    # What recursion does not give is derived from the energies.
    kinetic, potential = energies if recursion is None else (ca.SX(0), ca.SX(0))
    for stretch, stiffness in body.springs():
        potential += stiffness * stretch**2 / 2
    force = ca.SX.zeros(q.shape)
    full = [
        ca.mtimes(kinematics.basis, s) + kinematics.offset, ca.mtimes(kinematics.basis, ds)
    ]  # fmt: skip
    for e in effects:
        more_kinetic, more_potential = e.energies(body, own[e.label])
        kinetic, potential = kinetic + more_kinetic, potential + more_potential
        if overrides(e, 'force'):
            force += pass_through(e, e.force(body, z_of[e.label], own[e.label]))
            if e.states:
                lean, rate = full[0][body.stance], full[1][body.stance]
                starts[e.label] = e.initial_states(lean, rate, ca.SX(0), own[e.label])
    for row, torque in zip(mechanism.all_joints.values(), torques, strict=True):
        force += ca.DM(row) * torque
    kinetic, potential, force = ca.substitute([kinetic, potential, force], [q, v], full)
    mass_matrix, bias = manipulator(kinetic, potential, s, ds)
    load = ca.mtimes(kinematics.basis.T, force) - bias
    imbalance = load - ca.mtimes(mass_matrix, a)
    energy = kinetic + potential
    if recursion is not None:
        own_mass, taken = recursion
        taken, own_mass, own_energy = ca.substitute(
            [ca.mtimes(kinematics.basis.T, taken),
             ca.mtimes([kinematics.basis.T, own_mass, kinematics.basis]), sum(energies)],
            [q, v], full,
        )  # fmt: skip
        load -= ca.substitute(taken, a, ca.SX.zeros(a.shape))
        imbalance -= taken
        mass_matrix += own_mass
        energy += own_energy
    acceleration = solve_small(mass_matrix, load)

    # Sensors.
    outputs = mechanism.sensors(*full)
    moving = {reading_rate(c): ca.jtimes(y, s, ds) for c, y in outputs.items()}
    for e in effects:
        if overrides(e, 'read'):
            if e.states:
                starts[e.label] = e.initial_readings(outputs, own[e.label])
            outputs = pass_through(e, e.read(outputs, z_of[e.label], own[e.label] | moving))

    input_delay = ca.SX(0)
    output_delays = {channel: ca.SX(0) for channel in outputs}
    for e in effects:
        delay = e.input_delay(own[e.label])
        input_delay += 0 if delay is None else delay
        for channel in outputs:
            late = e.output_delay(channel, own[e.label])
            output_delays[channel] += 0 if late is None else late
    rates = [ca.substitute(dz[e.label], [q, v], full) for e in effects if e.states]
    return Equations(
        x=x,
        u=u,
        p=p,
        rates=ca.vertcat(ds, acceleration, *(r for group in rates for r in group)),
        outputs=ca.vertcat(*outputs.values()),
        initial=ca.vertcat(s, ds, *_start(effects, starts, z_of, own)),
        input_delay=input_delay,
        output_delays=ca.vertcat(*output_delays.values()),
        mass_matrix=mass_matrix,
        load=load,
        acceleration=a,
        imbalance=imbalance,
        energy=energy,
        state_names=(
            *kinematics.names,
            *(f'd{name}/dt' for name in kinematics.names),
            *extra,
        ),
        parameter_names=names,
        input_names=(*mechanism.inputs, *extra_inputs),
        channels=tuple(outputs),
        coordinates=m,
        state_scales=(
            *(1.0 for _ in range(2 * m)),
            *(scale for e in effects for scale in e.state_scales or (1.0,) * len(e.states)),
        ),
        largest_step=min((e.largest_step for e in effects), default=float('inf')),
    )


def _start(
    effects: Sequence[Effect],
    starts: Mapping[str, list[ca.SX]],
    states: Mapping[str, list[ca.SX]],
    own: Mapping[str, Mapping[str, ca.SX]],
) -> list[ca.SX]:
    """Extra states at the start, in the order of the effects.

    Args:
        effects: Those that act.
        starts: Label -> settled states, in the order along the torque path and to the sensors: of
            symbols of the motion and of states before them.
        states: Label -> their symbols, which say here how far they are from settled.
        own: Label -> its parameters.
    """
    by_label = {e.label: e for e in effects}
    before: list[ca.SX] = []
    at_start: list[ca.SX] = []
    found = {}
    for label, settled in starts.items():
        # What comes before starts first: a spring is wound up by the lagging torque's start.
        if before:
            settled = ca.substitute(settled, before, at_start)
        spreads = by_label[label].start_spreads(own[label])
        found[label] = [
            start + spread * away
            for start, spread, away in zip(settled, spreads, states[label], strict=True)
        ]
        before += states[label]
        at_start += found[label]
    return [start for e in effects if e.states for start in found[e.label]]


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
