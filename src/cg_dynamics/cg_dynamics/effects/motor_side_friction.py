"""Elastic transmission with friction before it, where a harmonic drive has most of its own."""

from cg_dynamics.effects.joint_flexibility import JointFlexibility
from cg_dynamics.parameter import Parameter


class MotorSideFriction(JointFlexibility):
    """A rotor drives the joint through a spring, and a share of the joint's friction acts on it.

    J dw/dt = tau_motor + s tau_f(a, w) - tau_joint,  tau_joint = k (a - angle) + d (w - rate)
    with (1 - s) tau_f(angle, rate) left at the joint                               (MFRIC)

    tau_f is all friction without states that the model has at the joint, s the share of it on
    the motor's side. Motor and joint friction stand like this in De Luca and Book, "Robots with
    Flexible Elements", Springer Handbook of Robotics.
    """

    name = 'motor_side_friction'
    summary = (
        'Rotor and joint are coupled by a spring, and a share of the friction of the joint acts '
        'on the rotor.'
    )
    contains = ('joint_flexibility', 'rotor_inertia')
    parameters = (
        *JointFlexibility.parameters,
        Parameter(
            'share', '1', "of the joint's friction that acts on the rotor", 0.0, 1.0,
            starts=(0.5,), scale=0.1, ends=('lower', 'upper'),
        ),
    )  # fmt: skip

    def rotor(self, z, p):
        """Friction acts at its angle and rate."""
        return z[0], z[1], p['share']
