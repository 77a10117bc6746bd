"""Dry friction that differs by direction."""

import casadi as ca

from cg_dynamics.effects.coulomb_friction import TRANSITION_RATE
from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class AsymmetricFriction(Effect):
    """-excess max(0, tanh(rate / transition_rate)): only while turning forward.

    On top of the Coulomb level; a negative excess makes the forward level the lower one.
    """

    name = 'asymmetric_friction'
    place = 'joint'
    family = ('joint_torque', 'rate')
    friction = 'dry'
    summary = (
        'Dry friction is higher one way than the other: '
        '-excess max(0, tanh(rate / transition_rate)), on top of the Coulomb level.'
    )
    parameters = (
        Parameter(
            'excess', 'N m', 'forward less backward level of dry friction', -50.0, 50.0,
            neutral=0.0, starts=(0.01, 0.5), scale=0.02,
        ),
        TRANSITION_RATE,
    )  # fmt: skip
    largest_step = 0.002

    def joint_torque(self, angle, rate, load, z, p):
        """Against the rate, where that is positive."""
        return -p['excess'] * ca.fmax(0, ca.tanh(rate / p['transition_rate'])), []
