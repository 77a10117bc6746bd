"""Torque that ripples with the angle of the joint."""

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class CoggingTorque(Effect):
    """tau = tau_motor + amplitude sin(cycles angle + phase), before any flexibility."""

    name = 'cogging_torque'
    place = 'transmission'
    family = ('joint_torque', 'angle')
    ripple = True
    summary = (
        'Magnets or teeth pull the joint to certain angles: a torque '
        'amplitude sin(cycles angle + phase) adds to the motor torque.'
    )
    wave = ('amplitude', 'phase')
    parameters = (
        Parameter(
            'amplitude', 'N m', 'of the ripple', -20.0, 20.0,
            neutral=0.0, starts=(0.2,), scale=0.02,
        ),
        Parameter(
            'cycles', '1', 'per revolution of the joint', 1.0, 400.0,
            starts=(12.0, 4.0, 6.0, 8.0, 10.0, *range(15, 64, 3)), scale=0.2, swept=True,
            along='rad/m',
        ),
        Parameter(
            'phase', 'rad', 'of the ripple at joint angle 0', -9.5, 9.5, starts=(0.0,), scale=0.1,
            along='rad',
        ),
    )  # fmt: skip

    def transmit(self, torque, angle, rate, z, p):
        """Motor torque and ripple."""
        return torque + p['amplitude'] * ca.sin(p['cycles'] * angle + p['phase']), []
