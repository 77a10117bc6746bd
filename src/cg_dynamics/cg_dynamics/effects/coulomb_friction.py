"""Dry friction of a joint."""

from math import log

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter

TRANSITION_RATE = Parameter(
    'transition_rate', 'rad/s', 'rate over which the sign turns smoothly', 1e-4, 1.0,
    starts=(0.01,), scale=0.001, free=False, logarithmic=True,
    leeway=log(5.0), smoothing=True,
)  # fmt: skip
KNEE = Parameter(
    'knee', '1', 'share of a law that comes to its level as x / sqrt(1 + x^2)', -1.0, 2.0,
    neutral=0.0, starts=(0.0,), scale=0.1, free=False, leeway=1.0,
)  # fmt: skip
TAIL = 5 / 3  # the deviation from 1 of (2 / pi) arctan(pi x / 2) at large x is 0.4 / x


class CoulombFriction(Effect):
    """Coulomb part of Eq. 4.12: -torque tanh(rate / transition_rate).

    Others let friction turn by an arctan, which comes to its level slowly. `tails` is the share of

        x (1 + c |x|) / (1 + c |x| + c x^2),  x = rate / transition_rate, c = 5/3       (TAILS)

    in the law, which has the slope and the tail of an arctan. Of a robot that somebody drew less
    is known: there `knee` is the share of x / sqrt(1 + x^2), which lies in between.
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
            'tails', '1', 'share of a law with the slow tails of an arctan', -0.5, 1.0,
            neutral=0.0, starts=(0.0,), scale=0.1, free=False, leeway=1.0,
        ),
    )  # fmt: skip
    largest_step = 0.002

    def parameters_in(self, mechanism):
        """With a knee in space."""
        return self.parameters if mechanism.dimensions == 2 else (*self.parameters, KNEE)

    def joint_torque(self, angle, rate, load, z, p):
        """Against the rate."""
        x = rate / p['transition_rate']
        slow = x * (1 + TAIL * ca.fabs(x)) / (1 + TAIL * ca.fabs(x) + TAIL * x**2)
        quick = ca.tanh(x)
        if 'knee' in p:
            quick += p['knee'] * (x / ca.sqrt(1 + x**2) - quick)
        return -p['torque'] * (quick + p['tails'] * (slow - quick)), []
