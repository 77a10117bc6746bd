"""Friction that grows with the square of a joint's rate."""

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class QuadraticFriction(Effect):
    """-coefficient rate |rate|."""

    name = 'quadratic_friction'
    place = 'joint'
    family = ('joint_torque', 'rate')
    friction = 'viscous'
    summary = 'Friction that grows with the square of the rate: -coefficient rate |rate|.'
    parameters = (
        Parameter(
            'coefficient', 'N m s^2/rad^2', 'friction torque per squared rate', 0.0, 20.0,
            neutral=0.0, starts=(0.005, 0.2), scale=0.01,
        ),
    )  # fmt: skip

    def joint_torque(self, angle, rate, load, z, p):
        """Against the rate."""
        return -p['coefficient'] * rate * ca.fabs(rate), []
