"""Model files: form is checked, errors say what and where, files are written whole."""

import os
import stat

import pytest

from cg_description.model_file import (
    ModelFileError,
    Quantity,
    dump,
    load,
    parse,
    save,
    sha256,
    write_atomically,
)
from cg_description.paths import models_directory

MINIMAL = """
format: cg_model/1
name: thing
mechanism: pendulum
parameters:
  inertia: {value: 0.3, unit: kg m^2, tolerance: 0.1, fixed: true, source: scales}
"""


def test_parse_and_dump_are_inverse():
    file = parse(MINIMAL)
    assert file.parameters['inertia'] == Quantity(0.3, 'kg m^2', 0.1, True, 'scales')
    assert parse(dump(file)) == file


@pytest.mark.parametrize('path', sorted(models_directory().glob('*.yaml')), ids=lambda p: p.stem)
def test_models_that_come_along_read_back(path):
    file = load(path)
    assert parse(dump(file)) == file
    assert file.name == path.stem


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('[1, 2', 'here: not YAML'),
        ('just words', "here: 'just words' is no mapping; a mapping with format, name"),
        ('', 'here: nothing is there; a mapping with format'),
        ('format: other/1', "here: format: 'other/1' is not cg_model/1"),
        ('a: 1', 'here: format: is missing; cg_model/1 is needed'),
        ('format: cg_model/1', 'name: is missing'),
        (MINIMAL.replace('mechanism: pendulum\n', ''), 'mechanism: is missing'),
        (MINIMAL + 'colour: red\n', "unknown entry 'colour'; allowed"),
        (MINIMAL + 'efects: []\n', "unknown entry 'efects'; .*did you mean 'effects'"),
        (MINIMAL.replace('unit: kg m^2, ', ''), r'parameters.inertia.unit: is missing'),
        (MINIMAL.replace('0.3', 'heavy'), "inertia.value: 'heavy' is no number"),
        (MINIMAL.replace('0.3', "'0.3'"), "inertia.value: '0.3' is no number; numbers have no qu"),
        (MINIMAL.replace('0.3', 'true'), 'inertia.value: true is no number'),
        (MINIMAL.replace('0.3', '.nan'), 'nan is not allowed; a number is needed'),
        (MINIMAL.replace('0.3', '9' * 400), "inertia.value: '9999.*…' is no number"),
        (MINIMAL.replace('tolerance', 'sigma'), "unknown entry 'sigma'; allowed: value, unit"),
        (MINIMAL.replace('0.1', '.inf'), 'tolerance: inf is not allowed'),
        (MINIMAL.replace('0.1', '-0.1'), 'tolerance: -0.1 is not allowed; a number of 0 or more'),
        (MINIMAL.replace('true', 'maybe'), "inertia.fixed: 'maybe' is neither true nor false"),
        (MINIMAL.replace('thing', '[a, b]'), 'name: a list of 2 is no text'),
        (MINIMAL.replace('thing', '1.10'), 'name: 1.1 is no text; write it in quotes'),
        (MINIMAL + 'effects: [payload]', r"effects\[0\]: 'payload' is no mapping; a mapping"),
        (MINIMAL + 'effects: [{name: a, where: b}]', "effects.0.: unknown entry 'where'"),
        (MINIMAL + 'sensors: {angle: 3}', 'sensors.angle: 3 is no mapping'),
        (
            MINIMAL + 'effects: [{name: a}, {name: b, parameters: {mass: {value: abc, unit: 1}}}]',
            r"here: effects\[1\].parameters.mass.value: 'abc' is no number; a number is needed$",
        ),
    ],
)
def test_wrong_form_is_named(text, message):
    with pytest.raises(ModelFileError, match=message):
        parse(text, 'here')


def test_infinite_values_are_allowed_where_they_mean_rigid():
    assert parse(MINIMAL.replace('0.3', '.inf')).parameters['inertia'].value == float('inf')


def test_exponents_need_neither_point_nor_sign():
    """YAML 1.1 takes 3e-1 for text."""
    for text in ('3e-1', '30E-2', '0.03e1', '+3.0e-1'):
        assert parse(MINIMAL.replace('0.3', text)).parameters['inertia'].value == 0.3


def test_missing_file_is_named(tmp_path):
    with pytest.raises(ModelFileError, match=r'none\.yaml: cannot be read: No such file'):
        load(tmp_path / 'none.yaml')


def test_file_is_whole_or_not_there(tmp_path, monkeypatch):
    path = tmp_path / 'model.yaml'
    save(parse(MINIMAL), path)
    before = path.read_text()

    def fail(*_):
        raise OSError('disk full')

    monkeypatch.setattr(os, 'fsync', fail)
    with pytest.raises(OSError, match='disk full'):
        write_atomically(path, 'half of it')
    assert path.read_text() == before
    assert list(tmp_path.iterdir()) == [path]


def test_file_is_as_readable_as_its_neighbours(tmp_path):
    path, neighbour = tmp_path / 'a.yaml', tmp_path / 'b.yaml'
    write_atomically(path, 'text')
    neighbour.write_text('text')
    assert stat.S_IMODE(path.stat().st_mode) == stat.S_IMODE(neighbour.stat().st_mode)


def test_hash_is_that_of_the_text():
    assert sha256('') == 'e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855'
