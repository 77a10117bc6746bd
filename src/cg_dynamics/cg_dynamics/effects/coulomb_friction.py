"""Dry friction of a joint."""

from math import log

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter

TRANSITION_RATE = Parameter(
    'transition_rate', 'rad/s', 'rate over which the sign turns smoothly', 1e-4, 1.0,
    starts=(0.01,), scale=0.001, free=False, logarithmic=True,
    leeway=log(2.5), smoothing=True,
)  # fmt: skip


class CoulombFriction(Effect):
    """Coulomb part of Eq. 4.12: -torque tanh(rate / transition_rate)."""

    name = 'coulomb_friction'
    place = 'joint'
    friction = 'dry'
    summary = 'Dry friction, smoothed: -torque tanh(rate / transition_rate) (Eq. 4.12).'
    parameters = (
        Parameter(
            'torque', 'N m', 'level of dry friction', 0.0, 50.0,
            neutral=0.0, starts=(0.01, 0.5), scale=0.02,
        ),
        TRANSITION_RATE,
    )  # fmt: skip
    largest_step = 0.002

    def joint_torque(self, angle, rate, load, z, p):
        """Against the rate."""
        return -p['torque'] * ca.tanh(rate / p['transition_rate']), []
