"""Walks (walking.py) as records."""

import numpy as np
from walking import signals_of

from cg_dynamics.rig import Setup
from cg_sysid.records.record import Record


def as_record(name, done, stance, seed=0, mirrored=False, **sensing):
    """The record of a walk; of its mirror image, which walks backwards, if asked."""
    stamps, signals = signals_of(done, seed, **sensing)
    if mirrored:
        signals = {channel: -values for channel, values in signals.items()}
    torque = signals.pop('hip_torque')
    return Record(
        name, (stamps * 1e9).round().astype(np.int64), {'hip_torque': torque}, signals,
        'compass_gait', Setup(stance=stance),
    )  # fmt: skip
