"""Extra dry friction near standstill."""

from math import log

import casadi as ca

from cg_dynamics.effects.coulomb_friction import TRANSITION_RATE
from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter

AT_REST = 1e-8  # of the Stribeck rate, below which a power of the rate is not followed


class StribeckFriction(Effect):
    """-torque exp(-|rate/stribeck_rate|^exponent) tanh(rate/transition_rate).

    Above the Coulomb level. The exponent is 2 in most texts and 1 in Tustin's; other laws of the
    kind lie between and beyond.
    """

    name = 'stribeck_friction'
    place = 'joint'
    family = ('joint_torque', 'rate')
    friction = 'dry'
    summary = (
        'Dry friction that is higher near standstill and fades with rate: '
        '-torque exp(-|rate/stribeck_rate|^exponent) tanh(rate/transition_rate).'
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
        Parameter(
            'exponent', '1', 'of the fade', 0.5, 8.0,
            starts=(2.0,), scale=0.1, free=False, logarithmic=True,
            leeway=log(2.5),
        ),
        TRANSITION_RATE,
    )  # fmt: skip
    largest_step = 0.002

    def joint_torque(self, angle, rate, load, z, p):
        """Against the rate, near standstill."""
        squared = (rate / p['stribeck_rate']) ** 2 + AT_REST**2
        fade = ca.exp(-(squared ** (p['exponent'] / 2)))
        return -p['torque'] * fade * ca.tanh(rate / p['transition_rate']), []
