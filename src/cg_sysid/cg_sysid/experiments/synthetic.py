"""Synthetic recordings: smooth seeded motion seen by idealised sensors, without any model.

They measure how often the checks cry wolf and how surely they find a fault (test_check.py).
Angles and rates are consistent with each other; the torque is unrelated to them.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from cg_interfaces.channels import Mechanism, Topic, mechanism
from cg_interfaces.stamps import NS_PER_S
from cg_sysid.records.raw import NOTE_FORMAT, RawRecording, RawTopic

START_NS = 1_300_000_000 * NS_PER_S


@dataclass(frozen=True)
class Synthesis:
    """What a synthetic recording is like.

    Attributes:
        mechanism: Name of the mechanism.
        duration: In s.
        rate: Samples per second, in Hz.
        amplitude: Size of the motion, in rad.
        bandwidth: Highest frequency of the motion, in Hz.
        quantum: Resolution of encoders, in rad; 0 for none.
        noise: White noise of the encoders and the IMU's angle, in rad.
        rate_noise: White noise of the IMU's rate, in rad/s.
        jitter: Jitter of the stamps, in parts of the sampling time.
        torque: `multisine`, `zero`, `chirp`, `steps` or `sine`.
        rest_share: Share of the time, at the start, in which nothing moves.
    """

    mechanism: str = 'compass_gait'
    duration: float = 8.0
    rate: float = 500.0
    amplitude: float = 0.2
    bandwidth: float = 3.0
    quantum: float = 2.0 * np.pi / 8192
    noise: float = 0.0
    rate_noise: float = 2e-3
    jitter: float = 0.0
    torque: str = 'multisine'
    rest_share: float = 0.0


def synthesise(synthesis: Synthesis, seed: int) -> RawRecording:
    """A healthy recording.

    Args:
        synthesis: What it is like.
        seed: Seed of motion, noise and jitter.

    Returns:
        The recording as `read_raw` would return it, with a complete note.
    """
    rng = np.random.default_rng(seed)
    known = mechanism(synthesis.mechanism)
    count = int(synthesis.duration * synthesis.rate)
    time = np.arange(count) / synthesis.rate
    time += rng.uniform(-0.5, 0.5, count) * synthesis.jitter / synthesis.rate
    values = _measured(synthesis, known, time, rng)
    stamp = START_NS + np.rint(time * NS_PER_S).astype(np.int64)
    delay = rng.gamma(2.0, 1e-4, count)  # of the recorder, in s
    log = stamp + np.rint(delay * NS_PER_S).astype(np.int64)
    topics = {
        t.name: _topic(t, stamp, np.maximum.accumulate(log), values)
        for t in (known.torque, *known.outputs)
    }
    return RawRecording(f'synthetic_{seed}', _note(synthesis), known, topics)


def _topic(
    topic: Topic, stamp: np.ndarray, log: np.ndarray, values: dict[str, np.ndarray]
) -> RawTopic:
    own = {c.name: values[c.name] for c in topic.channels}
    absent = {name: np.zeros(len(stamp), dtype=bool) for name in own}
    return RawTopic(topic.name, topic.msgtype, stamp, log, own, absent)


def _note(synthesis: Synthesis) -> dict[str, Any]:
    return {
        'format': NOTE_FORMAT,
        'experiment': 'synthetic',
        'mechanism': synthesis.mechanism,
        'setup': {'fixture': 'none'},
        'nominal_rate_hz': synthesis.rate,
        'sensor_zeros': {},
        'zeroed_at': '2011-03-13T07:00:00Z',
        'initial_state': 'moving',
        'model_file': 'none.yaml',
        'model_sha256': '0' * 64,
        'software': 'synthetic',
    }


def _measured(
    synthesis: Synthesis, known: Mechanism, time: np.ndarray, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Values of every channel, each of shape (N,)."""
    values = {}
    for name in known.input_names:
        values[name] = torque(synthesis.torque, time, rng)
    for name in known.output_names:
        if name == 'imu_rate':
            continue
        angle, rate = smooth_motion(synthesis, time, rng)
        noise = max(synthesis.noise, 1e-4) if name == 'imu_angle' else synthesis.noise
        values[name] = angle + noise * rng.standard_normal(len(time))
        if name == 'imu_angle':
            values['imu_rate'] = rate + synthesis.rate_noise * rng.standard_normal(len(time))
        elif synthesis.quantum:
            values[name] = np.rint(values[name] / synthesis.quantum) * synthesis.quantum
    return values


def smooth_motion(
    synthesis: Synthesis, time: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """A random smooth angle in rad and its exact derivative in rad/s, each of shape (N,)."""
    frequency = rng.uniform(0.1, synthesis.bandwidth, 12)
    size = rng.standard_normal(12) / (1.0 + frequency)
    size *= synthesis.amplitude / np.sqrt(0.5 * np.sum(size**2))
    phase = rng.uniform(0.0, 2.0 * np.pi, 12)
    argument = 2.0 * np.pi * frequency * time[:, None] + phase
    angle = np.sum(size * np.sin(argument), axis=1)
    rate = np.sum(2.0 * np.pi * frequency * size * np.cos(argument), axis=1)
    # s rises from 0 to 1 over one second after the rest, with a continuous derivative.
    start = synthesis.rest_share * synthesis.duration
    if not start:
        return angle, rate
    s = np.clip(time - start, 0.0, 1.0)
    ramp, slope = s * s * (3.0 - 2.0 * s), 6.0 * s * (1.0 - s)
    return ramp * angle, ramp * rate + slope * angle


def torque(kind: str, time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A torque of the given kind in N m, shape (N,)."""
    span = time[-1] - time[0]
    if kind == 'zero':
        return np.zeros(len(time))
    if kind == 'steps':
        return rng.choice([-4.0, 0.0, 4.0], 10)[(9.99 * (time - time[0]) / span).astype(int)]
    if kind == 'sine':
        return 4.0 * np.sin(2.0 * np.pi * 1.3 * time)
    if kind == 'chirp':
        return 5.0 * np.sin(2.0 * np.pi * (1.0 + 0.5 * 19.0 * time / span) * time)
    if kind == 'multisine':
        frequency = rng.uniform(0.2, 10.0, 20)
        phase = rng.uniform(0.0, 2.0 * np.pi, 20)
        return np.sum(np.sin(2.0 * np.pi * frequency * time[:, None] + phase), axis=1)
    msg = f'torque {kind!r} is not one of multisine, zero, chirp, steps, sine'
    raise ValueError(msg)
