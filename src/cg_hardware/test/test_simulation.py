"""Settings, note and pace of the simulated machine, without ROS."""

import hashlib

import pytest
import yaml

from cg_description.paths import model_path
from cg_dynamics.rig import Setup
from cg_hardware.simulation import (
    Pace,
    SimulationSettings,
    check_fall_angle,
    read_setup,
    recording_note,
    ticks_of,
)

MS = 1_000_000


def test_note_holds_what_an_analysis_needs():
    settings = SimulationSettings(experiment='e', initial_state=(0.1, 0.0, 0.2, 0.0))
    setup = Setup.from_dict({'stance': 'outer'})
    text = recording_note(settings, 'compass_gait', setup, ['imu_angle', 'imu_rate'], 'now')
    note = yaml.safe_load(text)
    assert note['format'] == 'cg_recording/1'
    assert note['mechanism'] == 'compass_gait'
    assert Setup.from_dict(note['setup']) == setup
    assert note['nominal_rate_hz'] == 500.0
    assert note['sensor_zeros'] == {'imu_angle': 0.0}
    assert note['initial_state'] == 'moving'
    file = model_path('compass_gait_mit')
    assert note['model_file'] == file.name
    assert note['model_sha256'] == hashlib.sha256(file.read_bytes()).hexdigest()


def test_a_start_without_rates_is_at_rest():
    settings = SimulationSettings(initial_state=(0.1, 0.0, 0.0, 0.0))
    note = yaml.safe_load(recording_note(settings, 'compass_gait', Setup(), [], ''))
    assert note['initial_state'] == 'rest'


def test_setup_is_read_from_text_and_from_a_file(tmp_path):
    file = tmp_path / 'setup.yaml'
    file.write_text('stance: outer\n')
    assert read_setup('stance: outer') == read_setup(str(file)) == Setup(stance='outer')
    assert read_setup('') == Setup()


@pytest.mark.parametrize(
    ('text', 'message'),
    [('/no/such/file', 'cannot be read'), ('stance: [', 'not YAML'), ('stance: both', 'stance')],
)
def test_a_wrong_setup_is_refused_with_its_reason(text, message):
    with pytest.raises(ValueError, match=message):
        read_setup(text)


@pytest.mark.parametrize(('duration', 'ticks'), [(0.0, None), (1.0, 500), (0.1, 50), (0.003, 2)])
def test_ticks_of_a_run(duration, ticks):
    assert ticks_of(duration, 500.0) == ticks


def test_pace_takes_samples_when_they_are_due_and_leaves_none_out():
    pace = Pace(500.0, start_ns=0)
    assert pace.take(0)
    assert not pace.take(1 * MS)
    assert pace.take(2 * MS)
    # Held up until 20 ms: those due at 4, 6, ... are taken one per ms until the clock is reached.
    taken = [ms for ms in range(20, 60) if pace.take(ms * MS)]
    assert taken == [*range(20, 37), *range(38, 60, 2)]
    assert pace.worst_ns == 16 * MS
    assert pace.late == 14  # later than one period: those due at 4, 6, ... 30 ms


def test_pushes_hit_at_their_sample():
    settings = SimulationSettings(pushes=(0.1, 2.0, 0.5, -1.0))
    hits = {tick: settings.pushes_at(tick) for tick in range(500) if settings.pushes_at(tick)}
    assert hits == {50: 2.0, 250: -1.0}
    with pytest.raises(ValueError, match='pushes has 3 numbers'):
        SimulationSettings(pushes=(0.1, 2.0, 0.5))


def test_a_fall_angle_needs_a_leg_that_can_lean():
    settings = SimulationSettings(fall_angle=0.6)
    check_fall_angle(settings, 'compass_gait', Setup())
    with pytest.raises(ValueError, match='with fixture legs_tied'):
        check_fall_angle(settings, 'compass_gait', Setup(fixture='legs_tied'))
    with pytest.raises(ValueError, match='this is a pendulum'):
        check_fall_angle(settings, 'pendulum', Setup())
