"""Friction compensation: the torque that the model's joint friction takes, given back (Eq. 4.12).

    tau = u + share fade(|w|) clip(tau_f(a, w))                                       (FRIC)

tau_f is what the friction effects of the model take at the hip angle a and rate w. Around
standstill the rate is mostly noise and its sign a toss, so nothing is given back inside the
deadband; beyond it the compensation fades in over as much again.
"""

from dataclasses import dataclass

import casadi as ca
import numpy as np

from cg_dynamics.assemble import acting_effects, parameter_names, parameter_vector
from cg_dynamics.effects import Effect
from cg_dynamics.linearise import without_extra_states
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_interfaces.settings import Settings, setting


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


def compensated(effect: Effect) -> bool:
    """Whether a friction is one that the motor of its joint can give back."""
    return bool(effect.friction) and effect.place == 'joint'


def known_beforehand(effect: Effect) -> bool:
    """Whether a friction is `compensated` and depends on the joint's angle and rate alone."""
    if not compensated(effect) or effect.states or effect.extra_inputs:
        return False
    angle, rate, load = (ca.SX.sym(name) for name in ('angle', 'rate', 'load'))
    p = {parameter.name: ca.SX.sym(parameter.name) for parameter in effect.parameters}
    torque, _ = effect.joint_torque(angle, rate, load, [], p)
    return not ca.depends_on(torque, load)


class FrictionCompensation:
    """(FRIC) for one joint of a model.

    Friction that depends on the load or on a clock is left to the controller; of a friction with
    states its level counts.

    Args:
        model: Its friction at that joint.
        joint: The joint; None takes the first.
    """

    def __init__(self, model: Model, joint: str | None = None):
        self._taken = friction_torque(model, joint)
        self._p = friction_parameters(model)

    def taken(self, angle: float, rate: float) -> float:
        """Torque in N m that friction takes at a joint's angle and rate, in rad and rad/s."""
        return float(self._taken(angle, rate, self._p))

    def torque(self, angle: float, rate: float, settings: FrictionSettings) -> float:
        """What is to be added to the command at a joint's angle and rate, N m."""
        if not settings.friction_compensation:
            return 0.0
        speed, deadband = abs(rate), settings.friction_deadband
        if speed <= deadband:
            return 0.0
        fade = 1.0 if deadband == 0.0 else min(1.0, (speed - deadband) / deadband)
        limit = settings.friction_limit
        return settings.friction_share * fade * min(max(self.taken(angle, rate), -limit), limit)


def friction_parameters(model: Model) -> np.ndarray:
    """The p of `friction_torque`, shape (np,)."""
    return parameter_vector(without_extra_states(model), Setup())


def friction_torque(model: Model, joint: str | None = None) -> ca.Function:
    """(angle, rate, p) -> tau_f of (FRIC) at a joint; arguments as of `FrictionCompensation`."""
    joint = joint or next(iter(model.mechanism.joints))
    model = without_extra_states(model)
    names = parameter_names(model, Setup())
    p = ca.SX.sym('p', len(names))
    by_name = dict(zip(names, ca.vertsplit(p), strict=True))
    angle, rate, torque = ca.SX.sym('angle'), ca.SX.sym('rate'), ca.SX(0)
    for effect in acting_effects(model):
        if known_beforehand(effect) and effect.site == joint:
            own = {q.name: by_name[f'{effect.label}.{q.name}'] for q in effect.parameters}
            added, _ = effect.joint_torque(angle, rate, ca.SX(0), [], own)
            torque = torque - added
    return ca.Function('friction', [angle, rate, p], [torque])
