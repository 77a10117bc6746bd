"""A number that differs from recording to recording is found, and not taken for something else."""

import math
from dataclasses import replace

import numpy as np
import pytest
from test_diagnosis_file import documented

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_sysid.checks.loading import Loaded
from cg_sysid.diagnosis.by_recording import numbers_of, with_own
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.identification.unknowns import own_unknowns
from cg_sysid.report.facts import diagnosis_facts

SETUP = Setup(springs=tuple(Spring('inner', 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3)))
EFFECTS = 'ground_slope', 'quadratic_friction', 'external_push'


@pytest.fixture
def nominal(model_file):
    return Model.load(model_file)


def _session(machines):
    return [
        rehearse(
            f'take_{k}', machine, SETUP, [0.1 - 0.05 * k, -0.1, 0.3, -0.5],
            [lambda t, k=k: 8.0 * math.sin(2 * math.pi * (0.4 + 0.1 * k + 0.15 * t) * t)],
            4.0, 0.004, k,
        )
        for k, machine in enumerate(machines)
    ]  # fmt: skip


@pytest.mark.evidence
def test_grease_that_warms_over_a_session_is_seen(nominal):
    levels = [2.6, 2.3, 2.05, 1.9]
    warm = [nominal.with_values({'coulomb_friction.torque': level}) for level in levels]
    records = _session(warm)
    found = diagnose(nominal, records, Options(effects=EFFECTS, workers=1))
    # A push in every record would take the edge off.
    assert (found.verdict, found.causes) == ('unexplained', ())
    assert found.wandering.name == 'coulomb_friction.torque'
    for level, (value, sigma) in zip(levels, found.wandering.values.values(), strict=True):
        assert abs(value - level) < 4 * sigma + 0.01 * level
    assert found.wandering.explained > 0.99
    assert 'falling in the order of their names' in found.summary
    loaded = Loaded(tuple(records), (), {r.name: r.name for r in records})
    told = diagnosis_facts(found, loaded, {})['wandering']
    assert set(told) == documented('wandering')
    assert {r: v['value'] for r, v in told['values'].items()} == {
        r: value for r, (value, _) in found.wandering.values.items()
    }


@pytest.mark.parametrize('goes_on', [True, pytest.param(False, marks=pytest.mark.evidence)])
def test_grease_that_goes_on_warming_is_told_from_grease_that_warms_anew(nominal, goes_on):
    excess, time_constant, every = 0.8, 9.0, 8.0
    begins = every * np.arange(4)
    warm = [
        nominal.with_effect(
            'friction_drift',
            excess=excess * math.exp(-begin / time_constant) if goes_on else excess,
            time_constant=time_constant,
        )
        for begin in begins
    ]
    records = [
        replace(record, stamp_ns=record.stamp_ns + round(begin * 1e9))
        for record, begin in zip(_session(warm), begins, strict=True)
    ]
    options = Options(effects=(*EFFECTS, 'friction_drift', 'coulomb_friction'), workers=1)
    found = diagnose(nominal, records, options)
    (cause,) = found.causes
    assert (found.verdict, cause.label) == ('explained', 'friction_drift'), found.summary
    assert found.wandering is None
    chosen = cause.parameters.pop('whole_session', (0.0, 0.0, '1'))
    assert chosen == (float(goes_on), 0.0, '1')
    assert found.extended.model.values['friction_drift.whole_session'] == goes_on
    for name, true in {'excess': excess, 'time_constant': time_constant}.items():
        value, sigma, _ = cause.parameters[name]
        assert abs(value - true) < 4 * sigma < 0.4 * true


@pytest.mark.evidence
def test_a_robot_set_down_anew_each_time_stands_on_another_slope(nominal):
    slopes = [0.01, -0.012, 0.02, -0.005]
    moved = [nominal.with_effect('ground_slope', angle=slope) for slope in slopes]
    found = diagnose(nominal, _session(moved), Options(effects=EFFECTS, workers=1))
    assert found.wandering.name == 'ground_slope.angle', found.summary
    for slope, (value, sigma) in zip(slopes, found.wandering.values.values(), strict=True):
        assert abs(value - slope) < 4 * sigma
    assert found.wandering.explained > 0.99


def test_what_is_wrong_with_the_machine_does_not_wander(nominal):
    machine = nominal.with_effect('stribeck_friction', torque=0.8, stribeck_rate=0.4)
    found = diagnose(nominal, _session([machine] * 4), Options(effects=EFFECTS[:1], workers=1))
    assert found.verdict == 'unexplained'
    assert found.wandering is None, found.wandering


def test_every_number_of_the_library_can_be_asked_for(nominal):
    data_sets = prepare(nominal, _session([nominal] * 2))
    asked = list(numbers_of(nominal, data_sets, None))
    assert len(asked) > 15
    for name, at in asked:
        model = with_own(nominal, name, at, nominal)
        (own,) = own_unknowns(model)
        assert own.each == 'recording'
        assert own.name.partition('.')[0].partition('@')[0] == name
        fit(model, data_sets, iterations=1, horizon=0.5)
