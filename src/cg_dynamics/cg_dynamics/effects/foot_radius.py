"""A foot that rolls on the ground."""

import casadi as ca

from cg_dynamics.effects.effect import StanceEffect
from cg_dynamics.parameter import Parameter


class FootRadius(StanceEffect):
    """A round sole rolls without slipping: the leg pivots about no fixed point.

    With the centre of the sole on the leg, radius above its end, the end of a leg that leans by q
    is at

        (x, z) = radius (q - sin q, 1 - cos q)                                     (ROLL)

    and the whole robot moves along.
    """

    name = 'foot_radius'
    summary = (
        'The foot is round and rolls: the lower end of a leg that leans by q is at '
        'radius (q - sin q, 1 - cos q) instead of standing still.'
    )
    parameters = (
        Parameter(
            'radius', 'm', 'of the sole', 0.0, 1.0, neutral=0.0, starts=(0.02, 0.1), scale=0.005
        ),
    )  # fmt: skip

    def foot(self, body, p):
        """(ROLL)."""
        lean = body.q[body.stance]
        return p['radius'] * ca.vertcat(lean - ca.sin(lean), 1 - ca.cos(lean))
