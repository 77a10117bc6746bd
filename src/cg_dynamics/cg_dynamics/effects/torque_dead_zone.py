"""A drive that delivers nothing for small commands."""

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter

SHARPEST = 1e-9  # N m, so that a zone of no width has corners


class TorqueDeadZone(Effect):
    """tau_motor = tau less its part within -half_width and half_width.

    With w the half width, r the roundness and corners rounded over e = r w,

    tau_motor = tau - (d(tau + w) - d(tau - w))/2,   d(y)^2 = y^2 + e^2                     (DEAD)
    """

    name = 'torque_dead_zone'
    place = 'command'
    family = ('joint_torque', 'torque')
    ripple = True
    summary = (
        'The drive delivers nothing for small commands and less by as much for others: '
        'tau_motor = tau less its part within +-half_width.'
    )
    parameters = (
        Parameter(
            'half_width', 'N m', 'largest torque of which nothing is delivered', 0.0, 100.0,
            neutral=0.0, starts=(0.1, 0.5, 2.0), scale=0.05,
        ),
        Parameter(
            'roundness', '1', 'of the corners, in half widths; 0 is a sharp bend', 0.0, 10.0,
            starts=(0.01,), scale=0.1, free=False, leeway=1.5,
        ),
    )  # fmt: skip

    def deliver(self, torque, z, p):
        """(DEAD), with the difference of the roots written as a sum."""
        w, edge = p['half_width'], p['roundness'] * p['half_width'] + SHARPEST

        def distance(y):
            """From a corner."""
            return ca.sqrt(y**2 + edge**2)

        lost = 2 * torque * w / (distance(torque + w) + distance(torque - w))
        return torque - lost, []
