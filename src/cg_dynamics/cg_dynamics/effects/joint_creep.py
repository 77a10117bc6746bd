"""Something soft across a joint that gives way in time: hoses, cables, rubber."""

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter

WOUND = 0.1  # rad (m); how far what has crept may be behind as a record begins


class JointCreep(Effect):
    """A spring in series with a damper (Maxwell) across the joint.

    tau = -stiffness (angle - c),   dc/dt = (angle - c)/time_constant                     (CREEP)
    """

    name = 'joint_creep'
    place = 'joint'
    summary = (
        'A spring across the joint gives way in time, so that the way back differs from the way '
        'there: tau = -stiffness (angle - c), dc/dt = (angle - c)/time_constant.'
    )
    contains = ('viscous_friction',)
    parameters = (
        Parameter(
            'stiffness', 'N m/rad', 'against fast motion', 0.0, 1e3,
            neutral=0.0, starts=(5.0,), scale=0.5,
        ),
        Parameter(
            'time_constant', 's', 'in which it gives way', 0.02, 20.0,
            starts=(0.1, 1.0), scale=0.05, logarithmic=True,
        ),
    )  # fmt: skip
    states = ('crept',)

    def joint_torque(self, angle, rate, load, z, p):
        """(CREEP)."""
        wound = angle - z[0]
        return -p['stiffness'] * wound, [wound / p['time_constant']]

    def initial_states(self, angle, rate, torque, p):
        """As after a while at rest."""
        return [angle]

    def start_spreads(self, p):
        """A record may begin in motion."""
        return [ca.SX(WOUND)]
