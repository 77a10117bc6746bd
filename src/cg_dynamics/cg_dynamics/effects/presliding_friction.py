"""Dry friction that gives way like a spring before it slides."""

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter

START_BEND = 1 / 3**0.5  # standard deviation of what is evenly spread from -1 to 1
SLIDING_RATE = 0.01  # rad/s; a joint faster than this at the start is sliding already


class PreslidingFriction(Effect):
    """Bristles that bend by b before they slide: Dahl's model, with damping LuGre's.

    s = rate - |rate| b,   db/dt = s / deflection,   tau = -torque b - damping s    (LUGRE)
    """

    name = 'presliding_friction'
    place = 'joint'
    friction = 'dry'
    summary = (
        'Dry friction that first yields like a spring (Dahl; LuGre with damping): '
        '-torque b - damping s, s = rate - |rate| b, db/dt = s / deflection.'
    )
    contains = ('coulomb_friction', 'viscous_friction')
    parameters = (
        Parameter(
            'torque', 'N m', 'level of dry friction once it slides', 0.0, 50.0,
            neutral=0.0, starts=(0.01, 0.5), scale=0.02,
        ),
        Parameter(
            'deflection', 'rad', 'angle over which friction builds up', 2e-3, 1.0,
            starts=(0.01, 0.05), scale=0.005, logarithmic=True,
        ),
        Parameter(
            'damping', 'N m s/rad', 'of the bristles as they bend', 0.0, 50.0,
            neutral=0.0, starts=(0.0,), scale=0.05,
        ),
    )  # fmt: skip
    states = ('bristle',)
    largest_step = 0.0005

    def joint_torque(self, angle, rate, load, z, p):
        """(LUGRE)."""
        bent = z[0]
        bending = rate - ca.fabs(rate) * bent
        return -p['torque'] * bent - p['damping'] * bending, [bending / p['deflection']]

    def without_states(self, values):
        """The level to which the bristles bend."""
        return {'coulomb_friction': {'torque': values['torque']}}

    def initial_states(self, angle, rate, torque, p):
        """Fully bent where the joint moves, relaxed where it rests."""
        return [ca.tanh(rate / SLIDING_RATE)]

    def start_spreads(self, p):
        """Bristles lie between -1 and 1, the evener the wider they have been moved."""
        return [START_BEND]
