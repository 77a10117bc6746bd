"""How an IMU is mounted: axis, sign and zero from what it reads."""

import math

import numpy as np
import pytest

from cg_hardware.imu.mounting import Mounting, MountingError, mounting_of, zero_of


def test_lean_and_rate_have_sign_and_zero():
    mounting = Mounting('roll', -1.0, zero=0.1)
    assert mounting.lean((0.3, 9.0, 9.0)) == pytest.approx(-0.4)
    assert mounting.rate((0.5, 9.0, 9.0)) == -0.5
    # A device that is mounted upside down reads near pi.
    upside = Mounting('pitch', 1.0, zero=math.pi - 0.01)
    assert upside.lean((0.0, -math.pi + 0.02, 0.0)) == pytest.approx(0.03)


def test_a_zero_needs_legs_that_stand_still():
    rng = np.random.default_rng(2)
    still = zero_of(0.02 + 5e-4 * rng.standard_normal(250))
    assert still.angle == pytest.approx(0.02, abs=1e-4)
    assert still.still == pytest.approx(5e-4, rel=0.2)
    with pytest.raises(MountingError, match='the legs moved: the angle varies by 7'):
        zero_of(0.02 * np.sin(np.arange(250) / 9) / 2)
    with pytest.raises(MountingError, match='12 samples came, at least 50'):
        zero_of([0.0] * 12)
    # Across the end of the circle.
    around = np.where(np.arange(100) % 2, math.pi - 1e-4, -math.pi + 1e-4)
    assert abs(zero_of(around).angle) == pytest.approx(math.pi, abs=1e-3)


def test_the_axis_is_the_one_that_leaned():
    found = mounting_of((0.01, 0.5, 3.1), (0.02, 0.26, 3.12))
    assert (found.axis, found.sign, found.zero) == ('pitch', -1.0, -0.5)
    # Yaw across the end of the circle is no lean of 6 rad.
    assert mounting_of((0.0, 0.0, 3.13), (0.3, 0.0, -3.13)).axis == 'roll'
    with pytest.raises(MountingError, match=r'no single axis leaned: roll \+0\.20 rad'):
        mounting_of((0.0, 0.0, 0.0), (0.2, 0.2, 0.0))
    with pytest.raises(MountingError, match='no single axis'):
        mounting_of((0.0, 0.0, 0.0), (0.05, 0.0, 0.0))
