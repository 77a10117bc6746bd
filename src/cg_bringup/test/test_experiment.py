"""Experiments on the live system: complete bags, the same at any machine load."""

import subprocess
import sys

import pytest
import yaml
from rosbags.highlevel import AnyReader

pytest.importorskip('rclpy')

from cg_bringup.experiment import main, run_experiment
from cg_bringup.runs import Run
from cg_interfaces.domains import own_domain
from cg_sysid.experiments.catalogue import ExperimentError, load_experiment

SENSORS = ('/imu', '/hip_encoder', '/foot_contact/inner', '/foot_contact/outer')


@pytest.fixture(autouse=True)
def domain():
    with own_domain() as number:
        yield number


def content(bag):
    with AnyReader([bag]) as reader:
        return [(c.topic, t, bytes(data)) for c, t, data in reader.messages()]


def burn():
    return [subprocess.Popen([sys.executable, '-c', 'while True: pass']) for _ in range(4)]


def test_lockstep_bag_is_complete_and_the_same_at_any_load(tmp_path):
    bags = []
    for name, load in (('quiet', list), ('busy', burn)):
        burners = load()
        try:
            recorded = run_experiment(
                Run(
                    load_experiment('spring_stabilised_inner'),
                    tmp_path / name / 'bag',
                    seed=3,
                    duration=1.0,
                )
            )
        finally:
            for burner in burners:
                burner.kill()
                burner.wait()
        assert recorded.counts == {
            '/experiment': 1,
            '/applied_torque': 500,
            '/torque_command': 500,
            **dict.fromkeys(SENSORS, 500),
        }
        bags.append(recorded.path)
    assert content(bags[0]) == content(bags[1])
    first, second = ((bag / 'bag.mcap').read_bytes() for bag in bags)
    assert first == second


def test_other_seed_other_record(tmp_path):
    experiment = load_experiment('swing_outer_fixed')
    contents = [
        content(run_experiment(Run(experiment, tmp_path / str(s), seed=s, duration=0.5)).path)
        for s in (1, 2)
    ]
    assert contents[0] != contents[1]


def test_real_time_bag_is_complete(tmp_path):
    run = Run(load_experiment('legs_tied'), tmp_path / 'bag', mode='real_time', duration=1.0)
    counts = run_experiment(run).counts
    assert all(counts[topic] == 500 for topic in ('/applied_torque', *SENSORS))


def test_the_note_names_set_up_and_model(tmp_path):
    run = Run(load_experiment('spring_stabilised_outer'), tmp_path / 'bag', duration=0.5)
    with AnyReader([run_experiment(run).path]) as reader:
        ((connection, _, data),) = [m for m in reader.messages() if m[0].topic == '/experiment']
        note = yaml.safe_load(reader.deserialize(data, connection.msgtype).data)
    assert note['experiment'] == 'spring_stabilised_outer'
    assert note['setup'] == run.experiment.setup.to_dict()
    assert note['initial_state'] == 'moving'
    assert note['model_file'] == 'compass_gait_mit.yaml'


def test_a_node_that_fails_is_reported_with_its_words(tmp_path):
    model = tmp_path / 'model.yaml'
    experiment = load_experiment('legs_tied')
    wrong = Run(
        type(experiment)(
            experiment.name, experiment.setup, (0.1, 0.2, 0.3), 1.0, experiment.excitation
        ),
        tmp_path / 'bag',
    )
    with pytest.raises(ExperimentError, match='initial_state needs 2 numbers'):
        run_experiment(wrong)
    assert not wrong.bag.exists()
    with pytest.raises(ValueError, match=r"no model '.*model\.yaml': there is no file"):
        run_experiment(Run(experiment, wrong.bag, model_file=model))


def test_recordings_are_never_overwritten(tmp_path, capsys):
    (tmp_path / 'chirp_seed1').mkdir()
    assert main(['chirp', '--out', str(tmp_path)]) == 1
    assert 'never overwritten' in capsys.readouterr().err
