"""What a first look takes of the records, and what it says of all of them."""

import math

import numpy as np
import pytest

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.search import excerpt, settings
from cg_sysid.search.look import first_seconds, screen
from cg_sysid.search.task import Task
from cg_sysid.search.whole_fit import try_candidate

SPRINGS = tuple(Spring('inner', 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3))
SOFTER = tuple(Spring('inner', 1.0, (x, 1.0), 150.0, 0.5) for x in (1.3, -1.3))


@pytest.fixture(scope='module')
def nominal(model_file):
    return Model.load(model_file)


def _records(machine, seconds, setups=(SPRINGS, SPRINGS)):
    return [
        rehearse(
            f'record_{k}', machine, Setup(springs=springs), [0.1 - 0.1 * k, -0.1, 0.3, -0.5],
            [lambda t, k=k: 8.0 * math.sin(2 * math.pi * (0.5 + 0.1 * k + 0.05 * t) * t)],
            seconds, 0.004, k,
        )
        for k, springs in enumerate(setups)
    ]  # fmt: skip


def _windows(nominal, records, length=1.0):
    return prepare(nominal, [part for record in records for part in record.segments(length)])


def test_of_long_records_all_begin(nominal):
    data_sets = prepare(nominal, _records(nominal, 8.0))
    assert excerpt.few(data_sets) == [0, 1]
    assert excerpt.lengths(data_sets) == [2.0]
    assert excerpt.lengths(prepare(nominal, _records(nominal, 3.0))) == []


def test_of_many_short_records_some_of_every_set_up(nominal):
    data_sets = _windows(nominal, _records(nominal, 20.0, (SPRINGS, SPRINGS, SOFTER)))
    few = excerpt.few(data_sets)
    assert settings.SCREENING.fewest_records <= len(few) <= len(data_sets) / 2
    assert {repr(data_sets[i].setup) for i in few} == {
        repr(data_set.setup) for data_set in data_sets
    }
    assert {data_sets[i].recording for i in few} == {data_set.recording for data_set in data_sets}
    # Of few short ones none can be spared.
    assert excerpt.few(data_sets[:10]) == list(range(10))


def test_what_few_records_say_is_a_start_for_all(nominal):
    machine = nominal.with_effect('encoder_zero', zero=0.0)
    records = _records(nominal, 20.0)
    data_sets = _windows(nominal, records)
    of_few = fit(machine, [data_sets[i] for i in excerpt.few(data_sets)])
    start = excerpt.to_all(of_few, data_sets)
    assert len(start.motions) == len(data_sets)
    # What belongs to a recording is one and the same in all its pieces.
    zeros = {}
    for data_set, motion in zip(data_sets, start.motions, strict=True):
        zeros.setdefault(data_set.recording, set()).add(float(motion[-1]))
    assert len(zeros) == 2
    assert all(len(values) == 1 for values in zeros.values())
    again = fit(machine, data_sets, start=start)
    assert again.converged
    assert again.normalised_error < 1.1  # noise, within a few per cent at 5000 rows
    back = excerpt.to_few(again, data_sets)
    np.testing.assert_array_equal(back.motions[0], again.motions[0])


def test_a_look_at_short_records_finds_what_helps(nominal):
    machine = nominal.with_effect('torque_bias', bias=1.5)
    train = _windows(nominal, _records(machine, 20.0))
    base = fit(nominal, train)
    alone = Task(nominal, base=base)
    first = first_seconds(alone, train)
    assert len(first.motions) == len(excerpt.few(train)) < len(train)
    screenings = {
        name: screen(Task(nominal, (name, None), base=base, first=first), train)
        for name in ('torque_bias', 'gyro_bias')
    }
    assert screenings['torque_bias'].error < 1.2 < screenings['gyro_bias'].error
    outcome = try_candidate(screenings['torque_bias'].task, train, train[:3])
    assert outcome.train.normalised_error < 1.1
    assert outcome.train.model.values['torque_bias.bias'] == pytest.approx(1.5, rel=0.02)
