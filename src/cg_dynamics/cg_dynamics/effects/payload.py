"""A point mass that somebody tied on."""

from dataclasses import replace

import casadi as ca

from cg_dynamics.effects.effect import BodyEffect
from cg_dynamics.mechanisms.mechanism import PointMass
from cg_dynamics.parameter import Parameter

SHARES = 0.3, 1.0  # of what a joint carries: masses from which an identification sets out


class Payload(BodyEffect):
    """T = m |dr/dt|^2 / 2, V = m g (up . r) for a point r of a body."""

    name = 'payload'
    summary = 'A point mass rides on a body: T = m |dr/dt|^2 / 2, V = m g (up . r).'
    parameters = (
        Parameter(
            'mass', 'kg', 'of the payload', 0.0, 20.0, neutral=0.0, starts=(0.05, 0.5), scale=0.05
        ),
        Parameter(
            'distance', 'm', 'from the lower or proximal end of the body', 0.0, 3.0,
            starts=(0.6, 0.2, 1.0), scale=0.05,
        ),
    )  # fmt: skip

    def parameters_in(self, mechanism):
        """In space its place is a point in the frame of the link.

        An identification sets out from loads like the link itself, at its centre of mass.
        """
        if mechanism.dimensions == 2:
            return self.parameters
        carried, centre = mechanism.carried(self.site)
        mass = self.parameters[0]
        if carried:
            mass = replace(mass, starts=tuple(share * carried for share in SHARES))
        return (mass, *(
            Parameter(axis, 'm', f'{axis} of the payload in the frame of the link', -3.0, 3.0,
                      starts=(at,), scale=0.05)
            for axis, at in zip('xyz', centre, strict=True)
        ))  # fmt: skip

    def load(self, p):
        """In space it is a part of its body."""
        if 'distance' in p:
            return None
        return PointMass(self.site, p['mass'], ca.vertcat(p['x'], p['y'], p['z']))

    def energies(self, body, p):
        """Energies of the point mass."""
        load = self.load(p)
        place = p['distance'] if load is None else load.place
        position, velocity = body.point(self.site, place)
        return (
            p['mass'] * ca.sumsqr(velocity) / 2,
            p['mass'] * body.p['gravity'] * ca.dot(body.up, position),
        )
