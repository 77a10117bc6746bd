"""Friction that grows with the square of a joint's rate."""

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class QuadraticFriction(Effect):
    """-coefficient rate |rate| (1 - s + s |rate|), s = cubic_share and the rate in rad/s (m/s).

    What stirs or pumps grows with a power of the rate. Between the first and the second lies what
    viscous friction adds to the square, between the second and the third the share of a cube.
    """

    name = 'quadratic_friction'
    place = 'joint'
    family = ('joint_torque', 'rate')
    friction = 'viscous'
    summary = (
        'Friction that grows with the square of the rate, a share of it with the cube: '
        '-coefficient rate |rate| (1 - s + s |rate|).'
    )
    parameters = (
        Parameter(
            'coefficient', 'N m s^2/rad^2', 'friction torque per squared rate', 0.0, 20.0,
            neutral=0.0, starts=(0.005, 0.2), scale=0.01,
        ),
        Parameter(
            'cubic_share', '1', 'share of it, at 1 rad/s, that grows with the cube', 0.0, 1.0,
            neutral=0.0, starts=(0.0,), scale=0.1, free=False, leeway=1.0, ends=('lower', 'upper'),
        ),
    )  # fmt: skip

    def joint_torque(self, angle, rate, load, z, p):
        """Against the rate."""
        fast = ca.fabs(rate)
        growth = 1 + p['cubic_share'] * (fast - 1)
        return -p['coefficient'] * rate * fast * growth, []
