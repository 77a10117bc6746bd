"""Friction where the foot that stands turns on the ground."""

import casadi as ca

from cg_dynamics.effects.effect import StanceEffect
from cg_dynamics.parameter import Parameter


class AnkleFriction(StanceEffect):
    """-coefficient dq_st/dt on the leg that stands, by its rate against the ground."""

    name = 'ankle_friction'
    family = ('outer_torque', 'rate')
    friction = 'viscous'
    summary = (
        'The foot that stands resists turning on the ground: -coefficient times the rate of that '
        'leg.'
    )
    parameters = (
        Parameter(
            'coefficient', 'N m s/rad', 'friction torque per rate', 0.0, 100.0,
            neutral=0.0, starts=(0.05, 1.0), scale=0.05,
        ),
    )  # fmt: skip

    def force(self, body, z, p):
        """Against the rate of the leg that stands."""
        force = ca.SX.zeros(body.q.shape)
        force[body.stance] = -p['coefficient'] * body.v[body.stance]
        return force, []
