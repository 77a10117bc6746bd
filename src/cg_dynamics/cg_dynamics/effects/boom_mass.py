"""A hip whose weight differs from its inertia, as with a boom or counterweight."""

import casadi as ca

from cg_dynamics.effects.effect import StanceEffect
from cg_dynamics.parameter import Parameter


class BoomMass(StanceEffect):
    """V = m g (up . hip) with no kinetic energy of its own; m is negative for a counterweight."""

    name = 'boom_mass'
    place = 'body'
    summary = (
        'A planariser carries part of the hip, or loads it: gravity acts on an extra hip mass '
        'that has no inertia (negative for a counterweight).'
    )
    parameters = (
        Parameter(
            'weight', 'kg', 'gravitational less inertial hip mass', -50.0, 50.0,
            neutral=0.0, starts=(0.05,), scale=0.02,
        ),
    )  # fmt: skip

    def energies(self, body, p):
        """Potential energy at the hip, the upper end of the stance leg."""
        hip, _ = body.hip()
        return 0, p['weight'] * body.p['gravity'] * ca.dot(body.up, hip)
