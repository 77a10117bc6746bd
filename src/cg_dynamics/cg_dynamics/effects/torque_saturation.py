"""A motor or drive that cannot deliver what is asked of it."""

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class TorqueSaturation(Effect):
    """tau_motor = tau within -limit and limit, as a drive that limits its current."""

    name = 'torque_saturation'
    place = 'command'
    summary = 'The motor delivers no more than its limit: tau_motor = tau, cut off at +-limit.'
    parameters = (
        Parameter(
            'limit', 'N m', 'largest torque delivered', 1e-3, 1e3,
            neutral=float('inf'), starts=(0.1, 0.5, 2.0, 5.0, 10.0), scale=0.5, logarithmic=True,
        ),
    )  # fmt: skip

    def deliver(self, torque, z, p):
        """Torque with its peaks cut off."""
        return ca.fmax(-p['limit'], ca.fmin(p['limit'], torque)), []
