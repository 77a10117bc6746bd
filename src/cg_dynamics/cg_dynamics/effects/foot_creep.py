"""A sole that gives way in time."""

import casadi as ca

from cg_dynamics.effects.effect import StanceEffect
from cg_dynamics.parameter import Parameter

WOUND = 0.1  # rad; how far what has crept may be behind as a record begins


class FootCreep(StanceEffect):
    """A spring in series with a damper (Maxwell) against the lean of the leg that stands.

    tau = -stiffness (q_st - c),   dc/dt = (q_st - c)/time_constant                 (FOOT-CREEP)
    """

    name = 'foot_creep'
    summary = (
        'A soft pad under the foot that stands holds the leg upright but gives way in time: '
        '-stiffness (lean - c), dc/dt = (lean - c)/time_constant.'
    )
    contains = ('foot_compliance', 'ankle_friction')
    parameters = (
        Parameter(
            'stiffness', 'N m/rad', 'against fast leaning', 0.0, 1e3,
            neutral=0.0, starts=(5.0, 40.0), scale=0.5,
        ),
        Parameter(
            'time_constant', 's', 'in which it gives way', 0.02, 20.0,
            starts=(0.1, 1.0), scale=0.05, logarithmic=True,
        ),
    )  # fmt: skip
    states = ('crept',)

    def force(self, body, z, p):
        """(FOOT-CREEP)."""
        wound = body.q[body.stance] - z[0]
        force = ca.SX.zeros(body.q.shape)
        force[body.stance] = -p['stiffness'] * wound
        return force, [wound / p['time_constant']]

    def initial_states(self, angle, rate, torque, p):
        """As after a while at rest."""
        return [angle]

    def start_spreads(self, p):
        """A record may begin in motion."""
        return [ca.SX(WOUND)]
