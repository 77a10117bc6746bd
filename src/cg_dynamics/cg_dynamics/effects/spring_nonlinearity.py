"""Springs of the set-up that are not linear."""

import casadi as ca

from cg_dynamics.effects.effect import SpringEffect
from cg_dynamics.parameter import Parameter


class SpringNonlinearity(SpringEffect):
    """Each spring pulls with stiffness (s + hardening s^3), s its stretch."""

    name = 'spring_nonlinearity'
    summary = (
        'The springs of the set-up harden (or soften) as they stretch: force '
        'stiffness (s + hardening s^3).'
    )
    parameters = (
        Parameter(
            'hardening', '1/m^2', 'cubic over linear stiffness', -2.0, 200.0,
            neutral=0.0, starts=(0.05, -0.05), scale=0.02,
        ),
    )  # fmt: skip

    def energies(self, body, p):
        """The quartic part of their potential."""
        share = sum((k * s**4 / 4 for s, k in body.springs()), ca.SX(0))
        return 0, p['hardening'] * share
