"""The answer in words."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.diagnosis.conclude import verdict_of
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Cause, Options
from cg_sysid.diagnosis.summary import summary_of
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.gain import Gain
from cg_sysid.search.ranking import contains


def test_a_ratio_is_printed_without_a_unit_and_a_torque_with_its_own():
    gain = Gain('hip_angle', 'rad', 1e-2, 1e-4, 1e-4)
    causes = [
        Cause('imu_scale', {'scale': (1.0216, 1e-3, '1')}, 100.0),
        Cause('torque_bias', {'torque': (0.8, 0.01, 'N m')}, 50.0),
    ]
    text = summary_of('explained', causes, (gain,), {})
    assert 'imu_scale (scale = 1.0216 \u00b1 0.0010)' in text
    assert 'torque_bias (torque = 0.800 \u00b1 0.010 N m)' in text


@pytest.mark.parametrize(
    ('rivals', 'left', 'share', 'verdict'),
    [
        (None, False, 0.0, 'consistent'),
        (None, True, 0.0, 'unexplained'),
        ((), False, 0.4, 'explained'),
        ((), True, 0.6, 'explained'),
        ((), True, 0.4, 'unexplained'),
        (('back_emf',), False, 1.0, 'ambiguous'),
        (('back_emf',), True, 0.4, 'unexplained'),
    ],
)
def test_what_takes_less_than_half_of_the_error_is_no_explanation(rivals, left, share, verdict):
    """In a whole diagnosis: test_unmodelled.py, among the evidence."""
    values = {'error': (-0.1, 0.02, '1')}
    causes = [] if rivals is None else [Cause('torque_constant', values, 50.0, rivals)]
    assert verdict_of(causes, left, share) == verdict
    gain = Gain('hip_angle', 'rad', 1e-2, 7e-3, 1e-4)
    remaining = {'hip_angle': 70.0} if left else {}
    text = summary_of(verdict, causes, (gain,), remaining, explained=share)
    assert ('may only stand in' in text) == bool(verdict == 'unexplained' and causes)
    assert ('No more than 40 % of the squared error' in text) == ('stand in' in text)


def test_a_record_that_holds_most_of_the_error_is_a_finding(model_file):
    nominal = Model.load(model_file)
    heavier = nominal.with_effect('payload', 'outer', mass=0.5, distance=0.5)
    records = [
        rehearse(f'swing {k}', heavier if k == 3 else nominal, Setup('inner', 'inner_fixed'),
                 [0.1 * k, 0.5], [lambda t, k=k: 4.0 * np.sin((3 + k) * t)], 2.0, 0.002, k)
        for k in range(6)
    ]  # fmt: skip
    options = Options(effects=('ground_slope',), workers=0)
    told = [f for f in diagnose(nominal, records, options).findings if 'holds' in f]
    assert len(told) == 1
    assert told[0].startswith('swing 3 holds')
    sound = diagnose(nominal, records[:3] + records[4:], options)
    assert not any('holds' in f for f in sound.findings)


def test_a_recording_that_judges_itself_is_a_finding(model_file):
    nominal = Model.load(model_file)
    pulled = nominal.with_effect('torque_bias', bias=0.6)
    records = [
        rehearse(f'swing {k}', pulled, Setup('inner', 'inner_fixed'), [0.1 * k, 0.5],
                 [lambda t, k=k: 4.0 * np.sin((3 + k) * t)], 2.0, 0.002, k)
        for k in range(4)
    ]  # fmt: skip
    options = Options(effects=('torque_bias',), workers=0)
    windows = [replace(record, source='swing') for record in records]
    for given, told in ((records, 0), (windows, 1)):
        found = diagnose(nominal, given, options)
        assert found.causes
        assert sum('of the same recordings' in f for f in found.findings) == told


def test_a_simpler_effect_is_contained_at_the_same_place_only():
    assert contains('stribeck_friction', 'coulomb_friction')
    assert contains('stribeck_friction@elbow', 'coulomb_friction@elbow')
    assert not contains('stribeck_friction@elbow', 'coulomb_friction@shoulder')
    assert not contains('coulomb_friction', 'stribeck_friction')


@pytest.mark.parametrize(('left', 'replaces'), [(0.0, ('coulomb_friction',)), (0.9, ())])
def test_a_law_that_does_the_work_of_the_models_own_replaces_it(model_file, left, replaces):
    """Bristles in a machine that has some plain dry friction beside them, or none."""
    nominal = Model.load(model_file)
    level = nominal.values['coulomb_friction.torque']
    machine = nominal.with_values({'coulomb_friction.torque': left})
    machine = machine.with_effect('presliding_friction', torque=level - left, deflection=0.03)
    records = [
        rehearse(f'swing {k}', machine, Setup('inner', 'inner_fixed'), [0.1 * k, 0.5],
                 [lambda t, k=k: 6.0 * math.sin(2 * math.pi * (0.4 + 0.2 * k + 0.15 * t) * t)],
                 4.0, 0.004, k)
        for k in range(4)
    ]  # fmt: skip
    options = Options(effects=('presliding_friction', 'torque_bias'), workers=0)
    found = diagnose(nominal, records, options)
    assert [(c.label, c.replaces) for c in found.causes] == [('presliding_friction', replaces)]
    assert ('which replaces coulomb_friction' in found.summary) == bool(replaces)
    # What is left of the model's own is what the machine has: 5 standard deviations.
    fit = found.extended.train
    at = [u.name for u in fit.unknowns].index('coulomb_friction.torque')
    assert abs(fit.values[at] - left) < 5 * fit.sigmas[at]


def _gain():
    return (Gain('hip_angle', 'rad', 1e-2, 1e-4, 1e-4),)


def test_pushes_are_told_one_by_one_the_largest_first():
    events = {
        f'swing_{k}': {'impulse': (size, 0.02, 'N s'), 'instant': (1.0 + k, 0.004, 's')}
        for k, size in enumerate((0.5, -6.01, 6.01, 2.0))
    }
    parameters = {**events['swing_1'], 'duration': (0.05, 0.002, 's')}
    text = summary_of('explained', [Cause('external_push', parameters, 90.0, events=events)],
                      _gain(), {})  # fmt: skip
    assert ' from ' not in text.partition('; with it')[0]
    told = [text.index(f'in swing_{k} impulse = ') for k in (1, 2, 3)]
    assert told == sorted(told)
    assert 'in swing_3 impulse = 2.000 \u00b1 0.020 N s, instant = 4.0000 \u00b1 0.0040 s' in text
    assert 'and 1 more; duration = 50.0 \u00b1 2.0 ms' in text
    assert 'swing_0' not in text


@pytest.mark.parametrize(
    ('evidence', 'rivals', 'words'),
    [
        (12.0, (), 'likely (12.0 nats of evidence)'),
        (90.0, (), 'very likely (90.0 nats of evidence)'),
        (90.0, ('back_emf',), 'one or the other very likely (90.0 nats of evidence)'),
        (float('inf'), (), 'very likely, as the model without it does not follow the records'),
    ],
)
def test_the_first_sentence_says_how_sure_the_least_sure_cause_is(evidence, rivals, words):
    causes = [
        Cause('imu_scale', {'scale': (1.02, 1e-3, '1')}, 1e3),
        Cause('torque_constant', {'error': (-0.1, 0.02, '1')}, evidence, rivals),
    ]
    verdict = 'ambiguous' if rivals else 'explained'
    if evidence == float('inf'):
        causes = causes[1:]
    assert words in summary_of(verdict, causes, _gain(), {}).partition(';')[0]
