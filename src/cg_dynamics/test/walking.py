"""Recordings of a robot that walks down a slope: hybrid.walk at a fine step, seen by sensors."""

import numpy as np

from cg_dynamics.model import Model
from cg_dynamics.walking.gait import section_state
from cg_dynamics.walking.hybrid import Walk, WalkOptions, walk

SLOPE = 0.05
RATE = 500.0
NOISE = {'imu_angle': 5e-4, 'imu_rate': 5e-3, 'hip_angle': 5e-5}
QUANTUM = {'hip_angle': 2 * np.pi / 20000}


def stepping_command(seed: int = 0, alpha: float = 0.2, wave: float = 3.0):
    """(time, stance, x) -> hip torque that swings the leg ahead, and a wave that excites."""
    rng = np.random.default_rng(seed)
    frequency, phase = rng.uniform(1.0, 4.0), rng.uniform(0, 2 * np.pi)

    def command(time, stance, x):
        sign, swing = (1.0, 0) if stance == 'outer' else (-1.0, 1)
        torque = 60 * (-alpha - x[swing]) - 6 * x[2 + swing]
        torque += wave * np.sin(2 * np.pi * frequency * time + phase)
        return [float(sign * np.clip(torque, -40, 40))]

    return command


def walking(
    model: Model,
    seed: int = 0,
    duration: float = 4.0,
    slope: float = SLOPE,
    stance: str = 'inner',
    alpha: float = 0.2,
) -> Walk:
    """Some steps down a slope; angles from the vertical."""
    rng = np.random.default_rng([seed, 1])
    start = np.array([alpha, 1.0, 0.0]) + rng.uniform(-1, 1, 3) * [0.01, 0.08, 0.2]
    options = WalkOptions(slope=slope, step=5e-4, sample_time=1 / RATE)
    x0 = section_state(start, stance, slope)
    return walk(model, stance, x0, duration, stepping_command(seed, alpha), options)


def signals_of(done: Walk, seed: int = 0, jitter: float = 0.1, noise=NOISE, quantum=QUANTUM):
    """What sensors and drive report of a walk.

    Returns:
        Stamps in s, shape (n,), and channel -> values, 'hip_torque' among them.
    """
    rng = np.random.default_rng([seed, 2])
    time = np.concatenate([arc.time for arc in done.arcs])
    states = np.concatenate([arc.states for arc in done.arcs])
    torque = np.concatenate([arc.inputs[:, 0] for arc in done.arcs])
    count = int((done.time - 1e-3) * RATE)
    grid = np.arange(count) / RATE
    stamps = grid + np.clip(rng.standard_normal(count), -3, 3) * jitter / RATE / 3
    stamps[0] = 0.0
    # Two rows of one instant are before and after an event: what is read there is after it.
    row = np.clip(np.searchsorted(time, stamps, side='right') - 1, 0, len(time) - 2)
    span = np.maximum(time[row + 1] - time[row], 1e-12)
    share = np.clip((stamps - time[row]) / span, 0, 1)[:, None]
    x = states[row] * (1 - share) + states[row + 1] * share
    clean = {'imu_angle': x[:, 0], 'imu_rate': x[:, 2], 'hip_angle': x[:, 0] - x[:, 1]}
    signals = {'hip_torque': torque[np.searchsorted(time, grid + 1e-9, side='right') - 1]}
    for name, values in clean.items():
        read = values + noise[name] * rng.standard_normal(count)
        q = quantum.get(name, 0.0)
        signals[name] = np.rint(read / q) * q if q else read
    return stamps, signals
