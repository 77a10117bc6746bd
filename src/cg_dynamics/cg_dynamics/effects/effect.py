"""What an effect is: one physical phenomenon, and the places where it can enter a model.

An effect overrides the hooks of the places where it acts and leaves the others alone; each hook
receives what flows through that place and returns what leaves it. The order along the torque
path is the order of the hooks below, so any effects compose:

    input --input_delay--> command --> deliver --> transmit --> joint_torque --> M dv/dt + b = Q
    Q and M also take energies, load, force, foot and up;   outputs: read, then output_delay
    where a foot lands: landing

In every hook `p` maps the effect's own parameter names to symbols and `z` holds its own extra
states, a list; a hook that owns states returns their rates in the same order. Inputs that an
effect asks for by name in `extra_inputs` come in `p` too: the reported torques, the clocks, and
recorded switches, which count as on where no one recorded them. In `read`, `p` also has the rates
of the angles that ideal sensors would report.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import casadi as ca

from cg_dynamics.errors import ModelError
from cg_dynamics.mechanisms.mechanism import Mechanism, PointMass
from cg_dynamics.parameter import Parameter
from cg_dynamics.rig import Setup

Symbols = Mapping[str, ca.SX]
# N m (N where a joint slides); what a joint of a robot that walks transmits beyond its held torque
# as a record begins: that which speeds up its rotor, and that which was applied a moment before.
START_TORQUE = 5.0
QUARTERS = (0.0, math.pi / 2, math.pi, -math.pi / 2)  # rad, from one of which a wave is found
SPRING_FIELDS = ('point', 'anchor_x', 'anchor_z', 'stiffness', 'free_length')
# Extra inputs that are clocks, in s: since the start of the recording, and since that of the first
# recording of its session.
TIME, SESSION_TIME = CLOCKS = 'time', 'session_time'


def reading_rate(channel: str) -> str:
    """Name under which a `read` hook finds the rate in rad/s of the angle of a channel."""
    return f'd({channel})/dt'


@dataclass(frozen=True)
class Body:
    """The mechanism as an effect sees it: symbols and geometry in one set-up.

    Attributes:
        mechanism: The mechanism.
        setup: The set-up.
        q: Full coordinates, shape (n, 1).
        v: Their rates.
        p: The mechanism's parameters by name.
        up: Unit vector (x, z) against gravity.
        foot: Where effects move the foot that stands, (x, z) in m; an ideal one is at (0, 0).
    """

    mechanism: Mechanism
    setup: Setup
    q: ca.SX
    v: ca.SX
    p: Symbols
    up: ca.SX
    foot: ca.SX

    def point(self, name: str, distance) -> tuple[ca.SX, ca.SX]:
        """World position in m and velocity in m/s of a point of a body, shapes (2, 1)."""
        ideal = self.mechanism.point(name, distance, self.q, self.p, self.setup)
        position = self.foot + ideal
        return position, ca.jtimes(position, self.q, self.v)

    @property
    def stance(self) -> int:
        """Which coordinate is the lean of the leg that stands."""
        return self.mechanism.bodies.index(self.setup.stance)

    def hip(self) -> tuple[ca.SX, ca.SX]:
        """Position in m and velocity in m/s of the hip of a compass gait."""
        return self.point(self.setup.stance, self.p['leg_length'])

    def springs(self) -> list[tuple[ca.SX, ca.SX]]:
        """Stretch in m beyond the free length and stiffness in N/m of the set-up's springs."""
        found = []
        for i, spring in enumerate(self.setup.springs):
            p = {field: self.p[f'spring{i}.{field}'] for field in SPRING_FIELDS}
            end, _ = self.point(spring.body, p['point'])
            length = ca.sqrt(ca.sumsqr(end - ca.vertcat(p['anchor_x'], p['anchor_z'])))
            found.append((length - p['free_length'], p['stiffness']))
        return found


@dataclass(frozen=True)
class ContactLaw:
    """What the ground does to a foot that lands or stands: theory.md, "Contact".

    Attributes:
        restitution: Rebound speed over speed of approach, along the ground's normal.
        friction: Coefficient of Coulomb's cone; infinite: the foot never slides.
    """

    restitution: float = 0.0
    friction: float = math.inf

    @property
    def plastic(self) -> bool:
        """True if a landing foot simply stays."""
        return self.restitution == 0 and math.isinf(self.friction)


class Effect:
    """Base of all effects. Immutable; parameters live in the model, not in the effect.

    Attributes:
        name: Standard name, the same in files, reports and docs.
        place: Where it acts: command, transmission, joint, body, environment, impact, sensor,
            timing.
        summary: One sentence for people, with the equation in plain text.
        parameters: Declared parameters.
        states: Names of extra states.
        state_scales: Error of each extra state that matters as much as one of a rad, or a rad/s,
            of a joint: steps are controlled by it (rollout.c); by default 1 each.
        largest_step: Longest step in s with which integrators of fixed steps still do well.
        extra_inputs: Inputs by name that the effect needs; they come with its parameters in `p`.
        wave: Names of an amplitude and a phase, where the opposite amplitude half a turn away is
            the same wave: fits report a positive amplitude and a phase within (-pi, pi].
        contains: Names of simpler effects that this one turns into at a limit of its parameters;
            where the simpler one explains the data as well, it is the one that is meant.
        friction: How it opposes motion: 'dry' where the level does not fade with the rate, so that
            the slope at standstill is only that of its smoothing; 'viscous' where it does; empty
            where it does not.
        family: (what, variable) of the learned terms (unmodelled.py) that have this law among
            their functions; empty where it is more than a function of one variable.
        ripple: True where its slope changes sign within small motions, so that the slope at one
            state tells nothing of those around it.
        steps: True where it answers in steps, so that what acts before it has next to no slope.
        drawings: Shapes in which texts and machines draw its law, each by parameters of shape.
        at: Joint, body or sensor where this instance acts; None where there is only one.
        start_torque: START_TORQUE at a joint of this size, N m (N where it slides).
    """

    name: ClassVar[str]
    place: ClassVar[str]
    summary: ClassVar[str]
    parameters: ClassVar[tuple[Parameter, ...]]
    states: ClassVar[tuple[str, ...]] = ()
    state_scales: ClassVar[tuple[float, ...]] = ()
    largest_step: ClassVar[float] = float('inf')
    extra_inputs: ClassVar[tuple[str, ...]] = ()
    wave: ClassVar[tuple[str, str] | None] = None
    contains: ClassVar[tuple[str, ...]] = ()
    friction: ClassVar[str] = ''
    family: ClassVar[tuple[str, ...]] = ()
    ripple: ClassVar[bool] = False
    steps: ClassVar[bool] = False
    drawings: ClassVar[tuple[Mapping[str, float], ...]] = ()

    def __init__(self, mechanism: Mechanism, at: str | None = None):
        sites = self.sites(mechanism)
        if not sites:
            raise ModelError(f'effect {self.name!r} does not apply to a {mechanism.name}')
        if at is not None and at not in sites:
            raise ModelError(
                f'effect {self.name!r} acts at {", ".join(sites)} of a {mechanism.name}, '
                f'not at {at!r}'
            )
        self.site = sites[0] if at is None else at
        # Of a robot that somebody drew no place is the usual one.
        usual = sites[0] if mechanism.dimensions == 2 or len(sites) == 1 else None
        self.at = None if self.site == usual else self.site
        self.parameters = self.parameters_in(mechanism)  # type: ignore[misc]
        self.start_torque = START_TORQUE
        # What a drive does to its command follows the torques that it is told.
        if self.site in mechanism.all_joints and (self.states or self.place != 'command'):
            size = mechanism.inertia_at(self.site)
            # Torques tell where an effect without states may set out, and nothing of one with
            # states: there the joint's size does. Heavy joints rub and push more.
            self.parameters = tuple(  # type: ignore[misc]
                p.of_size(size) if self.states else p.reaching(size) for p in self.parameters
            )
            if self.states:
                # Of bodies of one shape and density inertia grows as l^5, torque of gravity as
                # l^4; mass and weight both as l^3.
                self.start_torque *= size if self.slides(mechanism) else size**0.8
        if self.slides(mechanism):
            self.parameters = tuple(p.sliding() for p in self.parameters)  # type: ignore[misc]

    def parameters_in(self, mechanism: Mechanism) -> tuple[Parameter, ...]:
        """Its parameters at its site: in space, or far from the base, there may be others."""
        return self.parameters

    @property
    def sizes(self) -> tuple[Parameter, ...]:
        """Parameters that say how much of it there is: it is none where all of these are."""
        return self.parameters[:1]

    @property
    def label(self) -> str:
        """Name within a model: the standard name, and the place where it is not the usual one."""
        return self.name if self.at is None else f'{self.name}@{self.at}'

    @classmethod
    def sites(cls, mechanism: Mechanism) -> tuple[str, ...]:
        """Where this effect can act in a mechanism, the usual place first; empty if nowhere."""
        if cls.place == 'joint':
            return tuple(mechanism.all_joints)
        if cls.place in ('command', 'transmission'):
            return tuple(mechanism.joints)
        return ('all',)

    @classmethod
    def applies(cls, setups: Sequence[Setup]) -> bool:
        """False if no experiment in any of these set-ups could show the effect."""
        return True

    @property
    def elastic(self) -> bool:
        """Whether a rotor turns apart from the joint, whose angle and rate are its states."""
        return self.place == 'transmission' and bool(self.states) and not self.extra_inputs

    def slides(self, mechanism: Mechanism) -> bool:
        """Whether it acts along a line, so that its law is one of lengths and forces."""
        return self.site in mechanism.all_joints and mechanism.slides(self.site)

    def without_states(self, values: Mapping[str, float]) -> Mapping[str, Mapping[str, float]]:
        """What is left of an effect with states where those may not count.

        Args:
            values: Of its own parameters.

        Returns:
            Effects at the same site, standard name -> parameters; empty if nothing is left.
        """
        return {}

    def rotor(self, z: list[ca.SX], p: Symbols) -> tuple[ca.SX, ca.SX, ca.SX] | None:
        """Where friction acts before the transmission: a rotor's angle, rate and share of it.

        The share is that of all friction without states at the same joint; the rest of it acts on
        the joint. None where nothing turns apart from the joint.
        """
        return None

    def torque_limit(self, values: Mapping[str, float]) -> float:
        """Largest torque in N m that it lets through, given its own parameters."""
        return math.inf

    def implausible(self, values: Mapping[str, float], torque: float) -> str:
        """Why values cannot be of what the effect is named after, in words; '' if they can.

        Args:
            values: Of its own parameters.
            torque: Largest that was commanded, in N m.
        """
        return ''

    @classmethod
    def repeating(cls, period: float, size: float) -> list[dict[str, float]]:
        """Values from which its law may repeat like a function that data drew; empty if it cannot.

        Args:
            period: In the unit of the variable of `family`.
            size: Half of its range, in the unit of its values.
        """
        count = next((p for p in cls.parameters if p.name == 'cycles'), None)
        cycles = 2 * math.pi / period
        if cls.wave is None or count is None or not count.lower <= cycles <= count.upper:
            return []
        amplitude, phase = cls.wave
        return [{'cycles': cycles, amplitude: size, phase: turn} for turn in QUARTERS]

    def starts_beside(self, torque: float) -> list[dict[str, float]]:
        """Values from which a fit sets out where its law is one of the torque; empty: as declared.

        Args:
            torque: Largest that was commanded, in N m.
        """
        return []

    def acts(self, values: Mapping[str, float]) -> bool:
        """False if the first parameter has its neutral value, so that nothing happens at all."""
        first = self.parameters[0]
        return values[first.name] != first.neutral

    # --- hooks, in the order in which they act ------------------------------------------------

    def input_delay(self, p: Symbols) -> ca.SX | None:
        """Time in s by which the inputs act late."""
        return None

    def command(self, torque: ca.SX, angle: ca.SX, rate: ca.SX, p: Symbols) -> ca.SX:
        """Torque that a drive asks of its motor, from what it is told and reads of its joint."""
        return torque

    def deliver(self, torque: ca.SX, z: list[ca.SX], p: Symbols) -> tuple[ca.SX, list[ca.SX]]:
        """Torque of the motor in N m, from the torque that the drive reports."""
        return torque, []

    def transmit(
        self, torque: ca.SX, angle: ca.SX, rate: ca.SX, z: list[ca.SX], p: Symbols
    ) -> tuple[ca.SX, list[ca.SX]]:
        """Torque that reaches the joint, given the joint's angle in rad and rate in rad/s."""
        return torque, []

    def joint_torque(
        self, angle: ca.SX, rate: ca.SX, load: ca.SX, z: list[ca.SX], p: Symbols
    ) -> tuple[ca.SX, list[ca.SX]]:
        """Torque in N m that adds to the joint's; `load` is the torque transmitted so far."""
        return ca.SX(0), []

    def up(self, up: ca.SX, p: Symbols) -> ca.SX:
        """Direction against gravity, (x, z)."""
        return up

    def foot(self, body: Body, p: Symbols) -> ca.SX:
        """Where the foot that stands is moved, (x, z) in m: shape (2, 1), of coordinates only."""
        return ca.SX.zeros(2)

    def energies(self, body: Body, p: Symbols) -> tuple[ca.SX, ca.SX]:
        """Kinetic and potential energy in J that the effect adds."""
        return ca.SX(0), ca.SX(0)

    def load(self, p: Symbols) -> PointMass | None:
        """The point mass behind these energies, where it is one in the frame of a body in space.

        Recursion carries it with the body, at next to no cost.
        """
        return None

    def force(self, body: Body, z: list[ca.SX], p: Symbols) -> tuple[ca.SX, list[ca.SX]]:
        """Generalised force in N m that the effect adds, shape (n, 1)."""
        return ca.SX.zeros(body.q.shape), []

    def read(
        self, outputs: dict[str, ca.SX], z: list[ca.SX], p: Symbols
    ) -> tuple[dict[str, ca.SX], list[ca.SX]]:
        """What the sensors report, from what they should."""
        return outputs, []

    def output_delay(self, channel: str, p: Symbols) -> ca.SX | None:
        """Time in s by which a channel reports late."""
        return None

    def landing(self, law: ContactLaw, p: Mapping[str, float]) -> ContactLaw:
        """How the ground receives a foot; unlike the other hooks it is handed numbers."""
        return law

    def initial_states(self, angle: ca.SX, rate: ca.SX, torque: ca.SX, p: Symbols) -> list[ca.SX]:
        """Extra states at the start of a record, from joint angle, rate and held torque.

        Those of a `force` hook get lean and rate of the leg that stands, and no torque.
        """
        return [ca.SX(0) for _ in self.states]

    def start_spreads(self, p: Symbols) -> list[ca.SX]:
        """How far each extra state may lie from its start, one standard deviation.

        A record may begin in motion, and what no sensor reads need not have settled by then.
        """
        return [ca.SX(0) for _ in self.states]

    def initial_readings(self, outputs: dict[str, ca.SX], p: Symbols) -> list[ca.SX]:
        """The same for the states of a `read` hook, from what the sensors should report."""
        return [ca.SX(0) for _ in self.states]


class SensorEffect(Effect):
    """An effect of one sensor channel."""

    place = 'sensor'
    kind: ClassVar[str]

    @classmethod
    def sites(cls, mechanism: Mechanism) -> tuple[str, ...]:
        """The channels of the right kind."""
        return tuple(c for c, kind in mechanism.sensor_kinds.items() if kind == cls.kind)

    def slides(self, mechanism: Mechanism) -> bool:
        """Where the sensor reads a length."""
        return mechanism.output_unit(self.site) in ('m', 'm/s')


class ImuEffect(Effect):
    """An effect of both channels of an IMU.

    Attributes:
        channels: Its channels of lean angle and rate.
    """

    place = 'sensor'

    @classmethod
    def sites(cls, mechanism: Mechanism) -> tuple[str, ...]:
        """Only where there is one."""
        return ('all',) if {'inclinometer', 'gyro'} <= set(mechanism.sensor_kinds.values()) else ()

    def __init__(self, mechanism: Mechanism, at: str | None = None):
        super().__init__(mechanism, at)
        channel_of = {kind: channel for channel, kind in mechanism.sensor_kinds.items()}
        self.channels = (channel_of['inclinometer'], channel_of['gyro'])


class BodyEffect(Effect):
    """An effect tied to one body."""

    place = 'body'

    @classmethod
    def sites(cls, mechanism: Mechanism) -> tuple[str, ...]:
        """The bodies of the mechanism."""
        return mechanism.bodies


class StanceEffect(Effect):
    """An effect of the foot that stands, or of a hip that moves over it."""

    place = 'environment'

    @classmethod
    def sites(cls, mechanism: Mechanism) -> tuple[str, ...]:
        """Only the compass gait stands on a foot."""
        return ('all',) if mechanism.name == 'compass_gait' else ()

    @classmethod
    def applies(cls, setups: Sequence[Setup]) -> bool:
        """Only where the leg that stands is free to lean."""
        return any(setup.fixture not in ('inner_fixed', 'outer_fixed') for setup in setups)


class LandingEffect(Effect):
    """An effect of the ground on a foot that lands; within a stance phase it does nothing."""

    place = 'impact'

    @classmethod
    def sites(cls, mechanism: Mechanism) -> tuple[str, ...]:
        """Only the compass gait walks."""
        return ('all',) if mechanism.name == 'compass_gait' else ()

    @classmethod
    def applies(cls, setups: Sequence[Setup]) -> bool:
        """Only where a foot can land: no leg is fixed or held by springs."""
        return any(setup.may_step for setup in setups)


class SpringEffect(Effect):
    """An effect of the springs of the set-up."""

    place = 'environment'

    @classmethod
    def sites(cls, mechanism: Mechanism) -> tuple[str, ...]:
        """Springs are tied to the legs of a compass gait."""
        return ('all',) if mechanism.name == 'compass_gait' else ()

    @classmethod
    def applies(cls, setups: Sequence[Setup]) -> bool:
        """Only where there is a spring."""
        return any(setup.springs for setup in setups)
