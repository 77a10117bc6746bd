"""Learned terms: effects that have no name, as a function of one variable that data drew.

Where no named effect explains what a simulation gets wrong, a function g of one variable s can
still say where it acts and what it follows. g is linear in its coefficients and bounded whatever
s is, by one of three laws:

    smooth     g(s) = sum_k c_k cos(pi k z),   z = (s - low)/(high - low) kept in [0, 1]   (UNM1)
    periodic   g(s) = mean + sum_h a_h cos(2 pi h s/period) + b_h sin(2 pi h s/period)     (UNM2)
    vibrating  the same over time, without the mean, a_h and b_h of each record's own      (UNM3)

(UNM1) has no slope at its ends, so that it goes on as a constant beyond them, smoothly.

The terms are kept apart from the library: model files may hold them, but a diagnosis offers them
only where the library has failed. A name says what g is and what it follows, such as
`unmodelled_joint_torque_of_angle`.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import casadi as ca

from cg_dynamics.effects.coulomb_friction import TRANSITION_RATE
from cg_dynamics.effects.effect import TIME, Body, Effect, Symbols, reading_rate
from cg_dynamics.mechanisms.mechanism import Mechanism
from cg_dynamics.parameter import Parameter, sliding_unit

COSINES = 32  # the shortest half wave is a thirtieth of the range
HARMONICS = 4
VIBRATING_HARMONICS = 2
LARGEST = 1e4  # of a coefficient, in its unit
UNITS = {'angle': 'rad', 'rate': 'rad/s', 'torque': 'N m', 'time': 's', 'body_angle': 'rad'}
OPPOSING = {'friction': 'dry', 'damping': 'viscous'}


class LearnedEffect(Effect):
    """What all learned terms share: a law of one variable.

    Attributes:
        variable: What g is a function of, a key of `UNITS`; `body_angle` is the angle of a
            coordinate that is not the joint's own, which the site names after a colon.
        unit: Of g, at a joint that turns; of an instance, where it acts.
        kind: The law: smooth, periodic or vibrating.
        coefficients: Names of the parameters in which g is linear.
    """

    variable: ClassVar[str]
    unit: ClassVar[str]
    kind: ClassVar[str]
    coefficients: ClassVar[tuple[str, ...]]

    def __init__(self, mechanism: Mechanism, at: str | None = None):
        super().__init__(mechanism, at)
        if self.slides(mechanism):
            self.unit = sliding_unit(self.unit)  # type: ignore[misc]
        followed = self._followed_unit(mechanism)
        self.parameters = tuple(  # type: ignore[misc]
            replace(p, unit=followed) if p.name in ('low', 'high', 'period') else p
            for p in self.parameters
        )

    def _followed_unit(self, mechanism: Mechanism) -> str:
        """Unit of the variable."""
        unit = UNITS[self.variable]
        return sliding_unit(unit) if self.slides(mechanism) else unit

    def acts(self, values: Mapping[str, float]) -> bool:
        """Always: the zero function does nothing, but a fit sets out from it."""
        return True

    @property
    def follows(self) -> str:
        """The variable and of what, such as `angle:hip`; the time of the record as it is."""
        if self.variable == 'time':
            return TIME
        place, _, other = self.site.partition(':')
        return f'{self.variable.removeprefix("body_")}:{other or place}'

    @classmethod
    def law(cls, s: ca.SX, p: Mapping[str, Any]) -> ca.SX:
        """g(s), in `unit`."""
        if cls.kind != 'smooth':
            turn = 2 * ca.pi * s / p['period']
            return sum(
                (p[name] * _wave(name, turn) for name in cls.coefficients if name != 'mean'),
                p.get('mean', ca.SX(0)),
            )
        z = ca.fmin(ca.fmax((s - p['low']) / (p['high'] - p['low']), 0), 1)
        x = ca.cos(ca.pi * z)
        # Chebyshev: cos(k a) = 2 cos(a) cos((k-1) a) - cos((k-2) a), one cosine for all.
        wave, before = x, ca.SX(1)
        total = p['c0'] + p['c1'] * x
        for k in range(2, COSINES):
            wave, before = 2 * x * wave - before, wave
            total += p[f'c{k}'] * wave
        return total


def _wave(name: str, turn: ca.SX) -> ca.SX:
    harmonic = int(name[-1])
    return (ca.cos if name.startswith('cosine') else ca.sin)(harmonic * turn)


class JointTerm(LearnedEffect):
    """g times `carrier`, a torque on one joint."""

    place = 'joint'
    carrier: ClassVar[str]

    def slides(self, mechanism: Mechanism) -> bool:
        """As the joint does, whatever the function follows."""
        return mechanism.slides(self.site.partition(':')[0])

    def _followed_unit(self, mechanism: Mechanism) -> str:
        _, _, other = self.site.partition(':')
        if not other:
            return super()._followed_unit(mechanism)
        return 'm' if other in mechanism.sliding else 'rad'

    @classmethod
    def sites(cls, mechanism: Mechanism) -> tuple[str, ...]:
        """The joints; with a colon, a coordinate that is not the angle of that joint."""
        if cls.variable != 'body_angle':
            return tuple(mechanism.joints)
        return tuple(
            f'{joint}:{name}'
            for joint, row in mechanism.joints.items()
            for name, share in zip(mechanism.coordinates, _rows(mechanism), strict=True)
            if share != tuple(row)
        )

    def _torque(self, s, rate, load, p) -> ca.SX:
        g = self.law(s, p)
        if self.carrier == 'friction':
            return -g * ca.tanh(rate / p['transition_rate'])
        if self.carrier == 'damping':
            return -g * rate
        return g * load if self.carrier == 'gain' else g

    def joint_torque(self, angle, rate, load, z, p):
        """On top of what the transmission delivers."""
        if self.variable == 'body_angle':
            return ca.SX(0), []
        s = {'angle': angle, 'rate': rate, 'torque': load}.get(self.variable)
        return self._torque(p[TIME] if s is None else s, rate, load, p), []

    def force(self, body: Body, z: list[ca.SX], p: Symbols) -> tuple[ca.SX, list[ca.SX]]:
        """The same where the angle is that of another coordinate."""
        if self.variable != 'body_angle':
            return super().force(body, z, p)
        joint, _, name = self.site.partition(':')
        row = ca.DM(body.mechanism.joints[joint])
        s = body.q[body.mechanism.coordinates.index(name)]
        return row * self._torque(s, ca.dot(row, body.v), None, p), []


class OuterTerm(LearnedEffect):
    """A torque g from outside on a leg of a compass gait."""

    place = 'environment'

    @classmethod
    def sites(cls, mechanism: Mechanism) -> tuple[str, ...]:
        """Each leg, and the one that stands; elsewhere joints hold all bodies."""
        return (*mechanism.bodies, 'stance') if mechanism.name == 'compass_gait' else ()

    def force(self, body: Body, z: list[ca.SX], p: Symbols) -> tuple[ca.SX, list[ca.SX]]:
        """On that leg's own coordinate."""
        bodies = body.mechanism.bodies
        leg = body.stance if self.site == 'stance' else bodies.index(self.site)
        force = ca.SX.zeros(body.q.shape)
        s = {'angle': body.q[leg], 'rate': body.v[leg]}.get(self.variable)
        force[leg] = self.law(p[TIME] if s is None else s, p)
        return force, []


class SensorTerm(LearnedEffect):
    """An error g of one sensor channel: of its reading or another, its rate, torque or time."""

    place = 'sensor'

    def __init__(self, mechanism: Mechanism, at: str | None = None):
        super().__init__(mechanism, at)
        if self.variable == 'torque':
            self.extra_inputs = (self._other,)  # type: ignore[misc]

    def slides(self, mechanism: Mechanism) -> bool:
        """Where the sensor reads a length or its rate."""
        return mechanism.output_unit(self.site.partition(':')[0]) in ('m', 'm/s')

    def _followed_unit(self, mechanism: Mechanism) -> str:
        if self.variable == 'torque':
            return dict(zip(mechanism.inputs, mechanism.input_units, strict=True))[self._other]
        if self.variable == 'angle' and self._other:
            return mechanism.output_unit(self._other)
        return super()._followed_unit(mechanism)

    @classmethod
    def sites(cls, mechanism: Mechanism) -> tuple[str, ...]:
        """Channels of that unit; with a colon, the reading or torque that the error follows."""

        def reading(unit: str) -> tuple[str, ...]:
            alike = (unit, sliding_unit(unit))
            units = zip(mechanism.outputs, mechanism.output_units, strict=True)
            return tuple(channel for channel, of in units if of in alike)

        own = reading(cls.unit)
        if cls.variable in ('time', 'rate'):
            return own
        followed = mechanism.inputs if cls.variable == 'torque' else reading(UNITS[cls.variable])
        return tuple(c if c == f else f'{c}:{f}' for c in own for f in followed)

    @property
    def _other(self) -> str:
        return self.site.partition(':')[2]

    def read(self, outputs, z, p):
        """Add the error to the channel."""
        channel = self.site.partition(':')[0]
        if self.variable in ('torque', 'time'):
            s = p[self._other or TIME]
        elif self.variable == 'rate' and not self.unit.endswith('/s'):
            s = p[reading_rate(channel)]
        else:
            s = outputs[self._other or channel]
        return {**outputs, channel: outputs[channel] + self.law(s, p)}, []


def _rows(mechanism: Mechanism) -> list[tuple[float, ...]]:
    n = len(mechanism.coordinates)
    return [tuple(float(i == j) for j in range(n)) for i in range(n)]


def _coefficients(kind: str) -> tuple[str, ...]:
    if kind == 'smooth':
        return tuple(f'c{k}' for k in range(COSINES))
    harmonics = VIBRATING_HARMONICS if kind == 'vibrating' else HARMONICS
    waves = tuple(f'{w}{h}' for h in range(1, harmonics + 1) for w in ('cosine', 'sine'))
    return waves if kind == 'vibrating' else ('mean', *waves)


def _parameters(unit: str, variable: str, kind: str) -> tuple[Parameter, ...]:
    of = UNITS[variable]
    found = tuple(
        Parameter(
            name, unit, 'coefficient of the function', -LARGEST, LARGEST,
            neutral=0.0, scale=0.1, each='record' if kind == 'vibrating' else '',
        )
        for name in _coefficients(kind)
    )  # fmt: skip
    if kind == 'smooth':
        return found + tuple(
            Parameter(
                end, of, f'{end} end of the range that data cover', -1e6, 1e6,
                starts=(at,), free=False,
            )
            for end, at in (('low', -1.0), ('high', 1.0))
        )  # fmt: skip
    period = Parameter(
        'period', of, 'of the function', 1e-4, 1e3, starts=(1.0,), scale=1e-3, logarithmic=True
    )
    return (*found, period)


# What g is: base class, unit, carrier, and the variables that make sense there.
_TERMS: tuple[tuple[str, type[LearnedEffect], str, str, tuple[str, ...]], ...] = (
    ('joint_torque', JointTerm, 'N m', 'torque',
     ('angle', 'rate', 'torque', 'time', 'body_angle')),
    ('joint_friction', JointTerm, 'N m', 'friction', ('angle', 'torque', 'time', 'body_angle')),
    ('joint_damping', JointTerm, 'N m s/rad', 'damping',
     ('angle', 'torque', 'time', 'body_angle')),
    ('torque_gain', JointTerm, '1', 'gain', ('angle', 'rate', 'time')),
    ('outer_torque', OuterTerm, 'N m', '', ('angle', 'rate', 'time')),
    ('angle_error', SensorTerm, 'rad', '', ('angle', 'rate', 'torque', 'time')),
    ('rate_error', SensorTerm, 'rad/s', '', ('angle', 'rate', 'torque', 'time')),
)  # fmt: skip
_SUMMARIES = {
    'joint_torque': 'A torque g at the joint adds to that of the motor',
    'joint_friction': 'Dry friction -g tanh(rate / transition_rate) of the joint adds',
    'joint_damping': 'Viscous friction -g rate of the joint adds',
    'torque_gain': 'The torque of the motor is off by g times itself',
    'outer_torque': 'A torque g from outside acts on a leg',
    'angle_error': 'A sensor of an angle is off by g',
    'rate_error': 'A sensor of a rate is off by g',
}
_LAWS = {'smooth': 'of', 'periodic': 'periodic_in', 'vibrating': 'vibrating_in'}


def _kinds(what: str, variable: str) -> tuple[str, ...]:
    if variable == 'time' and what in ('joint_torque', 'outer_torque', *_ERRORS):
        return ('smooth', 'periodic', 'vibrating')
    if variable == 'angle' and what in _TURNING:
        return ('smooth', 'periodic')
    if variable == 'torque' and what == 'joint_torque':
        return ('smooth', 'periodic')  # a drive that knows steps only
    return ('smooth',)


_ERRORS = ('angle_error', 'rate_error')
_TURNING = ('joint_torque', 'joint_friction', 'torque_gain', 'angle_error')  # teeth, poles, discs


def _define() -> dict[str, type[LearnedEffect]]:
    """One class for each place, variable and law; a table says which there are."""
    found: dict[str, type[LearnedEffect]] = {}
    for what, base, unit, carrier, variables in _TERMS:
        for variable in variables:
            for kind in _kinds(what, variable):
                name = f'unmodelled_{what}_{_LAWS[kind]}_{variable}'
                summary = (
                    f'{_SUMMARIES[what]}: a learned {kind} function of '
                    f'{variable.replace("_", " ")}.'
                )
                parameters = _parameters(unit, variable, kind)
                body: dict[str, Any] = {
                    '__module__': __name__,
                    '__doc__': summary,
                    'name': name,
                    'summary': summary,
                    'variable': variable,
                    'family': (what, variable),
                    'unit': unit,
                    'kind': kind,
                    'coefficients': _coefficients(kind),
                    'carrier': carrier,
                    'friction': OPPOSING.get(carrier, ''),
                    'ripple': what == 'joint_torque' and kind == 'periodic',
                    'parameters': (
                        (*parameters, TRANSITION_RATE) if carrier == 'friction' else parameters
                    ),
                    'extra_inputs': (TIME,) if variable == 'time' else (),
                    'largest_step': 0.002,
                }
                found[name] = type(''.join(w.title() for w in name.split('_')), (base,), body)
    return found


UNMODELLED = _define()
# Worker processes find a class by its name in this module.
globals().update({cls.__name__: cls for cls in UNMODELLED.values()})
