"""An encoder that every start zeroes anew: one value for all pieces of a recording."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.identification.simulation_error import Problem, attempt, moved, reduced
from cg_sysid.identification.unknowns import unknowns_of
from cg_sysid.report.wording import event_words
from cg_sysid.search.outcome import events_of
from cg_sysid.search.task import Task
from cg_sysid.search.whole_fit import try_candidate

SPRINGS = tuple(Spring('inner', 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3))
ZEROS = (0.011, -0.007, 0.004, -0.012)
CHANNEL = 'hip_angle'


def _recording(machine, k, zero, seconds=4.0):
    record = rehearse(
        f'recording_{k}', machine, Setup(springs=SPRINGS), [0.1 - 0.07 * k, -0.1, 0.3, -0.5],
        [lambda t: 9.0 * math.sin(2 * math.pi * (0.5 + 0.2 * k + 0.15 * t) * t)],
        seconds, 0.004, k,
    )  # fmt: skip
    outputs = {**record.outputs, CHANNEL: record.outputs[CHANNEL] + zero}
    return replace(record, outputs=outputs)


@pytest.fixture
def nominal(model_file):
    return Model.load(model_file)


@pytest.fixture
def machine(nominal):
    return nominal.with_values({
        'c1': 1.06 * nominal.values['c1'], 'c5': 0.92 * nominal.values['c5'],
    })  # fmt: skip


def test_pieces_of_a_recording_share_its_zero(nominal, machine):
    whole = [_recording(machine, k, zero) for k, zero in enumerate(ZEROS[:2])]
    pieces = [piece for record in whole for piece in record.segments(1.0)]
    data_sets = prepare(nominal, pieces)
    assert len(data_sets) == 8
    found = fit(nominal.with_effect('encoder_zero', zero=0.0), data_sets)
    zeros = [values['encoder_zero.zero'] for values in found.own_by_name(data_sets).values()]
    sigmas = [s[0] for s in found.own_sigmas]
    for k, zero in enumerate(ZEROS[:2]):
        own = zeros[4 * k : 4 * k + 4]
        assert np.ptp(own) == 0.0
        assert abs(own[0] - zero) < 4 * sigmas[4 * k]
    # A zero of its own for each piece would be about twice as uncertain as one for all four.
    alone = fit(nominal.with_effect('encoder_zero', zero=0.0), [
        replace(data_set, recording=data_set.name) for data_set in data_sets
    ])  # fmt: skip
    assert np.median([s[0] for s in alone.own_sigmas]) > 1.4 * np.median(sigmas)


def test_eliminated_together_is_eliminated_at_once(nominal, machine):
    """The step of a block is that of the whole system of equations, solved directly."""
    pieces = _recording(machine, 0, 0.01).segments(1.0)[:3]
    model = nominal.with_effect('encoder_zero', zero=0.0).with_effect('external_push')
    data_sets = prepare(nominal, pieces)
    unknowns = unknowns_of(model)
    own = np.array([0.01, 0.5, 0.4])
    guesses = [np.concatenate([data_set.motion, own]) for data_set in data_sets]
    problem = Problem(model, data_sets, unknowns, guesses)
    theta = np.array([u.to_coordinate(u.prior) for u in unknowns])
    point = attempt(problem, theta, guesses, np.inf).point(1.0)
    assert len(problem.blocks) == 1
    h, g, factors = reduced(point, 0.0)
    step = np.linalg.solve(h, -g)
    found = moved(problem, guesses, factors, step)
    d, e, own_g = point.own[0]
    direct = np.linalg.solve(
        np.block([[d, e], [e.T, point.shared_hessian]]),
        -np.concatenate([own_g, point.shared_gradient]),
    )
    # Condition of the whole: 1e9 or so.
    np.testing.assert_allclose(direct[len(own_g) :], step, rtol=1e-5, atol=1e-9)
    zero = len(data_sets[0].motion)
    assert len({data_set[zero] for data_set in found}) == 1
    assert len({data_set[zero + 1] for data_set in found}) == 3
    assert found[0][zero] - 0.01 == pytest.approx(direct[0], rel=1e-5)


def test_it_costs_one_parameter_for_each_recording(nominal, machine):
    pieces = [p for k in range(2) for p in _recording(machine, k, ZEROS[k]).segments(2.0)]
    data_sets = prepare(nominal, pieces)
    base = try_candidate(Task(nominal), data_sets[:2], data_sets[2:])
    zeroed = try_candidate(Task(nominal, ('encoder_zero', None)), data_sets[:2], data_sets[2:])
    assert zeroed.unknowns == base.unknowns + 2
    assert len(events_of(zeroed, 'encoder_zero')) == 4


def _diagnosed(nominal, machine, zeros):
    records = [_recording(machine, k, zero) for k, zero in enumerate(zeros)]
    rivals = ('encoder_zero', 'encoder_offset', 'external_push', 'torque_bias', 'imu_offset')
    return diagnose(nominal, records, Options(effects=rivals, workers=1))


def test_zeros_of_their_own_are_named(nominal, machine):
    found = _diagnosed(nominal, machine, ZEROS)
    assert [(cause.label, cause.rivals) for cause in found.causes] == [('encoder_zero', ())]
    assert re.search(r'encoder_zero \(zero from −0.01.* to 0.01.* rad\)', found.summary)
    events = found.causes[0].events
    for k, zero in enumerate(ZEROS):
        value, sigma, unit = events[f'recording_{k}']['zero']
        assert unit == 'rad'
        assert abs(value - zero) < 4 * sigma


def test_one_zero_for_all_is_an_offset(nominal, machine):
    found = _diagnosed(nominal, machine, (0.011,) * 4)
    assert [(cause.label, cause.rivals) for cause in found.causes] == [('encoder_offset', ())]


def test_pieces_that_share_a_value_are_told_as_one():
    def zero(value):
        return {'zero': {'value': value, 'sigma': 1e-4, 'unit': 'rad'}}

    events = {'a[0..1 s]': zero(0.01), 'a[1..2 s]': zero(0.01), 'b': zero(-0.02)}
    one, other = event_words({'events': events})
    assert one == 'in a: zero 10.00 ± 0.10 mrad'
    assert other == 'in b: zero −20.00 ± 0.10 mrad'
