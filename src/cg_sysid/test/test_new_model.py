"""A model file to start from loads, simulates and explains itself; its reference is up to date."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from cg_dynamics.effects import LIBRARY
from cg_dynamics.mechanisms import MECHANISMS
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup
from cg_sysid.cli.new_model import example_of, main, template

ROOT = Path(__file__).resolve().parents[3]


@pytest.mark.parametrize('name', MECHANISMS)
def test_template_loads_and_simulates(name):
    model = Model.from_text(template(name), name)
    example = example_of(model.mechanism)
    assert model.values == example.values
    assert model.sensors.keys() == set(model.mechanism.outputs)
    plants = [Plant(m, Setup(), sample_time=0.002, seed=1) for m in (model, example)]
    for _ in range(50):
        for plant in plants:
            plant.latch(np.full(len(model.mechanism.inputs), 0.01))
            plant.advance()
    np.testing.assert_array_equal(plants[0].state, plants[1].state)
    assert np.any(plants[0].state != 0.0)


@pytest.mark.parametrize('name', MECHANISMS)
def test_template_explains_every_parameter_and_names_every_effect(name):
    text, body = template(name), MECHANISMS[name]
    for p in body.parameters:
        assert f'# {p.description}; {p.lower:g} to {p.upper:g} {p.unit}' in text
    for effect in LIBRARY.values():
        assert (f'- name: {effect.name} ' in text) == bool(effect.sites(body)), effect.name
    assert max(map(len, text.splitlines())) < 120


@pytest.mark.parametrize('name', MECHANISMS)
def test_what_is_commented_out_is_right_once_it_is_filled_in(name):
    lines = template(name).split('\n')
    filled = [
        line.replace('# ', '', 1).replace('value: ...', 'value: 0.5')
        if 'value: ...' in line or line.startswith('# - name: ')
        else line
        for line in lines
    ]
    model = Model.from_text('\n'.join(filled), name)
    assert {e.name for e in model.effects} == {
        n for n, effect in LIBRARY.items() if effect.sites(model.mechanism)
    }
    for channel in model.mechanism.outputs:
        assert set(model.sensors[channel]) == {'noise', 'resolution'}
    assert all('limit' in model.actuators[channel] for channel in model.mechanism.inputs)


def test_command_line_writes_it_or_says_what_there_is(capsys):
    assert main(['pendulum']) == 0
    assert capsys.readouterr().out == template('pendulum')
    assert main(['unicycle']) == 2
    said = capsys.readouterr()
    assert said.out == ''
    assert 'unicycle' in said.err
    assert 'compass_gait, double_pendulum, pendulum' in said.err


def test_reference_is_up_to_date():
    tool = ROOT / 'tools' / 'make_model_file_doc.py'
    if not tool.exists():
        pytest.skip('the page and its tool come with the sources of the workspace')
    spec = importlib.util.spec_from_file_location('make_model_file_doc', tool)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    message = 'run python tools/make_model_file_doc.py'
    assert module.TARGET.read_text(encoding='utf-8') == module.page(), message
