"""Air that resists the legs."""

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class AerodynamicDrag(Effect):
    """-coefficient w |w| on each leg, w its own rate in the world; a joint rubs by w1 - w2."""

    name = 'aerodynamic_drag'
    place = 'environment'
    family = ('outer_torque', 'rate')
    summary = (
        'Air resists each leg with the square of its own rate in the world: -coefficient w |w|.'
    )
    parameters = (
        Parameter(
            'coefficient', 'N m s^2/rad^2', 'drag torque per squared rate of a leg', 0.0, 50.0,
            neutral=0.0, starts=(0.02, 0.3), scale=0.02,
        ),
    )  # fmt: skip

    @classmethod
    def sites(cls, mechanism):
        """The compass gait, whose coordinates are those rates; elsewhere quadratic friction."""
        return ('all',) if mechanism.name == 'compass_gait' else ()

    def force(self, body, z, p):
        """Against the rate of each leg."""
        return -p['coefficient'] * body.v * ca.fabs(body.v), []
