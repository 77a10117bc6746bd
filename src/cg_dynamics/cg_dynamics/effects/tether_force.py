"""A cable that pulls."""

import casadi as ca

from cg_dynamics.effects.effect import StanceEffect
from cg_dynamics.parameter import Parameter


class TetherForce(StanceEffect):
    """Q = (dx_hip/dq)' force: a constant horizontal force at the hip."""

    name = 'tether_force'
    summary = 'A cable pulls the hip with a constant horizontal force, positive forward.'
    parameters = (
        Parameter(
            'force', 'N', 'forward pull at the hip', -200.0, 200.0,
            neutral=0.0, starts=(0.5,), scale=0.1,
        ),
    )  # fmt: skip

    def force(self, body, z, p):
        """The force through the hip's Jacobian."""
        hip, _ = body.hip()
        return ca.gradient(hip[0], body.q) * p['force'], []
