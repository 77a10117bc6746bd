"""Air that resists the legs."""

import casadi as ca

from cg_dynamics.effects.effect import StanceEffect
from cg_dynamics.parameter import Parameter


class AerodynamicDrag(StanceEffect):
    """-coefficient w |w| on each leg, w its own rate in the world, where a joint rubs by w1 - w2."""

    name = 'aerodynamic_drag'
    summary = (
        'Air resists each leg with the square of its own rate in the world: -coefficient w |w|.'
    )
    parameters = (
        Parameter(
            'coefficient', 'N m s^2/rad^2', 'drag torque per squared rate of a leg', 0.0, 50.0,
            neutral=0.0, starts=(0.02, 0.3), scale=0.02,
        ),
    )  # fmt: skip

    def force(self, body, p):
        """Against the rate of each leg."""
        return -p['coefficient'] * body.v * ca.fabs(body.v)
