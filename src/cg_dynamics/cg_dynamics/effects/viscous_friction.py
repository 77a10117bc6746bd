"""Friction proportional to the rate of a joint."""

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class ViscousFriction(Effect):
    """Viscous part of Eq. 4.12: -coefficient rate."""

    name = 'viscous_friction'
    place = 'joint'
    family = ('joint_torque', 'rate')
    friction = 'viscous'
    summary = 'Friction proportional to the joint rate: -coefficient rate (Eq. 4.12).'
    parameters = (
        Parameter(
            'coefficient', 'N m s/rad', 'friction torque per rate', 0.0, 1000.0,
            neutral=0.0, starts=(0.01, 0.3), scale=0.01,
        ),
    )  # fmt: skip

    def joint_torque(self, angle, rate, load, z, p):
        """Against the rate."""
        return -p['coefficient'] * rate, []
