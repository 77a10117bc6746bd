"""Friction that changes while the machine warms up."""

import casadi as ca

from cg_dynamics.effects.coulomb_friction import TRANSITION_RATE
from cg_dynamics.effects.effect import CLOCKS, SESSION_TIME, TIME, Effect
from cg_dynamics.parameter import Parameter


class FrictionDrift(Effect):
    """-excess exp(-time / time_constant) tanh(rate / transition_rate).

    It comes on top of the Coulomb level. A negative excess is friction that grows. A machine that
    rests between recordings warms anew in each; one that hardly does goes on where it was.
    """

    name = 'friction_drift'
    place = 'joint'
    family = ('joint_friction', 'time')
    friction = 'dry'
    summary = (
        'Grease warms up: dry friction starts off by an excess that fades with the time of the '
        'recording or of the whole session, '
        '-excess exp(-time / time_constant) tanh(rate / transition_rate).'
    )
    contains = ('coulomb_friction',)
    parameters = (
        Parameter(
            'excess', 'N m', 'dry friction at the start less that at the end', -50.0, 50.0,
            neutral=0.0, starts=(0.02, 0.5), scale=0.02,
        ),
        Parameter(
            'time_constant', 's', 'time in which the excess fades to 1/e', 0.2, 600.0,
            starts=(2.0, 10.0), scale=0.5, logarithmic=True,
        ),
        Parameter(
            'whole_session', '1', '1 if time goes on from recording to recording, 0 if it begins '
            'anew in each', 0.0, 1.0, starts=(0.0, 1.0), free=False,
        ),
        TRANSITION_RATE,
    )  # fmt: skip
    extra_inputs = CLOCKS
    largest_step = 0.002

    def joint_torque(self, angle, rate, load, z, p):
        """Against the rate, less and less."""
        time = p[TIME] + p['whole_session'] * (p[SESSION_TIME] - p[TIME])
        level = p['excess'] * ca.exp(-time / p['time_constant'])
        return -level * ca.tanh(rate / p['transition_rate']), []
