"""Effects that no library has, hidden in machines: named as unexplained, and described rightly.

What the diagnosis may try are the effects of the library that come nearest; bench/unlisted.py lets
it try all of them.
"""

from dataclasses import replace

import numpy as np
import pytest
from unlisted import CASES, DURATION, MORE, SoftStop, TiltedGyro, ViscoelasticHip, hide, records

from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options

SHORT = 4.0  # s, two thirds of what the bench records


@pytest.fixture(scope='module')
def nominal(model_file):
    return Model.load(model_file)


def test_none_of_them_is_in_the_library():
    assert not {case.hidden.name for case in (*CASES, *MORE)} & set(LIBRARY)


# One law of each kind in every run; bench/evidence.py has the others.
OTHERS = (
    'hidden_torsion_spring', 'hidden_fading', 'hidden_stop',
    'hidden_imu_error', 'hidden_gravity_in_gyro', 'hidden_detent', 'hidden_gyro_error',
)  # fmt: skip


@pytest.mark.parametrize(
    'case',
    [
        pytest.param(case, marks=pytest.mark.evidence) if case.hidden.name in OTHERS else case
        for case in CASES
    ],
    ids=lambda c: c.hidden.name,
)
@pytest.mark.slow
def test_unlisted_effect_is_described(nominal, case):
    # Gravity in a gyroscope is small beside its noise: its shape takes all that the bench records.
    long = case.hidden is TiltedGyro
    made = records(hide(nominal, case.hidden), duration=DURATION if long else SHORT)
    answer = diagnose(nominal, made, Options(effects=case.listed, workers=1))
    assert answer.verdict == 'unexplained', answer.summary
    found = answer.unmodelled
    assert found is not None, answer.summary
    assert (found.label, found.where, found.effect.follows) == (
        case.label, case.where, case.follows
    ), answer.summary  # fmt: skip
    assert found.shape.parity == case.parity
    if case.period:
        # A thousandth of the period is a tenth of a turn over all that the records cover.
        assert found.period[0] == pytest.approx(case.period, rel=3e-3)
    # Nine tenths of the error gone is a good description of anything.
    assert found.explained > 0.9
    truth = case.hidden.function(found.shape.s)
    seen = found.shape.seen
    wrong = (found.shape.value - truth)[seen]
    size = np.sqrt(np.mean(truth[seen] ** 2))
    assert np.sqrt(np.mean(wrong**2)) < case.error * size
    assert 'of the library' not in answer.summary
    assert all(name in answer.summary for name in case.listed)


@pytest.mark.evidence
def test_what_takes_less_than_half_of_the_error_is_no_explanation(nominal):
    # The torque constant takes a third of what a law with a memory does, on held-out records too.
    made = records(hide(nominal, ViscoelasticHip))
    listed = ('torque_constant', 'torque_bias')
    answer = diagnose(nominal, made, Options(effects=listed, workers=1))
    assert answer.verdict == 'unexplained', answer.summary
    assert answer.unmodelled is None
    (cause,) = answer.causes
    before, after = (m.held.normalised_error - 1 for m in (answer.baseline, answer.extended))
    assert 0.5 * before < after < before
    assert f'{100 * (1 - after / before):.0f} % of the squared error' in answer.summary
    assert f'{cause.label} (error = ' in answer.summary
    assert 'may only stand in' in answer.summary


@pytest.mark.evidence
def test_described_where_a_sensor_was_not_recorded(nominal):
    machine = hide(nominal, SoftStop)
    seen = [
        replace(r, outputs={c: y for c, y in r.outputs.items() if c != 'imu_rate'})
        for r in records(machine, duration=SHORT)
    ]
    answer = diagnose(nominal, seen, Options(effects=('ground_slope', 'payload'), workers=1))
    assert answer.verdict == 'unexplained', answer.summary
    assert answer.unmodelled is not None
    assert (answer.unmodelled.where, answer.unmodelled.effect.follows) == ('joint', 'angle:hip')


@pytest.mark.evidence
@pytest.mark.slow
def test_short_records_are_not_explained_by_pushes_of_their_own(nominal):
    # Two values more for each half second match it better whatever is wrong, held out or not.
    whole = records(hide(nominal, SoftStop), duration=SHORT)
    short = [part for record in whole for part in record.segments(0.6)]
    answer = diagnose(nominal, short, Options(effects=('external_push',), workers=1))
    assert not answer.causes, answer.summary
    (tried,) = answer.rounds[0].candidates
    assert 'cannot judge' in tried.reason
