"""Gear friction that grows with the torque that the gear transmits."""

import casadi as ca

from cg_dynamics.effects.coulomb_friction import TRANSITION_RATE
from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class LoadDependentFriction(Effect):
    """-coefficient |load| tanh(rate / transition_rate), load the transmitted torque."""

    name = 'load_dependent_friction'
    place = 'joint'
    family = ('joint_friction', 'torque')
    friction = 'dry'
    summary = (
        'Teeth rub with the load they carry: -coefficient |load| tanh(rate / transition_rate), '
        'load the transmitted torque.'
    )
    parameters = (
        Parameter(
            'coefficient', '1', 'friction torque per transmitted torque', 0.0, 0.9,
            neutral=0.0, starts=(0.05,), scale=0.01,
        ),
        TRANSITION_RATE,
    )  # fmt: skip
    largest_step = 0.002

    @classmethod
    def sites(cls, mechanism):
        """Joints with a gear."""
        return tuple(mechanism.joints)

    def joint_torque(self, angle, rate, load, z, p):
        """Against the rate."""
        return -p['coefficient'] * ca.fabs(load) * ca.tanh(rate / p['transition_rate']), []
