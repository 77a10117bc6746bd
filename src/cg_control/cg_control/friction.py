"""Friction compensation: the torque that the model's joint friction takes, given back (Eq. 4.12).

    tau = u + share fade(|w|) clip(tau_f(w))                                          (FRIC)

tau_f is what the friction effects of the model take at the hip rate w. Around standstill the rate
is mostly noise and its sign a toss, so nothing is given back inside the deadband; beyond it the
compensation fades in over as much again.
"""

from dataclasses import dataclass

import casadi as ca

from cg_dynamics.assemble import acting_effects, parameter_names, parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.settings import Settings, setting


@dataclass(frozen=True)
class FrictionSettings(Settings):
    """How much friction is given back."""

    friction_compensation: bool = setting(
        False, 'give back the friction that the model knows', live=True
    )
    friction_share: float = setting(
        0.9,
        'share that is given back; more than what is there makes the joint run away',
        minimum=0.0,
        maximum=1.0,
        live=True,
    )
    friction_deadband: float = setting(
        0.02, 'hip rate below which nothing is given back', unit='rad/s', minimum=0.0, live=True
    )
    friction_limit: float = setting(
        5.0, 'largest torque that is given back', unit='N m', minimum=0.0, live=True
    )


class FrictionCompensation:
    """(FRIC) for the hip of a model.

    Args:
        model: Its friction effects without states count; friction that depends on the load is
            left to the controller.
    """

    def __init__(self, model: Model):
        self._taken = friction_torque(model)
        self._p = parameter_vector(model, Setup())

    def taken(self, rate: float) -> float:
        """Torque in N m that friction takes at a hip rate in rad/s; it has the rate's sign."""
        return float(self._taken(rate, self._p))

    def torque(self, rate: float, settings: FrictionSettings) -> float:
        """What is to be added to the command at a hip rate in rad/s, N m."""
        if not settings.friction_compensation:
            return 0.0
        speed, deadband = abs(rate), settings.friction_deadband
        if speed <= deadband:
            return 0.0
        fade = 1.0 if deadband == 0.0 else min(1.0, (speed - deadband) / deadband)
        limit = settings.friction_limit
        return settings.friction_share * fade * min(max(self.taken(rate), -limit), limit)


def friction_torque(model: Model) -> ca.Function:
    """(rate, p) -> tau_f of (FRIC), with the parameter vector of the model on either leg."""
    names = parameter_names(model, Setup())
    p = ca.SX.sym('p', len(names))
    by_name = dict(zip(names, ca.vertsplit(p), strict=True))
    rate, torque = ca.SX.sym('rate'), ca.SX(0)
    for effect in acting_effects(model):
        if (
            effect.place == 'joint'
            and 'friction' in effect.name
            and not (effect.states or effect.extra_inputs)
        ):
            own = {q.name: by_name[f'{effect.label}.{q.name}'] for q in effect.parameters}
            added, _ = effect.joint_torque(ca.SX(0), rate, ca.SX(0), [], own)
            torque = torque - added
    return ca.Function('friction', [rate, p], [torque])
