"""Dry friction of a joint."""

import math
from collections.abc import Mapping

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter

TRANSITION_RATE = Parameter(
    'transition_rate', 'rad/s', 'rate over which the sign turns smoothly', 1e-4, 1.0,
    starts=(0.01,), scale=0.001, free=False, logarithmic=True,
    leeway=math.log(5.0), smoothing=True,
)  # fmt: skip
TAIL = 5 / 3  # the deviation from 1 of (2 / pi) arctan(pi x / 2) at large x is 0.4 / x
ROOT = 1 / 3  # share of tails of x / sqrt(1 + x^2), which lies a third of the way


class CoulombFriction(Effect):
    """Coulomb part of Eq. 4.12: -torque tanh(rate / transition_rate).

    Others let friction turn by laws that come to its level more slowly. With x = rate /
    transition_rate, `tails` leads by a parabola through three of them:

        0      tanh x
        1/3    x / sqrt(1 + x^2)                                                        (TAILS)
        1      x (1 + c |x|) / (1 + c |x| + c x^2),  c = 5/3

    The last has the slope and the tail of an arctan.
    """

    name = 'coulomb_friction'
    place = 'joint'
    family = ('joint_torque', 'rate')
    friction = 'dry'
    summary = 'Dry friction, smoothed: -torque tanh(rate / transition_rate) (Eq. 4.12).'
    parameters = (
        Parameter(
            'torque', 'N m', 'level of dry friction', 0.0, 50.0,
            neutral=0.0, starts=(0.01, 0.5), scale=0.02,
        ),
        TRANSITION_RATE,
        Parameter(
            'tails', '1', 'how slowly it comes to its level: a tanh 0, an arctan 1', -0.5, 1.0,
            neutral=0.0, starts=(0.0,), scale=0.1, free=False, leeway=1.0,
        ),
    )  # fmt: skip
    largest_step = 0.002

    def joint_torque(self, angle, rate, load, z, p):
        """Against the rate."""
        x = rate / p['transition_rate']
        slow = x * (1 + TAIL * ca.fabs(x)) / (1 + TAIL * ca.fabs(x) + TAIL * x**2)
        law = through(p['tails'], {0: ca.tanh(x), ROOT: x / ca.sqrt(1 + x**2), 1: slow})
        return -p['torque'] * law, []


def through(t: ca.SX, values: Mapping[float, ca.SX]) -> ca.SX:
    """The polynomial in t that has these values at these places (Lagrange)."""
    terms = [
        value * math.prod((t - other) / (at - other) for other in values if other != at)
        for at, value in values.items()
    ]
    return sum(terms, ca.SX(0))
