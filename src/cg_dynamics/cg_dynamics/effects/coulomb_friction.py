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


class CoulombFriction(Effect):
    """Coulomb part of Eq. 4.12: -torque tanh(rate / transition_rate).

    Machines and texts let friction turn in other ways, by an arctan or as a root does; and where
    seals and bearings rub at one joint, each turns by itself. So a share may turn more slowly:

        -torque ((1 - s) tanh(v / transition_rate) + s v / sqrt(v^2 + slow_rate^2))     (SLOW)

    with v the rate and s = slow_share. Either rate may come out the smaller one: the two parts
    differ little in shape. With its rates free the law follows an arctan to 1 % of the level.
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
            'slow_share', '1', 'share of it that turns more slowly', 0.0, 1.0,
            neutral=0.0, starts=(0.0,), scale=0.1, free=False, leeway=1.0, ends=('lower', 'upper'),
        ),
        Parameter(
            'slow_rate', 'rad/s', 'rate over which that share turns', 1e-4, 1.0,
            starts=(0.01,), scale=0.001, free=False, logarithmic=True, leeway=log(5.0),
        ),
    )  # fmt: skip
    largest_step = 0.002

    def joint_torque(self, angle, rate, load, z, p):
        """(SLOW), against the rate."""
        quick = ca.tanh(rate / p['transition_rate'])
        slow = rate / ca.sqrt(rate**2 + p['slow_rate'] ** 2)
        return -p['torque'] * (quick + p['slow_share'] * (slow - quick)), []
