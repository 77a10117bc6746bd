"""Trajectories: exact round trip, interpolation against a known motion, refusals that name why."""

import json

import numpy as np
import pytest

from cg_control.trajectories.trajectory import Phase, Trajectory, TrajectoryError
from cg_description.paths import model_path
from cg_dynamics.model import Model


def cubic(stance, times, offset):
    """A motion that cubic Hermite interpolation meets exactly."""
    powers = np.array([[1.0, t, t**2, t**3] for t in times])
    slopes = np.array([[0.0, 1.0, 2 * t, 3 * t**2] for t in times])
    mix = np.random.default_rng(1).normal(size=(4, 4)) + offset
    n = len(times)
    rng = np.random.default_rng(2)
    return Phase(
        stance, times, powers @ mix, slopes @ mix, np.linspace(1, 2, n),
        rng.normal(size=(n, 4)), rng.normal(size=(n, 4, 4)),
    )  # fmt: skip


@pytest.fixture
def model():
    return Model.load(model_path('compass_gait_mit'))


@pytest.fixture
def trajectory(model):
    phases = (
        cubic('inner', np.array([0.0, 0.1, 1 / 3]), 0.0),
        cubic('outer', np.array([1 / 3, 0.5, 0.9]), 1.0),
    )
    return Trajectory(phases, model.hash, {'cost': 0.1 + 0.2, 'solver': 'fatrop'})


def test_file_gives_back_every_bit(tmp_path, trajectory, model):
    path = tmp_path / 'step.json'
    trajectory.save(path)
    back = Trajectory.load(path, model)
    for a, b in zip(trajectory.phases, back.phases, strict=True):
        assert a.stance == b.stance
        for name in ('time', 'states', 'rates', 'torque', 'gains', 'cost_to_go', 'normals'):
            assert getattr(a, name).tobytes() == getattr(b, name).tobytes()
    assert back.provenance == trajectory.provenance
    assert back.model_hash == model.hash
    assert [p.name for p in tmp_path.iterdir()] == ['step.json']


def test_trajectory_of_another_model_is_refused(tmp_path, trajectory, model):
    other = model.with_values({'c1': 0.101})
    trajectory.save(tmp_path / 'step.json')
    with pytest.raises(TrajectoryError, match=f'{model.hash[:12]}.*{other.hash[:12]}'):
        Trajectory.load(tmp_path / 'step.json', other)


def test_interpolant_is_exact_on_a_cubic(trajectory):
    phase = trajectory.phases[0]
    mix = np.random.default_rng(1).normal(size=(4, 4))
    for t in (0.0, 0.04, 0.1, 0.27, 1 / 3):
        np.testing.assert_allclose(
            phase.at(t).state, np.array([1, t, t**2, t**3]) @ mix, atol=1e-14
        )
    assert phase.at(0.05).torque == pytest.approx(1.25, abs=1e-15)


def test_impact_belongs_to_the_phase_after_it(trajectory):
    assert trajectory.modes == ('inner', 'outer')
    assert trajectory.impact_times == (1 / 3,)
    np.testing.assert_array_equal(trajectory.at(1 / 3).state, trajectory.phases[1].states[0])
    np.testing.assert_array_equal(trajectory.at(9.0).state, trajectory.phases[1].states[-1])
    assert trajectory.duration == pytest.approx(0.9)


def test_arrays_cannot_be_written(trajectory):
    with pytest.raises(ValueError, match='read-only'):
        trajectory.phases[0].states[0, 0] = 1.0


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'stance': 'left'}, "'left'; allowed are inner, outer"),
        ({'time': np.array([0.0, 0.2, 0.1])}, 'increasing'),
        ({'torque': np.zeros(2)}, r'torque has shape \(2,\), expected \(3,\)'),
        ({'torque': np.array([0.0, np.nan, 0.0])}, 'torque must be finite'),
    ],
)
def test_bad_phases_are_refused(trajectory, change, message):
    phase = trajectory.phases[0]
    values = {name: getattr(phase, name) for name in ('stance', 'time', 'states', 'rates')}
    values |= {'torque': phase.torque} | change
    with pytest.raises(TrajectoryError, match=message):
        Phase(**values)


PHASE = {
    'stance': 'inner', 'time': [0.0, 1.0], 'torque': [0.0, 0.0],
    'states': [[0.0] * 4, [0.0] * 4], 'rates': [[0.0] * 4, [0.0] * 4],
}  # fmt: skip


def test_gap_between_phases_is_refused(trajectory):
    late = cubic('outer', np.array([0.4, 0.5, 0.9]), 1.0)
    with pytest.raises(TrajectoryError, match=r'next begins at 0\.4'):
        trajectory.with_phases((trajectory.phases[0], late))
    same = cubic('inner', np.array([1 / 3, 0.5]), 1.0)
    with pytest.raises(TrajectoryError, match="stays 'inner'"):
        trajectory.with_phases((trajectory.phases[0], same))


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('{', 'not JSON'),
        ('[]', 'json: an empty list is no mapping; a mapping with format, model_hash, phases'),
        ('{}', 'json: format: is missing; cg_trajectory/1 is needed'),
        ({'phases': [{'speed': 1}]}, r"phases\[0\]: unknown entry 'speed'; allowed: stance, time"),
        ({'model_hash': None}, 'model_hash: is missing'),
        ({'phases': []}, 'phases: an empty list; 1 or more entries are needed'),
        ({'phases': [{**PHASE, 'torque': [0, True]}]}, r'0\].torque\[1\]: true is no number'),
        ({'phases': [{**PHASE, 'states': [[0.0], [1.0, 2.0]]}]}, r'phases\[0\].states must be'),
        ({'phases': [{**PHASE, 'time': [1.0, 1.0]}]}, r'phases\[0\].time must hold at least two'),
        ({'phases': [{**PHASE, 'time': [0.0, float('inf')]}]}, r'time\[1\]: inf is not allowed'),
        ({'phases': [{**PHASE, 'rates': [[1.0], [1.0]]}]}, r'phases\[0\].rates has shape'),
        ({'provenance': {'slope': 'up'}}, "provenance.slope: 'up' is no number"),
        ({'provenance': {'at': [float('nan')]}}, r'provenance.at\[0\]: nan is not allowed'),
    ],
)
def test_bad_files_are_refused(tmp_path, text, message):
    path = tmp_path / 'bad.json'
    if isinstance(text, dict):
        whole = {'format': 'cg_trajectory/1', 'model_hash': 'abc', 'phases': [PHASE]}
        text = json.dumps({k: v for k, v in {**whole, **text}.items() if v is not None})
    path.write_text(text)
    with pytest.raises(TrajectoryError, match=message):
        Trajectory.load(path)
    with pytest.raises(TrajectoryError, match='No such file'):
        Trajectory.load(tmp_path / 'none.json')
