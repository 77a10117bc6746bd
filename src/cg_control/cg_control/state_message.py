"""What a /state message says, read by its fields: interfaces.md. No ROS here."""

from typing import Any

import numpy as np

from cg_dynamics.rig import STANCES
from cg_interfaces.channels import ROTOR

GAP_S = 0.02  # between states, after which the one before is history


def state_of(message: Any) -> tuple[str, np.ndarray]:
    """Stance leg and state of a /state message.

    Args:
        message: A sensor_msgs/msg/JointState.

    Returns:
        The leg that stands, and (q_inner, q_outer, rates), shape (4,), in rad and rad/s; angle
        and rate of the hip's rotor behind them where the message has one, shape (6,).

    Raises:
        ValueError: naming what is missing.
    """
    stance = message.header.frame_id.removesuffix('_foot')
    if stance not in STANCES:
        raise ValueError(f'frame_id is {message.header.frame_id!r}; no foot of this robot')
    given = list(message.name)
    if len(message.position) != len(given) or len(message.velocity) != len(given):
        raise ValueError('state without as many positions and velocities as names')
    names = [*STANCES, *([ROTOR] if ROTOR in given else [])]
    try:
        rows = [given.index(name) for name in names]
    except ValueError:
        raise ValueError(f'state of {given}; expected {names}') from None
    q = [message.position[row] for row in rows]
    v = [message.velocity[row] for row in rows]
    return stance, np.array([*q[:2], *v[:2], *q[2:], *v[2:]])
