"""The compass gait: two leg pairs, a hip body that bisects them, a point foot as pivot.

The energies are written once in the six lumps of conventions.md for both stance legs; with
d(a) = (sin a, cos a) the direction of a body that leans by a, l the leg length and h the hip,

    h = l d(q_st)                                                      (CG1)
    T / (mt l^2) = |dh/dt|^2 / (2 l^2) + (c1 - c3) w1^2/2 + (c2 - c3) w2^2/2 + c3 (w1 + w2)^2/2
                   - dh/dt . (c4 d'(q1) w1 + c5 d'(q2) w2 - 2 c6 d'(q3) (w1 + w2)) / l   (CG2)
    V / (mt g)   = up . (h - c4 l d(q1) - c5 l d(q2) + 4 c6 l d(q3)),  q3 = (q1 + q2)/2   (CG3)

which gives Eq. 4.4 to 4.6 of the thesis when leg 1 (inner) is stance, and the same with
c1 <-> c2, c4 <-> c5 when leg 2 is.
"""

import casadi as ca

from cg_dynamics.mechanisms.mechanism import Kinematics, Mechanism, Symbols
from cg_dynamics.parameter import Parameter
from cg_dynamics.rig import Setup


def direction(angle) -> ca.SX:
    """Unit vector (x, z) of a body that leans forward by angle."""
    return ca.vertcat(ca.sin(angle), ca.cos(angle))


def normal(angle) -> ca.SX:
    """Derivative of `direction` with respect to the angle."""
    return ca.vertcat(ca.cos(angle), -ca.sin(angle))


class CompassGait(Mechanism):
    """The compass gait while one foot is a pivot."""

    name = 'compass_gait'
    coordinates = ('q_inner', 'q_outer')
    joints = {'hip': (1.0, -1.0)}  # noqa: RUF012 - read only
    inputs = ('hip_torque',)
    outputs = ('imu_angle', 'imu_rate', 'hip_angle')
    output_units = ('rad', 'rad/s', 'rad')
    sensor_kinds = {'imu_angle': 'inclinometer', 'imu_rate': 'gyro', 'hip_angle': 'encoder'}  # noqa: RUF012 - read only
    bodies = ('inner', 'outer')
    parameters = (
        Parameter('leg_length', 'm', 'foot to hip', 0.05, 5.0, free=False),
        Parameter('total_mass', 'kg', 'whole robot', 0.05, 500.0, free=False),
        Parameter('gravity', 'm/s^2', 'acceleration of gravity', 0.0, 30.0, free=False),
        Parameter('c1', '1', 'inner legs about the hip, plus c3', 1e-5, 2, scale=0.02),
        Parameter('c2', '1', 'outer legs about the hip, plus c3', 1e-5, 2, scale=0.02),
        Parameter('c3', '1', 'inertia of the hip body, a quarter', 1e-7, 1.0, scale=1e-4),
        Parameter('c4', '1', 'first moment of the inner legs', -1.0, 1.0, scale=0.02),
        Parameter('c5', '1', 'first moment of the outer legs', -1.0, 1.0, scale=0.02),
        Parameter('c6', '1', 'first moment of the hip body, a quarter', -0.5, 0.5, scale=5e-4),
    )

    def energies(self, q, v, p: Symbols, setup: Setup, up, foot=None):
        """(CG2), (CG3)."""
        stance = 0 if setup.stance == 'inner' else 1
        l = p['leg_length']
        hip, hip_rate = l * direction(q[stance]), l * normal(q[stance]) * v[stance]
        if foot is not None:
            hip, hip_rate = foot + hip, ca.jtimes(foot, q, v) + hip_rate
        return self.energies_about_hip(q, v, hip, hip_rate, p, up)

    def energies_about_hip(self, q, v, hip, hip_rate, p: Symbols, up):
        """(CG2), (CG3) for a hip anywhere, in m, moving at hip_rate, in m/s, shapes (2, 1)."""
        l, mt, g = p['leg_length'], p['total_mass'], p['gravity']
        c1, c2, c3, c4, c5, c6 = (p[f'c{i}'] for i in range(1, 7))
        q3 = (q[0] + q[1]) / 2
        both = v[0] + v[1]
        moment_rate = (
            c4 * normal(q[0]) * v[0] + c5 * normal(q[1]) * v[1] - 2 * c6 * normal(q3) * both
        )
        kinetic = (
            mt
            * l**2
            * (
                ca.sumsqr(hip_rate) / (2 * l**2)
                + (c1 - c3) * v[0] ** 2 / 2
                + (c2 - c3) * v[1] ** 2 / 2
                + c3 * both**2 / 2
                - ca.dot(hip_rate, moment_rate) / l
            )
        )
        moment = c4 * direction(q[0]) + c5 * direction(q[1]) - 4 * c6 * direction(q3)
        potential = mt * g * ca.dot(up, hip - l * moment)
        return kinetic, potential

    def point(self, body, distance, q, p: Symbols, setup: Setup):
        """A point of a leg, `distance` m from that leg's foot."""
        stance, leg = (self.bodies.index(name) for name in (setup.stance, body))
        l = p['leg_length']
        return l * direction(q[stance]) - (l - distance) * direction(q[leg])

    def sensors(self, q, v):
        """IMU on the inner legs, encoder between the legs."""
        return {'imu_angle': q[0], 'imu_rate': v[0], 'hip_angle': q[0] - q[1]}

    def kinematics(self, setup: Setup) -> Kinematics:
        """A fixed leg stays at 0; tied legs share one angle."""
        if setup.fixture == 'inner_fixed':
            return Kinematics(('q_outer',), ca.DM([0, 1]))
        if setup.fixture == 'outer_fixed':
            return Kinematics(('q_inner',), ca.DM([1, 0]))
        if setup.fixture == 'legs_tied':
            return Kinematics(('q_both',), ca.DM([1, 1]))
        return super().kinematics(setup)

    def consistency(self, p):
        """Positive masses and inertias exist: theory.md, (LUMPS)."""
        c1, c2, c3, c4, c5, c6 = (p[f'c{i}'] for i in range(1, 7))
        # Multiplied out by nothing: each denominator is itself required to be positive.
        share = c4**2 / (c1 - c3) + c5**2 / (c2 - c3) + 4 * c6**2 / c3
        return [c1 - c3, c2 - c3, c3, 1 - share]
