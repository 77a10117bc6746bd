"""diagnosis.json: what is documented is there, finite, and comes back."""

import json
import math
import re
from pathlib import Path

import numpy as np
import pytest

from cg_dynamics.model import Model
from cg_sysid.report import curves
from cg_sysid.report.diagnosis_file import plain, read_facts, write_facts
from cg_sysid.report.facts import interval, unusable_facts

DOCS = Path(__file__).parents[3] / 'docs/reference/diagnosis_json.md'


def documented(title):
    """Names in the first column of the table below a heading."""
    text = DOCS.read_text(encoding='utf-8').split(f'## {title}\n')[1].split('\n## ')[0]
    cells = [line.split('|')[1] for line in text.splitlines() if line.startswith('| `')]
    return {name for cell in cells for name in re.findall(r'`(\w+)`', cell)}


def numbers(value):
    if isinstance(value, dict):
        value = list(value.values())
    if isinstance(value, list):
        return [n for entry in value for n in numbers(entry)]
    return [value] if isinstance(value, float) else []


def test_it_comes_back_as_written(tmp_path, facts):
    write_facts(facts, tmp_path)
    assert read_facts(tmp_path) == facts


def test_all_numbers_are_finite(facts):
    assert len(numbers(facts)) > 100
    assert all(math.isfinite(n) for n in numbers(facts))


def test_the_top_level_is_documented(facts):
    assert documented('Top level') - {'method'} == set(facts)


@pytest.mark.parametrize(
    ('title', 'pick'),
    [
        ('causes', lambda f: f['causes'][0]),
        ('gain, for each output', lambda f: f['gain']['hip_angle']),
        ('ranking, for each round', lambda f: f['ranking'][0]['candidates'][0]),
        ('parameters', lambda f: f['parameters'][0]),
    ],
)
def test_every_field_is_documented(facts, title, pick):
    assert documented(title) == set(pick(facts))


@pytest.mark.parametrize('title', ['records', 'sources'])
def test_every_field_of_a_list_is_mentioned(facts, title):
    text = DOCS.read_text(encoding='utf-8').split(f'## {title}\n')[1].split('\n## ')[0]
    assert set(facts[title][0]) <= set(re.findall(r'`(\w+)`', text))


def test_the_hidden_bias_is_named_with_its_uncertainty(facts):
    assert facts['verdict'] == 'explained'
    (cause,) = facts['causes']
    bias = cause['parameters']['bias']
    assert (cause['name'], bias['unit']) == ('torque_bias', 'N m')
    low, high = bias['interval95']
    assert low < bias['value'] < high
    # Both records swing slowly: the lumps take up a little of the bias.
    assert bias['value'] == pytest.approx(0.8, rel=0.1)


def test_the_roles_of_the_records(facts):
    assert sorted(r['role'] for r in facts['records']) == ['held', 'train']


def test_what_is_not_a_number_becomes_null():
    value = {'a': np.array([1.0, np.nan, np.inf]), 'b': (np.int64(2), np.bool_(True))}
    assert plain(value) == {'a': [1.0, None, None], 'b': [2, True]}
    json.dumps(plain(value), allow_nan=False)


def test_the_interval_of_a_logarithmic_parameter_stays_positive():
    low, high = interval(10.0, 20.0, logarithmic=True)
    assert low > 0
    assert low * high == pytest.approx(100.0)
    assert interval(1.0, math.inf) is None


def test_unusable_facts_have_the_same_fields(facts, loaded, model_file):
    made = unusable_facts(Model.load(model_file), loaded, 'broken', facts['provenance'])
    assert set(made) == set(facts)
    json.dumps(made, allow_nan=False)


@pytest.mark.parametrize(
    ('text', 'error'),
    [
        ('{"format": "cg_diagnosis/9"}', "format: 'cg_diagnosis/9' is not cg_diagnosis/1"),
        ('{"format": ', 'not JSON: line 1, column 12'),
        ('[]', 'an empty list is no mapping; a mapping with format is needed'),
    ],
)
def test_a_wrong_file_is_refused(tmp_path, text, error):
    (tmp_path / 'diagnosis.json').write_text(text)
    with pytest.raises(ValueError, match=r'diagnosis\.json') as caught:
        read_facts(tmp_path)
    assert error in str(caught.value)


def test_curves_come_back(tmp_path, lines):
    curves.save(lines, tmp_path)
    back, faults = curves.load(tmp_path)
    assert faults == []
    assert [(c.name, c.role) for c in back] == [(c.name, c.role) for c in lines]
    np.testing.assert_array_equal(back[0].time, lines[0].time)
    np.testing.assert_allclose(back[0].after, lines[0].after, rtol=1e-6, atol=1e-7)


def test_a_file_that_holds_no_curves_is_refused(tmp_path):
    (tmp_path / curves.FILE_NAME).write_bytes(b'no zip file')
    with pytest.raises(ValueError, match=r'curves\.npz: not a file of curves'):
        curves.load(tmp_path)
