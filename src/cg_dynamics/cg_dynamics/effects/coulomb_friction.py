"""Dry friction of a joint."""

from math import log, pi

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

        -torque ((1 - s) tanh(v / transition_rate) + s ((1 - t) root(x) + t tail(x)))   (SLOW)
        root(x) = x / sqrt(1 + x^2),   tail(x) = 2/pi arctan(pi x / 2),   x = v / slow_rate

    with v the rate, s = slow_share and t = slow_tails. Either rate may come out the smaller one:
    the parts differ little in shape. An arctan has the slowest tails that texts draw.
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
        Parameter(
            'slow_tails', '1', 'its way from a root, 0, to an arctan, 1', 0.0, 1.0,
            neutral=0.0, starts=(0.0,), scale=0.1, free=False, leeway=1.0, ends=('lower', 'upper'),
        ),
    )  # fmt: skip
    largest_step = 0.002
    drawings = (
        {'slow_share': 0.0},
        {'slow_share': 1.0, 'slow_tails': 0.0},
        {'slow_share': 1.0, 'slow_tails': 1.0},
    )

    def joint_torque(self, angle, rate, load, z, p):
        """(SLOW), against the rate."""
        quick = ca.tanh(rate / p['transition_rate'])
        x = rate / p['slow_rate']
        root, tail = x / ca.sqrt(1 + x**2), 2 / pi * ca.atan(pi / 2 * x)
        slow = root + p['slow_tails'] * (tail - root)
        return -p['torque'] * (quick + p['slow_share'] * (slow - quick)), []
