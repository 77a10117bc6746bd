"""One joint: J dv/dt + m g l sin(q) = tau, hanging at q = 0."""

import casadi as ca

from cg_dynamics.mechanisms.compass_gait import direction
from cg_dynamics.mechanisms.mechanism import Mechanism, Symbols
from cg_dynamics.parameter import Parameter


class Pendulum(Mechanism):
    """A pendulum driven at its pivot."""

    name = 'pendulum'
    coordinates = ('angle',)
    joints = {'joint': (1.0,)}  # noqa: RUF012 - read only
    inputs = ('torque',)
    outputs = ('angle',)
    output_units = ('rad',)
    sensor_kinds = {'angle': 'encoder'}  # noqa: RUF012 - read only
    bodies = ('link',)
    parameters = (
        Parameter('inertia', 'kg m^2', 'about the pivot', 1e-7, 1e3, scale=1e-3),
        Parameter('gravity_torque', 'N m', 'm g l, torque that holds it level', -1e3, 1e3),
        Parameter('gravity', 'm/s^2', 'acceleration of gravity', 0.0, 30.0, free=False),
    )

    def energies(self, q, v, p: Symbols, setup, up, foot=None):
        """T = J v^2 / 2; V = -m g l (up . d(q)): the mass hangs against `up`."""
        return (
            p['inertia'] * v[0] ** 2 / 2,
            -p['gravity_torque'] * ca.dot(up, direction(q[0])),
        )

    def point(self, body, distance, q, p, setup):
        """A point of the link, `distance` m below the pivot."""
        return -distance * direction(q[0])

    def sensors(self, q, v):
        """The joint encoder."""
        return {'angle': q[0]}

    def consistency(self, p):
        """Positive inertia."""
        return [p['inertia']]
