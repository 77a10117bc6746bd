"""Numbers and names as people read them."""

import math

import pytest

from cg_sysid.text import effect_name, listed, measured, number, plain_unit


@pytest.mark.parametrize(
    ('value', 'text'),
    [
        (None, '\u2013'), (math.nan, '\u2013'), (0.0, '0'), (1.0, '1.00'),
        (-0.1234, '\u22120.123'),
        (248123.0, '248\u202f000'), (1.5e9, '1.50e9'), (2e-7, '2.00e\u22127'),
    ],
)  # fmt: skip
def test_number(value, text):
    assert number(value) == text


@pytest.mark.parametrize(
    ('value', 'sigma', 'unit', 'text'),
    [
        (0.00801, 0.00005, 's', '8.010 \u00b1 0.050 ms'),
        (1.8402, 0.00016, 'N m', '1.84020 \u00b1 0.00016 N m'),
        (2e-5, 3e-3, 'rad/s', '0.0 \u00b1 3.0 mrad/s'),
        (-1e-6, 1e-3, '1', '0.0000 \u00b1 0.0010'),
        (1e5, 5.4e5, 'N m/rad', '100\u202f000 \u00b1 540\u202f000 N m/rad'),
        (3.0, math.inf, 'N m s^2/rad^2', '3.000 N m s\u00b2/rad\u00b2'),
        (3.0, None, '1', '3.000'),
        (None, None, 's', '\u2013'),
    ],
)  # fmt: skip
def test_measured(value, sigma, unit, text):
    assert measured(value, sigma, unit) == text


def test_names():
    assert effect_name('sensor_delay@imu_angle') == 'sensor delay (imu angle)'
    assert plain_unit('kg m^2') == 'kg m\u00b2'
    assert listed(['a', 'b', 'c'], 'or') == 'a, b or c'
    assert listed([]) == ''
