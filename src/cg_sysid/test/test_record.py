"""Records: validated once, held inputs, cut and merged without losing a sample."""

import numpy as np
import pytest

from cg_dynamics.rig import Setup
from cg_interfaces.stamps import NS_PER_S
from cg_sysid.errors import RecordingError
from cg_sysid.records.record import Record, hold, merge_stamps, place

START = 1_300_000_000 * NS_PER_S


def make_record(count=1000, step_ns=2_000_000, **changes):
    """A pendulum record at 500 Hz whose angle has a sample on every second row."""
    rows = np.arange(count)
    angle = np.where(rows % 2 == 0, np.sin(0.01 * rows), np.nan)
    fields = {
        'name': 'test',
        'stamp_ns': START + step_ns * rows,
        'inputs': {'torque': np.cos(0.02 * rows)},
        'outputs': {'angle': angle},
        'mechanism': 'pendulum',
        'setup': Setup(),
        'note': {},
        'source': '',
    }
    return Record(**{**fields, **changes})


def test_time_is_exact_at_a_date_of_today():
    record = make_record(step_ns=1)
    np.testing.assert_allclose(record.time * 1e9, np.arange(1000), rtol=1e-15)


def test_dt_adds_up_to_the_duration():
    record = make_record()
    assert record.dt.sum() == pytest.approx(record.duration, abs=1e-12)
    assert len(record) == 1000


def test_arrays_are_read_only_copies():
    stamps = START + np.arange(10) * 1000
    record = make_record(10, stamp_ns=stamps)
    stamps[0] = 0
    assert record.stamp_ns[0] == START
    with pytest.raises(ValueError, match='read-only'):
        record.outputs['angle'][0] = 1.0


def test_samples_leave_out_rows_without_one():
    time, values = make_record().samples('angle')
    assert len(time) == len(values) == 500
    assert not np.isnan(values).any()
    with pytest.raises(ValueError, match='no output'):
        make_record().samples('hip_angle')


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'stamp_ns': START + np.zeros(1000, dtype=np.int64)}, 'strictly'),
        ({'stamp_ns': np.linspace(0.0, 1.0, 1000)}, 'integer nanoseconds'),
        ({'stamp_ns': np.array([START])}, 'at least 2'),
        ({'inputs': {}}, 'input torque is missing'),
        ({'inputs': {'torque': np.zeros(3)}}, 'shape'),
        ({'inputs': {'torque': np.full(1000, np.nan)}}, 'must be finite'),
        ({'inputs': {'hip_torque': np.zeros(1000)}}, "unknown input 'hip_torque'"),
        ({'outputs': {}}, 'no output'),
        ({'outputs': {'angle': np.full(1000, np.nan)}}, 'no sample'),
        ({'outputs': {'angle': np.full(1000, np.inf)}}, 'must be finite'),
        ({'outputs': {'speed': np.zeros(1000)}}, "unknown output 'speed'"),
        ({'mechanism': 'cart_pole'}, 'unknown mechanism'),
    ],
)
def test_bad_records_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        make_record(**changes)


def test_slice_keeps_what_lies_inside():
    record = make_record()
    part = record.slice(0.5, 1.0)
    assert part.stamp_ns[0] - record.stamp_ns[0] == NS_PER_S // 2
    assert len(part) == 250
    np.testing.assert_array_equal(part.inputs['torque'], record.inputs['torque'][250:500])
    with pytest.raises(RecordingError, match='at least 2'):
        record.slice(5.0, 6.0)


@pytest.mark.parametrize('length', [0.5, 0.3, 1.0, 2.0])
def test_segments_tile_the_record(length):
    record = make_record()
    parts = record.segments(length)
    assert len(parts) == int(2.0 / length + 1e-9)
    joined = np.concatenate([part.stamp_ns for part in parts])
    np.testing.assert_array_equal(joined, record.stamp_ns[: len(joined)])
    assert len({len(part) for part in parts}) == 1


@pytest.mark.parametrize('seed', range(10))
def test_merging_loses_no_sample(seed):
    rng = np.random.default_rng(seed)
    stamps = [np.unique(rng.integers(0, 10**9, 300)) * 10_000 for _ in range(3)]
    rows = merge_stamps(stamps)
    assert np.all(np.diff(rows) > 0)
    for own in stamps:
        values = rng.standard_normal(len(own))
        placed = place(own, values, rows)
        np.testing.assert_array_equal(placed[~np.isnan(placed)], values)


def test_stamps_within_a_microsecond_share_a_row():
    a = np.arange(5) * 2_000_000
    assert len(merge_stamps([a, a + 900])) == 5
    assert len(merge_stamps([a, a + 1_100])) == 10
    assert len(merge_stamps([a, a + 1_100], shared_row_ns=2_000)) == 5


@pytest.mark.parametrize('seed', range(10))
def test_hold_is_the_last_sample_before(seed):
    rng = np.random.default_rng(seed)
    stamps = np.unique(rng.integers(0, 10**6, 40)) * 10_000
    values = rng.standard_normal(len(stamps))
    rows = merge_stamps([stamps, rng.integers(0, 10**6, 100) * 10_000])
    held = hold(stamps, values, rows)
    for row, value in zip(rows, held, strict=True):
        before = np.flatnonzero(stamps <= row)
        assert np.isnan(value) if not len(before) else value == values[before[-1]]
