"""Experiments without ROS: an ordinary recording, and errors in one line."""

import numpy as np
import pytest

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_sysid.checks.recordings import check_recording
from cg_sysid.cli.command import main
from cg_sysid.records.bags import read_bag


def test_a_rehearsal_is_a_recording_that_passes_every_check(tmp_path, capsys):
    words = ['rehearse', 'swing_inner_fixed', '--duration', '2', '--out', str(tmp_path)]
    assert main([*words, '--seed', '3']) == 0
    bag = tmp_path / 'swing_inner_fixed_seed3'
    assert capsys.readouterr().out == f'{bag}: 1000 rows, 2.00 s, simulated\n'
    report = check_recording(bag, model_path('compass_gait_mit'))
    assert report.verdict == 'good'
    assert not [f for f in report.findings if f.code == 'metadata_missing']
    record = read_bag(bag)
    assert set(record.outputs) == set(Model.load('compass_gait_mit').mechanism.outputs)
    assert record.note['model_file'] == 'compass_gait_mit.yaml'
    assert main([*words, '--seed', '4']) == 0
    other = read_bag(tmp_path / 'swing_inner_fixed_seed4')
    assert not np.array_equal(record.inputs['hip_torque'], other.inputs['hip_torque'])


@pytest.mark.parametrize(
    ('words', 'said'),
    [
        (['none'], "no experiment 'none'; there are: chirp, "),
        (['chirp', '--model', 'none'], "no model 'none': there is no file "),
        (['chirp', '--duration', '-1'], 'duration is -1.0; allowed is 0.0 or more s'),
        (['chirp', '--seed', '-1'], 'seed is -1; allowed is 0 or more'),
        (['spring_stabilised_inner', '--model', 'sydney_pendulum'], ''),
    ],
)
def test_what_cannot_be_rehearsed_is_one_line(words, said, tmp_path, capsys):
    assert main(['rehearse', *words, '--out', str(tmp_path / 'bags')]) == 2
    err = capsys.readouterr().err
    assert err.startswith(f'cg rehearse: error: {said}')
    assert err.count('\n') == 1
    assert not (tmp_path / 'bags').exists()


def test_recordings_are_never_overwritten(tmp_path, capsys):
    (tmp_path / 'chirp_seed1').mkdir()
    assert main(['rehearse', 'chirp', '--out', str(tmp_path)]) == 2
    assert 'never overwritten' in capsys.readouterr().err
