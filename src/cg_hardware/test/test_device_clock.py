"""Stamps by the device's clock: right to tenths of a millisecond, however the wire jitters."""

import numpy as np
import pytest

from cg_hardware.imu.device_clock import DeviceClock

TICKS = 62_500
EPOCH = 1_700_000_000_000_000_000


def stamps(seconds, drift, latency, begin=0, wrap=1 << 32, rate=500.0):
    """Errors of the stamps in s, and the clock, for samples that arrive `latency` s late."""
    clock = DeviceClock(TICKS, wrap, latency_s=0.0)
    true = np.arange(int(seconds * rate)) / rate
    late = latency(len(true))
    errors = []
    for t, delay in zip(true, late, strict=True):
        ticks = (begin + int(t * TICKS * (1 + drift))) % wrap
        stamp = clock.stamp(ticks, EPOCH + round((t + delay) * 1e9))
        errors.append((stamp - EPOCH) / 1e9 - t)
    return np.array(errors), clock


@pytest.mark.parametrize('drift', [-100e-6, 0.0, 60e-6])
def test_stamps_jitter_less_than_the_wire(drift):
    rng = np.random.default_rng(4)

    def wire(n):
        # At least 0.3 ms; half a millisecond more as a rule, now and then 10 ms.
        return 3e-4 + rng.exponential(5e-4, n) + 1e-2 * (rng.random(n) < 0.02)

    errors, clock = stamps(60.0, drift, wire)
    settled = errors[1000:]
    # The shortest latency cannot be told from the instants; what is left is a tick and the line.
    assert abs(settled.mean() - 3e-4) < 1e-4
    assert settled.std() < 5e-5
    assert clock.drift == pytest.approx(-drift, abs=1e-5)


def test_an_adapter_that_hands_out_every_16_ms():
    period = 0.016

    def wire(n):
        t = np.arange(n) / 500.0
        return np.ceil(t / period + 1e-9) * period - t + 2e-4

    errors, _ = stamps(60.0, 30e-6, wire)
    assert errors[2500:].std() < 2e-4


def test_the_counter_wraps_and_time_goes_on():
    errors, clock = stamps(20.0, 0.0, lambda n: np.full(n, 1e-3), begin=(1 << 32) - 300_000)
    np.testing.assert_allclose(errors, 1e-3, atol=2.0 / TICKS)
    assert clock.jumps == 0


@pytest.mark.parametrize('jump', [0.4, -3.0])
def test_a_clock_that_jumps_begins_anew(jump):
    clock = DeviceClock(TICKS, 1 << 32)
    for k in range(2000):
        clock.stamp(10**6 + k * 125, EPOCH + k * 2_000_000)
    stamp = clock.stamp(10**6 + 2000 * 125, EPOCH + 2000 * 2_000_000 + round(jump * 1e9))
    assert clock.jumps == 1
    assert stamp == EPOCH + 2000 * 2_000_000 + round(jump * 1e9)


def test_the_time_on_the_wire_is_taken_off():
    clock = DeviceClock(TICKS, latency_s=2e-3)
    assert clock.stamp(5, EPOCH) == EPOCH - 2_000_000
