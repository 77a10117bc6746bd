"""Somebody pushes the robot once."""

import math

import casadi as ca

from cg_dynamics.effects.effect import TIME, StanceEffect
from cg_dynamics.parameter import Parameter


class ExternalPush(StanceEffect):
    """A horizontal force at the hip, a pulse over the time of the record.

    F(t) = impulse exp(-((t - instant) / duration)^2 / 2) / (sqrt(2 pi) duration)       (PUSH)

    A push is an event of a record, not a property of the machine: every record has its own
    impulse and instant, and most have none.
    """

    name = 'external_push'
    summary = (
        'Something pushes the hip forward once: a smooth pulse of force around an instant, with '
        'a given impulse; both are found for each record.'
    )
    contains = ('tether_force',)
    parameters = (
        Parameter(
            'impulse', 'N s', 'integral of the force, positive forward', -200.0, 200.0,
            neutral=0.0, starts=(0.5,), scale=0.1, each='record',
        ),
        Parameter(
            'instant', 's', 'time of the greatest force from the start of the record', 0.0, 600.0,
            starts=(0.5,), scale=0.005, each='record',
        ),
        Parameter(
            'duration', 's', 'standard deviation of the pulse in time', 0.01, 2.0,
            starts=(0.1,), scale=0.02, logarithmic=True,
        ),
    )  # fmt: skip
    extra_inputs = (TIME,)
    largest_step = 0.002

    def force(self, body, p):
        """(PUSH) through the hip's Jacobian."""
        late = (p[TIME] - p['instant']) / p['duration']
        pulse = ca.exp(-(late**2) / 2) / (math.sqrt(2 * math.pi) * p['duration'])
        hip, _ = body.hip()
        return ca.gradient(hip[0], body.q) * p['impulse'] * pulse
