"""Two links with torque at the shoulder, the elbow or both, hanging at q = 0; q2 is relative.

In base parameters a1 = I1 + m2 l1^2, a2 = I2, a3 = m2 r2 l1 (I about the joints) and
b1 = (m1 r1 + m2 l1) g:

    T = a1 w1^2/2 + a2 w2^2/2 + a3 cos(q2) w1 w2,  w1 = v1, w2 = v1 + v2      (DP1)
    V = -b1 cos(q1) - (a3 g / l1) cos(q1 + q2)                                (DP2)
"""

import casadi as ca

from cg_dynamics.mechanisms.compass_gait import direction
from cg_dynamics.mechanisms.mechanism import Mechanism, Symbols
from cg_dynamics.parameter import Parameter


class DoublePendulum(Mechanism):
    """Acrobot, pendubot or both at once, by which torques the recording drives."""

    name = 'double_pendulum'
    coordinates = ('shoulder_angle', 'elbow_angle')
    joints = {'shoulder': (1.0, 0.0), 'elbow': (0.0, 1.0)}  # noqa: RUF012 - read only
    inputs = ('shoulder_torque', 'elbow_torque')
    outputs = ('shoulder_angle', 'elbow_angle')
    output_units = ('rad', 'rad')
    sensor_kinds = {  # noqa: RUF012 - read only
        'shoulder_angle': 'encoder',
        'elbow_angle': 'encoder',
    }
    bodies = ('upper', 'lower')
    parameters = (
        Parameter('upper_inertia', 'kg m^2', 'I1 + m2 l1^2', 1e-6, 1e2, scale=5e-3),
        Parameter('lower_inertia', 'kg m^2', 'I2, about the elbow', 1e-6, 1e2, scale=5e-3),
        Parameter('coupling', 'kg m^2', 'm2 r2 l1', -1e2, 1e2, scale=5e-3),
        Parameter('upper_gravity', 'N m', '(m1 r1 + m2 l1) g', -1e3, 1e3, scale=0.3),
        Parameter('upper_length', 'm', 'shoulder to elbow, l1', 1e-2, 10.0, free=False),
        Parameter('gravity', 'm/s^2', 'acceleration of gravity', 0.0, 30.0, free=False),
    )

    def energies(self, q, v, p: Symbols, setup, up, foot=None):
        """(DP1), (DP2)."""
        w1, w2 = v[0], v[0] + v[1]
        kinetic = (
            p['upper_inertia'] * w1**2 / 2
            + p['lower_inertia'] * w2**2 / 2
            + p['coupling'] * ca.cos(q[1]) * w1 * w2
        )
        lower_gravity = p['coupling'] * p['gravity'] / p['upper_length']
        potential = -p['upper_gravity'] * ca.dot(up, direction(q[0])) - lower_gravity * ca.dot(
            up, direction(q[0] + q[1])
        )
        return kinetic, potential

    def point(self, body, distance, q, p: Symbols, setup):
        """A point of a link, `distance` m from that link's own joint."""
        if body == 'upper':
            return -distance * direction(q[0])
        return -p['upper_length'] * direction(q[0]) - distance * direction(q[0] + q[1])

    def sensors(self, q, v):
        """The two joint encoders."""
        return {'shoulder_angle': q[0], 'elbow_angle': q[1]}

    def consistency(self, p):
        """Positive inertias, and a mass matrix that is positive definite at every elbow angle."""
        a1, a2, a3 = p['upper_inertia'], p['lower_inertia'], p['coupling']
        return [a1, a2, a1 * a2 - a3**2]
