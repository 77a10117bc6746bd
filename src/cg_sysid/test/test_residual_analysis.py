"""What a remaining error follows: known causes point the right way, noise points nowhere."""

import numpy as np
import pytest

from cg_sysid.report.curves import Curve
from cg_sysid.report.residual_analysis import WORTH_NAMING, explained, followed, leftover


def curve(acceleration, seed=0):
    """A record whose simulation error is the double integral of a function of the motion."""
    rng = np.random.default_rng(seed)
    time = np.arange(6000) * 0.002
    phase = rng.uniform(0, 2 * np.pi, 8)
    omega = 2 * np.pi * np.array([0.3, 0.5, 0.8, 1.1, 1.5, 1.9, 2.3, 2.9])
    wave = omega * time[:, None] + phase
    angle, rate = 0.1 * np.sin(wave).sum(axis=1), 0.1 * (omega * np.cos(wave)).sum(axis=1)
    torque = 5 * np.sin(2 * np.pi * 0.7 * time + 1.0) + 3 * np.sin(2 * np.pi * 2.1 * time)
    missing = acceleration(angle, rate, torque, rng)
    error = np.cumsum(np.cumsum(missing - missing.mean())) * 0.002**2
    return Curve(
        'made', 'held', time, torque[:, None], angle[:, None], angle[:, None],
        (angle + error)[:, None], angle[:, None], rate[:, None],
    )  # fmt: skip


@pytest.mark.parametrize(
    ('name', 'acceleration'),
    [
        ('angle', lambda q, v, u, rng: 3 * q**3),
        ('rate', lambda q, v, u, rng: np.sign(v)),
        ('hip_torque', lambda q, v, u, rng: 0.1 * u),
    ],
)
def test_a_missing_torque_is_seen_to_follow_its_cause(name, acceleration):
    found = leftover([curve(acceleration)], 0, 'rad', ('hip_torque',))
    assert followed(found['follows']) == name


def test_noise_follows_nothing():
    x = np.linspace(-1, 1, 5000)
    y = np.random.default_rng(0).standard_normal(5000)
    assert explained(x, y) < 0.01
    assert followed({'angle': 0.01, 'rate': 0.5 * WORTH_NAMING}) is None


def test_a_curve_explains_what_is_a_function():
    x = np.random.default_rng(0).uniform(-1, 1, 5000)
    assert explained(x, x**2) > 0.97


def test_too_few_samples_say_nothing():
    short = curve(lambda q, v, u, rng: q)
    for name in ('time', 'inputs', 'measured', 'before', 'after', 'position', 'rate'):
        object.__setattr__(short, name, getattr(short, name)[:50])
    assert leftover([short], 0, 'rad', ('hip_torque',)) == {
        'median_frequency_hz': None, 'follows': {},
    }  # fmt: skip
