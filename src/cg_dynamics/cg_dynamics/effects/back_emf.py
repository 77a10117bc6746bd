"""Electrical damping of a motor whose drive applies a voltage."""

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class BackEmf(Effect):
    """-coefficient rate, while the drive holds the motor's terminals (kt^2/R of the motor)."""

    name = 'back_emf'
    place = 'joint'
    friction = 'viscous'
    summary = (
        'A voltage drive damps the motor by its back-EMF, -coefficient rate (kt^2/R), but only '
        'while `drive_enabled` is 1.'
    )
    parameters = (
        Parameter(
            'coefficient', 'N m s/rad', 'kt^2/R, seen from the joint', 0.0, 50.0,
            neutral=0.0, starts=(0.01, 0.3), scale=0.01,
        ),
    )  # fmt: skip
    extra_inputs = ('drive_enabled',)

    @classmethod
    def sites(cls, mechanism):
        """Joints with a motor."""
        return tuple(mechanism.joints)

    def joint_torque(self, angle, rate, load, z, p):
        """Against the rate, while enabled."""
        return -p['coefficient'] * p['drive_enabled'] * rate, []
