"""The torque gate: zero when in doubt, never beyond the limit."""

import math

import numpy as np
import pytest

from cg_hardware.safety import GateSettings, TorqueGate, judge

MS = 1_000_000
SETTINGS = GateSettings(torque_limit=40.0, stale_after=0.02)


def gate(**changes):
    return TorqueGate(GateSettings(**{'torque_limit': 40.0, **changes}), ('hip',))


def test_a_good_command_passes_untouched():
    assert judge([3.5], ('hip',), 40.0) == judge([3.5], ('hip',), 40.0)
    assert judge([3.5], ('hip',), 40.0).torque == (3.5,)
    assert not judge([3.5], ('hip',), 40.0).doubt


@pytest.mark.parametrize('torque', [math.nan, math.inf, -math.inf])
def test_what_is_not_finite_gives_zero(torque):
    judgement = judge([torque], ('hip',), 40.0)
    assert judgement.torque == (0.0,)
    assert 'hip' in judgement.doubt


@pytest.mark.parametrize(('torque', 'held'), [(41.0, 40.0), (-1e9, -40.0)])
def test_beyond_the_limit_saturates_and_says_so(torque, held):
    judgement = judge([torque], ('hip',), 40.0)
    assert judgement.torque == (held,)
    assert 'limited' in judgement.doubt


@pytest.mark.parametrize('request_', [[], [1.0, 2.0]])
def test_wrong_length_gives_zero(request_):
    assert judge(request_, ('hip',), 40.0).torque == (0.0,)


def test_one_bad_joint_stops_all():
    assert judge([1.0, math.nan], ('shoulder', 'elbow'), 40.0).torque == (0.0, 0.0)


def test_torque_is_zero_before_the_first_command():
    assert gate().torque(0).torque == (0.0,)


def test_a_command_lives_until_it_is_stale():
    g = gate()
    g.offer([5.0], 100 * MS)
    assert g.torque(119 * MS).torque == (5.0,)
    assert g.torque(121 * MS).torque == (0.0,)
    assert 'old' in g.torque(121 * MS).doubt


def test_a_command_from_the_future_is_not_trusted():
    g = gate()
    g.offer([5.0], 100 * MS)
    assert g.torque(70 * MS).torque == (0.0,)


def test_a_bad_command_ends_the_one_before_it():
    g = gate()
    g.offer([5.0], 0)
    g.offer([math.nan], 1 * MS)
    assert g.torque(2 * MS).torque == (0.0,)
    g.offer([4.0], 3 * MS)
    assert g.torque(4 * MS).torque == (4.0,)


def test_a_command_that_was_overtaken_is_ignored():
    g = gate()
    g.offer([5.0], 10 * MS)
    assert g.offer([9.0], 8 * MS).doubt
    assert g.torque(11 * MS).torque == (5.0,)


def test_dropping_gives_zero():
    g = gate()
    g.offer([5.0], 0)
    g.drop('not active')
    assert g.torque(0).torque == (0.0,)


def test_growth_is_limited_and_decay_is_not():
    g = gate(rate_limit=1000.0)  # 1 N m per ms
    g.torque(0)
    outputs = []
    for ms, wanted in ((1, 10.0), (2, 10.0), (3, 10.0), (4, 0.5), (5, -10.0)):
        g.offer([wanted], ms * MS)
        outputs.append(g.torque(ms * MS).torque[0])
    np.testing.assert_allclose(outputs, [1.0, 2.0, 3.0, 0.5, -1.0])


def test_no_sequence_of_commands_gets_past_the_limit():
    rng = np.random.default_rng(0)
    g = gate(torque_limit=3.0)
    pool = [math.nan, math.inf, 1e300, -5.0, 2.0, 0.0]
    for ms in range(2000):
        if rng.random() < 0.7:
            g.offer([pool[rng.integers(len(pool))]], (ms - int(rng.integers(30))) * MS)
        (torque,) = g.torque(ms * MS).torque
        assert abs(torque) <= 3.0
