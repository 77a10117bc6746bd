"""Springs of the set-up that lose energy."""

import casadi as ca

from cg_dynamics.effects.effect import SpringEffect
from cg_dynamics.parameter import Parameter


class SpringDamping(SpringEffect):
    """Each spring resists with coefficient ds/dt, s its stretch."""

    name = 'spring_damping'
    summary = 'The springs of the set-up resist being stretched and released: coefficient ds/dt.'
    parameters = (
        Parameter(
            'coefficient', 'N s/m', 'force per rate of stretch, of each spring', 0.0, 100.0,
            neutral=0.0, starts=(0.1, 2.0), scale=0.1,
        ),
    )  # fmt: skip

    def force(self, body, z, p):
        """Against the rate of stretch, through its gradient."""
        force = ca.SX.zeros(body.q.shape)
        for stretch, _ in body.springs():
            rate = ca.jtimes(stretch, body.q, body.v)
            force -= p['coefficient'] * rate * ca.gradient(stretch, body.q)
        return force, []
