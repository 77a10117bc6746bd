"""Dry friction that varies with the angle of the joint."""

from math import log

import casadi as ca

from cg_dynamics.effects.coulomb_friction import TRANSITION_RATE
from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class PositionDependentFriction(Effect):
    """-torque (1 + cos(cycles angle - tightest)) / 2 tanh(rate / transition_rate)."""

    name = 'position_dependent_friction'
    place = 'joint'
    family = ('joint_friction', 'angle')
    friction = 'dry'
    summary = (
        'A bearing or gear that runs out of true rubs most at one angle: '
        '-torque (1 + cos(cycles angle - tightest))/2 tanh(rate / transition_rate).'
    )
    contains = ('coulomb_friction',)
    wave = ('torque', 'tightest')  # the torque is never negative: only the turn counts
    parameters = (
        Parameter(
            'torque', 'N m', 'extra dry friction where it is tightest', 0.0, 50.0,
            neutral=0.0, starts=(0.5,), scale=0.05,
        ),
        Parameter(
            'tightest', 'rad', 'joint angle of most friction, times cycles', -9.5, 9.5,
            starts=(0.0, 2.1, -2.1), scale=0.1, along='rad',
        ),
        Parameter(
            'cycles', '1', 'tight places in one turn', 0.2, 40.0,
            starts=(1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 13.0, 16.0), scale=0.1, free=False,
            logarithmic=True, leeway=log(2.5), along='rad/m',
        ),
        TRANSITION_RATE,
    )  # fmt: skip
    largest_step = 0.002

    def joint_torque(self, angle, rate, load, z, p):
        """Against the rate."""
        level = p['torque'] * (1 + ca.cos(p['cycles'] * angle - p['tightest'])) / 2
        return -level * ca.tanh(rate / p['transition_rate']), []
