"""Elastic transmission between motor and joint, as a harmonic drive's flex spline."""

import math
from typing import ClassVar

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class JointFlexibility(Effect):
    """A rotor of reflected inertia drives the joint through a spring and a damper.

    J dw/dt = tau_motor - tau_joint,  tau_joint = k (a - angle) + d (w - rate)      (FLEX)
    with a and w = da/dt the rotor's angle and rate on the joint side of the gear.
    """

    name = 'joint_flexibility'
    place = 'transmission'
    summary = (
        'Rotor and joint are coupled by a spring: J dw/dt = tau_motor - tau_joint, '
        'tau_joint = k (a - angle) + d (w - rate).'
    )
    contains: ClassVar[tuple[str, ...]] = ('rotor_inertia',)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter(
            'stiffness', 'N m/rad', 'k', 0.05, 1e5,
            neutral=float('inf'), starts=(60.0, 200.0, 600.0, 2000.0, 8000.0), scale=10.0,
            logarithmic=True,
        ),
        Parameter(
            'rotor_inertia', 'kg m^2', 'J, seen from the joint', 1e-5, 10.0,
            starts=(0.1,), scale=0.01, logarithmic=True,
        ),
        Parameter(
            'damping', 'N m s/rad', 'd', 1e-4, 100.0,
            starts=(0.5,), scale=0.1, logarithmic=True,
        ),
    )  # fmt: skip
    states = ('rotor_angle', 'rotor_rate')
    largest_step = 0.001

    def transmit(self, torque, angle, rate, z, p):
        """(FLEX)."""
        a, w = z
        joint = p['stiffness'] * (a - angle) + p['damping'] * (w - rate)
        return joint, [w, (torque - joint) / p['rotor_inertia']]

    def without_states(self, values):
        """The rotor turns with the joint."""
        return {'rotor_inertia': {'inertia': values['rotor_inertia']}}

    def implausible(self, values, torque):
        """A spring that winds up by more than a turn is no transmission: it makes torque late."""
        turns = torque / values['stiffness'] / (2 * math.pi)
        return f'winds up by {turns:.2g} turns, at most one allowed' if turns > 1 else ''

    def initial_states(self, angle, rate, torque, p):
        """Wound up by the held torque, moving with the joint."""
        return [angle + torque / p['stiffness'], rate]

    def start_spreads(self, p):
        """Wound up by `start_torque` more or less, and as much energy in the rotor's motion."""
        natural = ca.sqrt(p['stiffness'] * p['rotor_inertia'])
        return [self.start_torque / p['stiffness'], self.start_torque / natural]
