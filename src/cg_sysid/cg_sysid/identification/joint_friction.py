"""What opposes the motion of each joint: by the torques that were measured, and by a model's laws.

The torque that acted less that which the bodies take (torque_error.py) is what friction and the
like have to explain. Over the rate of the joint it shows their law before anybody has named it.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cg_dynamics.mechanisms.urdf import Urdf
from cg_dynamics.model import Model
from cg_sysid.identification import torque_error
from cg_sysid.identification.data_set import DataSet


@dataclass(frozen=True)
class JointFriction:
    """What opposes one joint, sample by sample of a smoothed motion.

    Attributes:
        rate: Of the joint, rad/s (m/s), shape (rows,).
        measured: Torque that its bodies do not take, N m (N), shape (rows,).
        modelled: What the model's laws say of it, shape (rows,).
    """

    rate: np.ndarray
    measured: np.ndarray
    modelled: np.ndarray


def drives_without_friction(model: Model) -> tuple[str, ...]:
    """Driven joints of a robot of a URDF at which no law of the model opposes motion."""
    body = model.mechanism
    if not isinstance(body, Urdf):
        return ()
    rub = {effect.site for effect in model.effects if effect.friction}
    return tuple(joint for joint in body.driven if joint not in rub)


def friction_of(model: Model, data_sets: Sequence[DataSet]) -> dict[str, JointFriction]:
    """What opposes each joint that moves in these records, by the joint's name."""
    bodies = model
    for effect in model.effects:
        if effect.place == 'joint':
            bodies = bodies.without_effect(effect.label)
    rates = [p.of_all(p.motion.rate) for p in torque_error.problems_of(model, data_sets, ())]
    if not rates:
        return {}
    measured, left = (
        torque_error.all_rows(torque_error.left_by(m, data_sets)) for m in (bodies, model)
    )
    found = {}
    for joint, *columns in zip(
        model.mechanism.coordinates, np.vstack(rates).T, measured.T, left.T, strict=True
    ):
        rate, needed, rest = (column[np.isfinite(columns[0])] for column in columns)
        if rate.size:
            found[joint] = JointFriction(rate, needed, needed - rest)
    return found
