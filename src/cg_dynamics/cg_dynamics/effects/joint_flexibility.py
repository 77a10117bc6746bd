"""Elastic transmission between motor and joint, as a harmonic drive's flex spline."""

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class JointFlexibility(Effect):
    """A rotor of reflected inertia drives the joint through a spring and a damper.

    J dw/dt = tau_motor - tau_joint,  tau_joint = k (a - angle) + d (w - rate)      (FLEX)
    with a and w = da/dt the rotor's angle and rate on the joint side of the gear. Friction
    tau_f(angle, rate) of the joint is split: tau_motor holds s tau_f(a, w), and (1 - s)
    tau_f(angle, rate) acts on the joint, with s the share on the motor's side. De Luca and Book,
    "Robots with Flexible Elements", Springer Handbook of Robotics, have both of them too.
    """

    name = 'joint_flexibility'
    place = 'transmission'
    summary = (
        'Rotor and joint are coupled by a spring: J dw/dt = tau_motor - tau_joint, '
        'tau_joint = k (a - angle) + d (w - rate); friction acts on rotor, joint or both.'
    )
    contains = ('rotor_inertia',)
    parameters = (
        Parameter(
            'stiffness', 'N m/rad', 'k', 0.05, 1e5,
            neutral=float('inf'), starts=(60.0, 200.0, 600.0, 2000.0, 8000.0), scale=10.0,
            logarithmic=True,
        ),
        Parameter(
            'rotor_inertia', 'kg m^2', 'J, seen from the joint', 1e-5, 10.0,
            starts=(0.1,), scale=0.01, logarithmic=True,
        ),
        Parameter(
            'damping', 'N m s/rad', 'd', 1e-4, 100.0,
            starts=(0.5,), scale=0.1, logarithmic=True,
        ),
        Parameter(
            'motor_share', '1', "share of the joint's friction that acts on the rotor", 0.0, 1.0,
            neutral=0.0, starts=(0.0,), scale=0.1, bounded=True,
        ),
    )  # fmt: skip
    states = ('rotor_angle', 'rotor_rate')
    largest_step = 0.001

    def transmit(self, torque, angle, rate, z, p):
        """(FLEX)."""
        a, w = z
        joint = p['stiffness'] * (a - angle) + p['damping'] * (w - rate)
        return joint, [w, (torque - joint) / p['rotor_inertia']]

    def rotor(self, z, p):
        """Friction acts at its angle and rate."""
        return z[0], z[1], p['motor_share']

    def without_states(self, values):
        """The rotor turns with the joint."""
        return {'rotor_inertia': {'inertia': values['rotor_inertia']}}

    def initial_states(self, angle, rate, torque, p):
        """Wound up by the held torque, moving with the joint."""
        return [angle + torque / p['stiffness'], rate]
