"""Extra dry friction near standstill."""

import casadi as ca

from cg_dynamics.effects.coulomb_friction import TRANSITION_RATE
from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class StribeckFriction(Effect):
    """-torque exp(-(rate/stribeck_rate)^2) tanh(rate/transition_rate), above the Coulomb level."""

    name = 'stribeck_friction'
    place = 'joint'
    summary = (
        'Dry friction that is higher near standstill and fades with rate: '
        '-torque exp(-(rate/stribeck_rate)^2) tanh(rate/transition_rate).'
    )
    contains = ('coulomb_friction',)
    parameters = (
        Parameter(
            'torque', 'N m', 'breakaway friction above the Coulomb level', 0.0, 50.0,
            neutral=0.0, starts=(0.01, 0.5), scale=0.02,
        ),
        Parameter(
            'stribeck_rate', 'rad/s', 'rate at which the excess has faded to 1/e', 0.02, 20.0,
            starts=(0.3, 1.5), scale=0.05, logarithmic=True,
        ),
        TRANSITION_RATE,
    )  # fmt: skip
    largest_step = 0.002

    def joint_torque(self, angle, rate, load, z, p):
        """Against the rate, near standstill."""
        fade = ca.exp(-((rate / p['stribeck_rate']) ** 2))
        return -p['torque'] * fade * ca.tanh(rate / p['transition_rate']), []
