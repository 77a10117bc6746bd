"""Signs that only a model can tell: the IMU as a whole, an angle or the torque that drives it.

The averages of law.py are put into the model's equations of motion, once as recorded and once
with one sensor or torque mirrored. Numbers that are 20 % off, or an effect that the model lacks,
leave some of the accelerations unexplained; a wrong sign leaves more than all of them.
"""

from collections.abc import Mapping

import casadi as ca
import numpy as np

from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.model import Model
from cg_sysid.check_signals import Signal
from cg_sysid.findings import Finding
from cg_sysid.law import Motion, motion_of
from cg_sysid.raw import RawRecording
from cg_sysid.trial import sensor_matrix

BETTER = 0.5  # what a mirrored channel leaves over what the recording as it is leaves, [1]
POOR = 0.1  # share of the accelerations below which the model is right as it is, [1]
PER_CHANNEL = 0.02  # spread of angles in rad from which a coordinate counts as moving


def mirrored_channel(
    raw: RawRecording, signals: Mapping[str, Signal], model: Model
) -> Finding | None:
    """The one channel with which mirrored the model explains the motion, if there is one.

    Args:
        raw: The recording.
        signals: Its channels.
        model: Nominal model of the machine.

    Returns:
        A finding; None if the signs are right, or if set-up and sensors leave it open.
    """
    body = model.mechanism
    if body.name != raw.mechanism or raw.setup.fixture != 'none':
        return None  # one free coordinate looks the same when angle and torque are mirrored
    motion = motion_of({n: signals[n] for n in (*body.inputs, *body.outputs) if n in signals})
    if motion is None or len(motion.angle) < 2:
        return None
    left = {
        channel: _unexplained(motion.mirrored((channel,)), raw, model)
        for channel in (*motion.angle, *motion.torque)
    }
    as_is = _unexplained(motion, raw, model)
    best, second = sorted(left, key=lambda channel: left[channel])[:2]
    if as_is < POOR or left[best] > BETTER * min(as_is, left[second]):
        return None
    return Finding(
        'sign_error', 'error', best, f'has the wrong sign: mirrored, the model leaves '
        f'{left[best]:.0%} of the accelerations unexplained, as it is {as_is:.0%}',
        value=as_is, allowed=left[best])


def _unexplained(motion: Motion, raw: RawRecording, model: Model) -> float:
    """Share of the accelerations that the model leaves, mean over the moving coordinates."""
    equations = assemble(model, raw.setup)
    m, channels = equations.coordinates, model.mechanism.outputs
    rows = [j for j, channel in enumerate(channels) if channel in motion.angle]
    solve = np.linalg.pinv(sensor_matrix(model.mechanism, raw.setup)[rows, :m])
    names = [channels[j] for j in rows]
    angle, rate, wanted = (
        solve @ np.array([part[name] for name in names])
        for part in (motion.angle, motion.rate, motion.acceleration)
    )
    count = len(motion.time)
    x = np.zeros((equations.x.numel(), count))
    x[:m], x[m: 2 * m] = angle, rate
    u = np.ones((equations.u.numel(), count))
    u[: len(motion.torque)] = np.array([motion.torque[n] for n in model.mechanism.inputs])
    p = np.tile(parameter_vector(model, raw.setup)[:, None], count)
    accelerations = ca.Function('a', [equations.x, equations.u, equations.p],
                                [equations.rates[m: 2 * m]])
    found = np.asarray(accelerations.map(count)(x, u, p))
    moving = np.std(angle, axis=1) > PER_CHANNEL
    shares = np.sum((wanted - found) ** 2, axis=1) / np.sum(wanted**2, axis=1)
    return float(np.mean(shares[moving])) if moving.any() else 0.0
