"""The IMU's bytes: our parser against a device that was written from the maker's description."""

import math
import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cg_hardware.emulators.gx3_device import Gx3Device
from cg_hardware.imu import gx3


def talking(rate_hz=500.0):
    """A device that samples at this rate and sends by itself."""
    device = Gx3Device(timer=7)
    device.receive(gx3.sampling_command(rate_hz) + gx3.continuous_command(), 0.0)
    return device


def sample(device, k):
    return device.sample(0.002 * k, 0.01, 0.001 * k, -0.7, (0.0, 0.25, -0.125))


def test_a_reading_is_what_the_device_sent():
    device, parser = talking(), gx3.Parser()
    (found,) = parser.feed(sample(device, 5), 123)
    np.testing.assert_allclose(found.euler, (0.01, 0.005, -0.7), rtol=1e-7)
    assert found.rates == (0.0, 0.25, -0.125)
    assert (found.ticks, found.received_ns) == (7 + 625, 123)


def test_commands_are_understood_and_answered():
    device, parser = Gx3Device(), gx3.Parser()
    reply = device.receive(gx3.STOP_COMMAND + gx3.sampling_command(250.0), 1.0)
    reply += device.receive(gx3.IDENTITY_COMMANDS + gx3.continuous_command(), 1.0)
    assert device.period == 0.004
    assert parser.feed(reply, 0) == []
    assert parser.replies == {
        gx3.EULER_AND_RATES: 0, gx3.CONTINUOUS: 1, gx3.SAMPLING: 1, gx3.IDENTITY: 2,
    }  # fmt: skip
    assert parser.identity == {'model': 'emulated GX3-25', 'serial': '6223-00000'}
    assert (parser.bad, parser.skipped) == (0, 0)
    device.receive(gx3.STOP_COMMAND, 1.0)
    assert sample(device, 1) == b''


@pytest.mark.parametrize('rate', [0.0, -500.0, 300.0, 2000.0, 0.5])
def test_rates_that_the_device_has_not_are_refused(rate):
    with pytest.raises(ValueError, match='1000 Hz divided by a whole number'):
        gx3.sampling_command(rate)


@settings(max_examples=200, deadline=None)
@given(
    pieces=st.lists(st.one_of(st.integers(1, 40), st.binary(max_size=60)), max_size=12),
    cuts=st.lists(st.integers(1, 50), min_size=1, max_size=40),
)
def test_true_readings_are_found_in_whatever_surrounds_them(pieces, cuts):
    """Garbage that happens to be a reply with a right sum is one in 65536."""
    device, parser = talking(), gx3.Parser()
    stream, sent = b'', []
    for piece in pieces:
        if isinstance(piece, int):
            message = sample(device, piece)
            stream += message
            sent.append(struct.unpack('>I', message[-6:-2])[0])
        else:
            stream += piece
    # Behind the last one enough comes to close whatever had begun.
    stream += b'\0' * 31
    found, at = [], 0
    while at < len(stream):
        step = cuts[len(found) % len(cuts)]
        found += parser.feed(stream[at : at + step], 0)
        at += step
    kept = [reading.ticks for reading in found]
    assert [t for t in sent if t in kept] == sent
    assert len(parser._buffer) < 64


def test_wrong_sums_and_impossible_numbers_are_no_readings():
    device, parser = talking(), gx3.Parser()
    message = sample(device, 3)
    for k in range(len(message)):
        damaged = bytearray(message)
        damaged[k] ^= 0x10
        assert parser.feed(bytes(damaged) + b'\0' * 31, 0) == []
    for number in (math.nan, math.inf, 7.0):
        body = b'\xcf' + struct.pack('>6fI', 0.0, number, 0.0, 0.0, 0.0, 0.0, 1)
        assert parser.feed(gx3.closed(body) + b'\0' * 31, 0) == []
    assert parser.bad > 30
    assert len(parser.feed(message, 0)) == 1
