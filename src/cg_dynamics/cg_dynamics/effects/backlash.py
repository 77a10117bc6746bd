"""Play between motor and joint."""

from math import log

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class Backlash(Effect):
    """A rotor of reflected inertia drives the joint through a gap.

    With e = a - angle the wind-up, g half of the gap and s(x) = (x + sqrt(x^2 + r^2))/2 a ramp
    rounded over r = `rounding` g, the teeth touch by

    x = s(e - g) - s(-e - g),  tau_joint = k x + d c (w - rate),  c = dx/de         (GAP)

    Teeth that give way by less than r are told as soft. The narrower the rounding, the more a fit
    is held up by single impacts: so it gets narrow only where gap and teeth are known already.
    """

    name = 'backlash'
    place = 'transmission'
    summary = (
        'Play in the gear: the rotor turns freely within the gap and pushes the joint only '
        'where teeth touch.'
    )
    contains = ('rotor_inertia', 'joint_flexibility')
    parameters = (
        Parameter(
            'gap', 'rad', 'total play at the joint', 2e-4, 0.3,
            neutral=0.0, starts=(0.005, 0.015, 0.05), scale=0.001, logarithmic=True,
        ),
        Parameter(
            'rotor_inertia', 'kg m^2', 'seen from the joint', 1e-5, 10.0,
            starts=(0.05, 0.1, 0.2), scale=0.01, logarithmic=True,
        ),
        Parameter(
            'stiffness', 'N m/rad', 'of the touching teeth', 1.0, 1e5,
            starts=(4000.0,), scale=100.0, logarithmic=True,
        ),
        Parameter(
            'damping', 'N m s/rad', 'of the touching teeth', 1e-3, 1000.0,
            starts=(5.0,), scale=0.5, logarithmic=True,
        ),
        Parameter(
            'rounding', '1', 'share of half of the gap where teeth begin to touch', 1e-4, 0.05,
            starts=(0.005,), scale=5e-4, free=False, logarithmic=True,
            leeway=log(20.0),
        ),
    )  # fmt: skip
    states = ('rotor_angle', 'rotor_rate')
    largest_step = 0.0005

    def transmit(self, torque, angle, rate, z, p):
        """(GAP)."""
        a, w = z
        half = p['gap'] / 2
        wind_up = a - angle
        rounded = p['rounding'] * half

        def ramp(x):
            return (x + ca.sqrt(x**2 + rounded**2)) / 2

        def step(x):
            return (1 + x / ca.sqrt(x**2 + rounded**2)) / 2

        pressed = ramp(wind_up - half) - ramp(-wind_up - half)
        touching = step(wind_up - half) + step(-wind_up - half)
        joint = p['stiffness'] * pressed + p['damping'] * touching * (w - rate)
        return joint, [w, (torque - joint) / p['rotor_inertia']]

    def without_states(self, values):
        """The rotor turns with the joint."""
        return {'rotor_inertia': {'inertia': values['rotor_inertia']}}

    def initial_states(self, angle, rate, torque, p):
        """On the flank that the held torque presses on, moving with the joint."""
        side = ca.tanh(torque / 0.1)
        return [angle + side * p['gap'] / 2 + torque / p['stiffness'], rate]

    def start_spreads(self, p):
        """On that flank still: wound up by `start_torque` more or less, in energy as in motion."""
        natural = ca.sqrt(p['stiffness'] * p['rotor_inertia'])
        return [self.start_torque / p['stiffness'], self.start_torque / natural]
