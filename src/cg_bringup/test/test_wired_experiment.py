"""An experiment on a real robot, on one in memory: its note, its torque, and what ends it."""

import hashlib
from pathlib import Path

import numpy as np
import pytest
import yaml
from robot_in_memory import RobotInMemory

from cg_bringup import experiment, operating
from cg_bringup.robot_run import RobotOptions, robot_nodes
from cg_bringup.runs import WIRED, Run, experiment_nodes
from cg_bringup.wired_experiment import EXPERIMENTER, WiredExperiment, carry_out, pose_in_words
from cg_description.paths import model_path
from cg_hardware.checklist.robot import Refused
from cg_interfaces import topics
from cg_sysid.experiments.catalogue import ExperimentError, experiment_names, load_experiment
from cg_sysid.experiments.synthetic import Synthesis, synthesise
from cg_sysid.records.alignment import to_record
from cg_sysid.records.bag_writer import write_bag
from cg_sysid.records.bags import parse_note

MODEL = model_path('compass_gait_mit')


class Recorded(RobotInMemory):
    """A robot in memory, and what is announced and torqued."""

    def __init__(self):
        super().__init__()
        self.notes, self.emulated, self.torques = [], False, []

    def announce(self, note):
        self.notes.append(parse_note(note, 'note'))

    def await_recorder(self, patience):
        assert self.notes

    def find_hands(self):
        pass

    def listen(self, *args, **how):
        heard = super().listen(*args, **how)
        self.torques += list(heard['applied'].values)
        return heard


def what(name='swing_inner_fixed', folder=Path('nowhere'), duration=3.0):
    return WiredExperiment(load_experiment(name), duration, 2, MODEL, folder)


def test_the_robot_is_excited_and_left_at_rest():
    robot = Recorded()
    carry_out(robot, what())
    assert np.abs(robot.torques).max() > 3.0
    assert not robot.enabled
    assert not robot.gate.passes
    assert 'fall_angle' in robot.changed


def test_the_note_says_what_a_diagnosis_asks_for(tmp_path):
    robot = Recorded()
    settings = operating.TaskSettings(
        steps=('rates', 'torque', 'stop_topic'), checklists=str(tmp_path), go_on=True
    )
    assert operating.go_through(robot, settings) == 0
    carry_out(robot, what(folder=tmp_path))
    (note,) = robot.notes
    assert note['setup']['fixture'] == 'inner_fixed'
    assert (note['initial_state'], note['nominal_rate_hz']) == ('rest', 500.0)
    assert note['zeroed_at'] == '2026-03-04T10:00:00Z'
    assert note['sensor_zeros'] == {'imu_angle': 0.01, 'hip_angle': 0.0}
    assert note['model_file'] == MODEL.name
    assert note['model_sha256'] == hashlib.sha256(MODEL.read_bytes()).hexdigest()
    checklist = note['checklist']
    (file,) = tmp_path.glob('checklist_*.yaml')
    assert checklist['file'] == file.name
    assert checklist['sha256'] == hashlib.sha256(file.read_bytes()).hexdigest()
    assert (checklist['passed'], checklist['of']) == (3, 3)


def test_without_a_checklist_the_note_says_so():
    robot = Recorded()
    carry_out(robot, what())
    assert robot.notes[0]['checklist'] == {}


def test_a_sensor_that_nobody_zeroed_is_refused_before_anything_is_announced():
    robot = Recorded()
    robot.zeroed_at = ''
    with pytest.raises(Refused, match='call /drive/zero'):
        carry_out(robot, what())
    assert robot.notes == []


def test_legs_that_move_are_waited_for(monkeypatch):
    monkeypatch.setattr('cg_bringup.wired_experiment.PATIENCE', 3.0)
    robot = Recorded()
    robot.lean_to = 10.0  # somebody leans them on and on
    with pytest.raises(Refused, match='do not come to rest'):
        carry_out(robot, what())
    assert not robot.enabled


def test_a_fault_ends_it_and_is_told():
    robot = Recorded()
    robot.orders = [(6.0, 'imu_unplug')]
    with pytest.raises(Refused, match='ended early: the gate says fault: imu not heard'):
        carry_out(robot, what(duration=10.0))
    assert not robot.enabled


def test_a_drive_that_gives_up_ends_it(monkeypatch):
    robot = Recorded()
    step = robot.step

    def drops():
        step()
        robot.enabled = robot.enabled and robot.tick < 3500

    monkeypatch.setattr(robot, 'step', drops)
    with pytest.raises(Refused, match='last heard, silent'):
        carry_out(robot, what(duration=10.0))


def test_free_motion_needs_no_torque():
    robot = Recorded()
    carry_out(robot, what('spring_calibration', duration=1.0))
    assert set(robot.torques) == {0.0}
    assert robot.rests == 0
    assert any('let go' in text for text in robot.said)
    assert robot.notes[0]['initial_state'] == 'unknown'


@pytest.mark.parametrize('name', experiment_names())
def test_every_experiment_can_be_asked_for_in_words(name):
    words = ' '.join(pose_in_words(load_experiment(name)))
    fixture = load_experiment(name).setup.fixture
    assert ('clamped' in words) == fixture.endswith('fixed')
    assert ('spring' in words) == bool(load_experiment(name).setup.springs)


def test_the_wired_robot_is_a_machine_like_the_simulated_one(tmp_path):
    run = Run(load_experiment('chirp'), tmp_path / 'bag', MODEL, seed=4, mode=WIRED)
    nodes = experiment_nodes(run)
    assert list(nodes) == ['experimenter', 'recorder']
    told = operating.TaskSettings(
        **{k: v for k, v in nodes['experimenter'].parameters.items() if k != 'yes'}
    )
    assert (told.task, told.seed, told.duration) == ('experiment', 4, run.length)
    assert load_experiment(told.experiment) == run.experiment
    with pytest.raises(ExperimentError, match='lockstep, real_time, wired'):
        Run(load_experiment('chirp'), tmp_path / 'bag', mode='simulated')


def test_another_rate_leaves_the_torque_as_short_a_time():
    for rate in (500.0, 250.0):
        nodes = robot_nodes(RobotOptions(rate=rate))
        told = {name: nodes[name].parameters['sample_rate_hz'] for name in nodes if name != 'imu'}
        assert {nodes['imu'].parameters['rate_hz'], *told.values()} == {rate}
        stale = nodes['drive'].parameters['stale_after']
        assert 2 / rate < stale <= 0.02 - 1 / rate
    with pytest.raises(ValueError, match='rate is 50 Hz; allowed is 200 to 1000'):
        robot_nodes(RobotOptions(rate=50.0))


@pytest.mark.parametrize(('rate', 'complete'), [(250.0, True), (500.0, True), (200.0, False)])
def test_samples_are_counted_by_the_rate_that_the_robot_ran_at(tmp_path, rate, complete):
    run = Run(load_experiment('chirp'), tmp_path / 'bag', mode=WIRED, duration=2.0)
    raw = synthesise(Synthesis(duration=2.0, rate=rate), seed=3)
    if not complete:
        raw.note['nominal_rate_hz'] = 250.0
    write_bag(run.bag, to_record(raw))
    if complete:
        assert experiment.check_counts(run)[topics.IMU] == 2 * rate
        return
    with pytest.raises(ExperimentError, match=r'400 messages of .*, expected 475'):
        experiment.check_counts(run)


def test_the_person_hears_the_operator_and_not_the_log(tmp_path, capsys):
    with open(tmp_path / 'log', 'w+') as log:
        relay = experiment._relaying(log, lambda: None)
        log.write('[INFO] nodes say much\n')
        log.write(f'{EXPERIMENTER}let go of the legs now\n{EXPERIMENTER}half')
        log.flush()
        relay()
        log.write(' a line\n')
        log.flush()
        relay()
    assert capsys.readouterr().out == 'let go of the legs now\nhalf a line\n'


@pytest.mark.parametrize(
    ('heard', 'kept'),
    [
        ((topics.EXPERIMENT, topics.IMU), True),
        ((topics.IMU,), False),
        ((topics.EXPERIMENT,), False),
    ],
)
def test_a_bag_without_an_experiment_or_a_sample_is_not_kept(tmp_path, heard, kept):
    bag = tmp_path / 'bag'
    bag.mkdir()
    counts = [
        {'topic_metadata': {'name': name}, 'message_count': int(name in heard)}
        for name in (topics.EXPERIMENT, topics.IMU)
    ]
    tree = {'rosbag2_bagfile_information': {'topics_with_message_count': counts}}
    (bag / 'metadata.yaml').write_text(yaml.safe_dump(tree), encoding='utf-8')
    experiment._forget_empty(bag)
    assert bag.exists() == kept


def test_nobody_answers_for_the_pose(monkeypatch, tmp_path):
    run = Run(load_experiment('chirp'), tmp_path / 'bag', mode=WIRED)
    monkeypatch.setattr('sys.stdin', open('/dev/null', encoding='utf-8'))
    with pytest.raises(ExperimentError, match='--yes'):
        experiment.ask_for_pose(run, yes=False)
    experiment.ask_for_pose(run, yes=True)
