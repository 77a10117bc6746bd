"""A machine with a joint that slides: identified, diagnosed and reported in its own units."""

import re

import numpy as np
import pytest
from cart_pole import FILE, cart, install

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.checks.loading import load_bags
from cg_sysid.checks.recordings import check_recording
from cg_sysid.cli.diagnose import diagnosis_curves
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.provenance import provenance
from cg_sysid.records.bag_writer import write_bag
from cg_sysid.report import render
from cg_sysid.report.facts import diagnosis_facts
from cg_sysid.report.signals import payload


@pytest.fixture
def bags(monkeypatch, tmp_path):
    """Two bags of a cart that rubs with the square of its rate as well."""
    install(monkeypatch)
    machine = cart().with_effect('quadratic_friction', coefficient=1.5)
    return [
        write_bag(tmp_path / f'ride_{k}', rehearse(
            f'ride_{k}', machine, Setup(), [0.0, 0.1, 0.0, 0.0],
            [lambda t, k=k: 6.0 * np.sin((2.0 + k) * t) + 3.0 * np.sin(7.0 * t)],
            3.0, 0.004, k,
        ))
        for k in (1, 2)
    ]  # fmt: skip


def test_friction_of_a_rail_is_identified_in_its_unit(bags, tmp_path):
    (tmp_path / 'cart.yaml').write_text(FILE)
    records = load_bags(bags, tmp_path / 'cart.yaml').records
    model = cart().with_effect('quadratic_friction', coefficient=0.1)
    data_sets = prepare(model, records)
    assert data_sets[0].sigma[0] == pytest.approx(1e-4, rel=0.3)
    found = fit(model, data_sets)
    names = [u.name for u in found.unknowns]
    index = names.index('quadratic_friction.coefficient')
    assert found.unknowns[index].unit == 'N s^2/m^2'
    # Within four of its standard deviations.
    assert abs(found.values[index] - 1.5) < 4 * np.sqrt(found.covariance[index, index]) < 0.4


def test_diagnosis_and_report_speak_of_metres_and_newtons(bags, tmp_path):
    path = tmp_path / 'cart.yaml'
    path.write_text(FILE)
    loaded = load_bags(bags, path)
    options = Options(effects=('quadratic_friction', 'torque_bias'), rounds=1, workers=1)
    found = diagnose(Model.load(path), loaded.records, options)
    made = provenance(path, ['diagnose', 'bags'], {}, '2011-03-13T07:00:00Z')
    facts = diagnosis_facts(found, loaded, made)
    assert facts['causes'][0]['name'] == 'quadratic_friction'
    assert facts['causes'][0]['parameters']['coefficient']['unit'] == 'N s^2/m^2'
    assert (facts['inputs'], facts['input_units']) == (['force'], ['N'])
    curves = diagnosis_curves(found)
    drawn = payload(facts, curves)
    assert drawn['input_units'] == ['N']
    assert [axis['unit'] for axis in drawn['states']['position']] == ['m', 'm/s', 'N']
    assert [axis['unit'] for axis in drawn['states']['angle']] == ['rad', 'rad/s', 'N']
    page = re.sub(r'<script.*?</script>', '', render(facts, curves), flags=re.S)
    assert 'N s²/m²' in page
    assert not re.search(r'N m\b', page)
    text = found.extended.model.text()
    assert 'N s^2/m^2' in text
    assert not re.search(r'N m\b', text)


def test_findings_of_the_check_are_in_the_units_of_the_rail(bags):
    report = check_recording(bags[0])
    (excited,) = (f for f in report.findings if f.code == 'excitation')
    assert re.search(r'rms [\d.]+ N, peak [\d.]+ N,', excited.message)
