"""The demonstration from end to end: hide, record on the live system, diagnose, reveal."""

import json

import pytest
from rich.console import Console

pytest.importorskip('rclpy')

from cg_bringup.demo import PROGRAMME, main, run_demo

# What comes nearest; bench/evidence.py tries the whole library.
RIVALS = 'torque_constant,torque_bias,actuator_delay,encoder_scale'


@pytest.mark.slow
@pytest.mark.parametrize(
    ('candidates', 'duration'),
    [(RIVALS, 3.0), pytest.param('', 6.0, marks=pytest.mark.evidence)],
    ids=['rivals', 'library'],
)
def test_a_hidden_torque_constant_is_found(candidates, duration, tmp_path):
    console = Console(record=True, width=120)
    found = run_demo('torque_constant', 1, tmp_path / 'demo', duration, console, candidates)
    assert found['verdict'] in ('explained', 'ambiguous')
    # An ambiguous answer names the truth among its causes or their rivals.
    assert 'torque_constant' in json.dumps(found['causes'])
    for name in ('report.html', 'model.yaml', 'diagnosis.json', 'hidden_machine.yaml'):
        assert (tmp_path / 'demo' / name).is_file()
    assert len(list((tmp_path / 'demo' / 'bags').iterdir())) == len(PROGRAMME)
    said = console.export_text()
    assert said.index('Diagnosing') < said.index('What had been hidden')


def test_an_unknown_effect_is_refused_before_anything_is_recorded(tmp_path, capsys):
    out = tmp_path / 'demo'
    assert main(['--effect', 'gremlins', '--seed', '1', '--out', str(out)]) == 1
    assert "no effect 'gremlins' to hide" in ' '.join(capsys.readouterr().out.split())
    assert not out.exists()


def test_results_are_never_overwritten(tmp_path, capsys):
    (tmp_path / 'old').write_text('result')
    assert main(['--seed', '1', '--out', str(tmp_path)]) == 1
    assert 'is not empty' in ' '.join(capsys.readouterr().out.split())
