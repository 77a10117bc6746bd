"""What recordings of a robot tell of its joints: which have a drive, where others are held.

Asked before the robot is known, so of recordings as they stand: a driver need not list a hand
that the URDF has, nor an effort of a joint that swings freely.
"""

from collections.abc import Mapping, Sequence

import numpy as np

from cg_dynamics.mechanisms.urdf import Urdf
from cg_sysid.records.raw import RawRecording

HELD = 0.02  # rad (m) by which a joint that is held may move


def recorded_drives(raws: Sequence[RawRecording], body: Urdf) -> list[str]:
    """The joints of a robot on which something acted in recordings, and that all of them tell.

    Args:
        raws: Recordings as they stand, of an interface of `body`.
        body: The robot with a drive at each joint.
    """
    found = []
    for joint, channel in zip(body.driven, body.inputs, strict=True):
        position, _ = body.told(joint)
        efforts = [_seen(raw, channel) for raw in raws]
        told = [_seen(raw, position) for raw in raws]
        if any(np.any(e != 0) for e in efforts) and all(map(len, efforts)):
            found.append(joint)
        elif any(len(t) and np.ptp(t) > 0 for t in told):
            found.append(joint)
    return found


def held_positions(
    body: Urdf,
    joints: Sequence[str] | None,
    stated: Mapping[str, float],
    raws: Sequence[RawRecording],
) -> dict[str, float]:
    """Joint that is held -> where: as stated, else as recorded, else 0.

    Args:
        body: The robot with all its joints.
        joints: Those that move; None: all but those of `stated`.
        stated: Joint -> position, rad or m.
        raws: Recordings as they stand, of an interface of `body`.

    Raises:
        ValueError: A joint is not there, one that is held moves in a recording, or one that moves
            is in none.
    """
    free = body.coordinates
    moving = [name for name in free if name not in stated] if joints is None else list(joints)
    for name in (*moving, *stated):
        if stranger := body.description.stranger(name):
            raise ValueError(stranger)
        if name in moving and name in stated:
            raise ValueError(f'{name!r} is among --joints, which move, and among --held')
    found = {}
    for name in free:
        seen = [_seen(raw, f'{name}_position') for raw in raws]
        recorded = np.concatenate([*seen, np.zeros(0)])
        if name in moving:
            if raws and not len(recorded):
                raise ValueError(
                    f'no recording has a position of joint {name!r}; say where it is held '
                    f'(--held {name}=0), or which joints move (--joints)'
                )
            continue
        moved = max((float(np.ptp(positions)) for positions in seen if len(positions)), default=0)
        if moved > HELD:
            raise ValueError(
                f'joint {name!r} moves by {moved:.3g} in a recording; one that is held moves by '
                f'{HELD:g} at most: name it among --joints'
            )
        found[name] = stated.get(name, float(np.median(recorded)) if len(recorded) else 0.0)
    return found


def _seen(raw: RawRecording, channel: str) -> np.ndarray:
    """Values of a channel in a recording; none where it does not have it."""
    for topic in raw.topics.values():
        if channel in topic.values:
            values = topic.values[channel]
            return values[np.isfinite(values)]
    return np.zeros(0)
