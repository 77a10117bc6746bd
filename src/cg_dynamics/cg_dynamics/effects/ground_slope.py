"""Ground, and the rig's zero of all angles with it, that is not level."""

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class GroundSlope(Effect):
    """The rig frame is pitched by `angle`, so up = (-sin(angle), cos(angle)) in it."""

    name = 'ground_slope'
    place = 'environment'
    summary = (
        'The ground, to which angles and spring anchors refer, is pitched (positive downhill '
        'ahead): gravity acts along (sin, -cos) of the angle.'
    )
    parameters = (
        Parameter(
            'angle', 'rad', 'pitch of the ground, positive when it falls away ahead', -0.5, 0.5,
            neutral=0.0, starts=(0.01,), scale=0.002,
        ),
    )  # fmt: skip

    def up(self, up, p):
        """Rotate by -angle."""
        s, c = ca.sin(p['angle']), ca.cos(p['angle'])
        return ca.vertcat(c * up[0] - s * up[1], s * up[0] + c * up[1])
