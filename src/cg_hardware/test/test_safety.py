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
    g.offer([5.0], 100 * MS, 100 * MS)
    assert g.torque(119 * MS).torque == (5.0,)
    assert g.torque(121 * MS).torque == (0.0,)
    assert 'old' in g.torque(121 * MS).doubt


def test_a_clock_that_runs_backwards_is_not_trusted():
    g = gate()
    g.offer([5.0], 100 * MS, 100 * MS)
    assert g.torque(70 * MS).torque == (0.0,)


@pytest.mark.parametrize('ahead', [2 * MS + 1, 15 * MS, 3000 * MS, 3_600_000 * MS])
def test_a_command_dated_ahead_is_refused_and_leaves_no_trace(ahead):
    g = gate()
    g.offer([1.0], 100 * MS, 100 * MS)
    judgement = g.offer([7.0], 100 * MS + ahead, 100 * MS)
    assert judgement.refused
    assert 'ahead' in judgement.doubt
    assert g.torque(101 * MS).torque == (1.0,)
    # It never acts, and no good command finds it in its way.
    for late in (15 * MS, 30 * MS, ahead, ahead + 10 * MS):
        assert g.torque(100 * MS + late).torque in ((0.0,), (1.0,))
        g.offer([1.0], 100 * MS + late, 100 * MS + late)
        assert g.torque(100 * MS + late).torque == (1.0,)


def test_a_command_one_sample_ahead_acts_and_is_not_in_the_way_of_the_next():
    g = gate()
    assert not g.offer([7.0], 102 * MS, 100 * MS).refused
    assert g.torque(100 * MS).torque == (7.0,)
    assert not g.offer([1.0], 100 * MS, 100 * MS).refused
    assert g.torque(100 * MS).torque == (1.0,)


def test_the_age_of_a_request_counts_on_the_clock_of_the_measurements():
    g = gate()
    host, machine = 5_000_000 * MS, 100 * MS  # two clocks, as in front of a machine
    g.offer([5.0], machine - 15 * MS, host, machine)
    assert g.torque(host + 4 * MS).torque == (5.0,)
    assert g.torque(host + 6 * MS).torque == (0.0,)
    g.offer([5.0], machine - 21 * MS, host + 10 * MS, machine)
    assert g.torque(host + 10 * MS).torque == (0.0,)


def test_what_is_no_longer_in_force_is_in_nobodys_way():
    g = gate()
    g.offer([5.0], 9000 * MS, 9000 * MS)
    # A machine that was started anew: its stamps begin at 1 s again.
    assert not g.offer([4.0], 1000 * MS, 1000 * MS).refused
    assert g.torque(1000 * MS).torque == (4.0,)


def test_two_publishers_give_zero_until_one_is_left():
    g = gate()
    g.offer([5.0], 0, 0)
    g.publishers = 2
    assert g.torque(MS).torque == (0.0,)
    assert '2 publishers' in g.torque(MS).doubt
    assert g.offer([5.0], 2 * MS, 2 * MS).torque == (0.0,)
    g.publishers = 1
    assert g.torque(3 * MS).torque == (0.0,)  # what came before does not act again
    g.offer([4.0], 4 * MS, 4 * MS)
    assert g.torque(4 * MS).torque == (4.0,)


def test_a_bad_command_ends_the_one_before_it():
    g = gate()
    g.offer([5.0], 0, 0)
    g.offer([math.nan], MS, MS)
    assert g.torque(2 * MS).torque == (0.0,)
    g.offer([4.0], 3 * MS, 3 * MS)
    assert g.torque(4 * MS).torque == (4.0,)


def test_a_command_that_was_overtaken_is_ignored():
    g = gate()
    g.offer([5.0], 10 * MS, 10 * MS)
    assert g.offer([9.0], 8 * MS, 11 * MS).refused
    assert g.torque(11 * MS).torque == (5.0,)


def test_dropping_gives_zero():
    g = gate()
    g.offer([5.0], 0, 0)
    g.drop('not active')
    assert g.torque(0).torque == (0.0,)


def test_growth_is_limited_and_decay_is_not():
    g = gate(rate_limit=1000.0)  # 1 N m per ms
    g.torque(0)
    outputs = []
    for ms, wanted in ((1, 10.0), (2, 10.0), (3, 10.0), (4, 0.5), (5, -10.0)):
        g.offer([wanted], ms * MS, ms * MS)
        outputs.append(g.torque(ms * MS).torque[0])
    np.testing.assert_allclose(outputs, [1.0, 2.0, 3.0, 0.5, -1.0])


def test_no_sequence_of_commands_gets_past_the_limit():
    rng = np.random.default_rng(0)
    g = gate(torque_limit=3.0)
    pool = [math.nan, math.inf, 1e300, -5.0, 2.0, 0.0]
    for ms in range(2000):
        if rng.random() < 0.7:
            stamp = ms + int(rng.integers(-30, 30))
            g.offer([pool[rng.integers(len(pool))]], stamp * MS, ms * MS)
        (torque,) = g.torque(ms * MS).torque
        assert abs(torque) <= 3.0
