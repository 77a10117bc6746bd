"""Ground, and the rig's zero of all angles with it, that is not level."""

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter

TILT = tuple(
    Parameter(
        axis,
        'rad',
        f'tilt of the base about its {axis} axis',
        -0.5,
        0.5,
        neutral=0.0,
        starts=(0.01,),
        scale=0.002,
    )
    for axis in 'xy'
)


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

    def parameters_in(self, mechanism):
        """In space the base can be tilted about two axes."""
        return self.parameters if mechanism.dimensions == 2 else TILT

    @property
    def sizes(self):
        """All of its angles."""
        return self.parameters

    def acts(self, values):
        """Where any of its angles is not 0."""
        return any(values.values())

    def up(self, up, p):
        """Rotate by -angle; by -x, then by -y."""
        if 'x' in p:
            (sx, sy), (cx, cy) = ((f(p['x']), f(p['y'])) for f in (ca.sin, ca.cos))
            up = ca.vertcat(up[0], cx * up[1] + sx * up[2], cx * up[2] - sx * up[1])
            return ca.vertcat(cy * up[0] - sy * up[2], up[1], sy * up[0] + cy * up[2])
        s, c = ca.sin(p['angle']), ca.cos(p['angle'])
        return ca.vertcat(c * up[0] - s * up[1], s * up[0] + c * up[1])
