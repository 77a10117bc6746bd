"""What records do not tell is said, by the fit and in the summary."""

import math
from dataclasses import replace

import numpy as np
import pytest
from searches import search_for

from cg_dynamics.effects.unmodelled import UNMODELLED
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_sysid.diagnosis.causes import as_in
from cg_sysid.diagnosis.result import Cause
from cg_sysid.diagnosis.summary import described, summary_of
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.gain import Gain
from cg_sysid.identification.identify import fit
from cg_sysid.identification.unknowns import unknowns_of
from cg_sysid.learned.shape import Shape
from cg_sysid.learned.unmodelled import Unmodelled
from cg_sysid.search.model_selection import ModelSelection
from cg_sysid.search.outcome import edges
from cg_sysid.search.task import Task
from cg_sysid.search.whole_fit import try_candidate

SPRINGS = tuple(Spring('inner', 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3))
SOFT = {'stiffness': 300.0, 'rotor_inertia': 0.1, 'damping': 0.6}


@pytest.fixture(scope='module')
def nominal(model_file):
    return Model.load(model_file)


def _fit_of_a_flexible_joint(nominal, machine):
    record = rehearse(
        'record', machine, Setup(springs=SPRINGS), [0.1, -0.1, 0.3, -0.5],
        [lambda t: 9.0 * math.sin(2 * math.pi * (0.5 + 0.4 * t) * t)], 6.0, 0.004, 3,
    )  # fmt: skip
    model = nominal.with_effect('joint_flexibility', **SOFT)
    return fit(model, prepare(nominal, [record]))


def test_a_spring_that_is_there_is_determined(nominal):
    found = _fit_of_a_flexible_joint(nominal, nominal.with_effect('joint_flexibility', **SOFT))
    assert found.undetermined == ()
    assert not any('not determined' in warning for warning in found.warnings)


def test_a_spring_that_acts_like_a_lag_is_not(nominal):
    late = nominal.with_effect('actuator_lag', time_constant=0.01)
    found = _fit_of_a_flexible_joint(nominal, late)
    assert found.undetermined
    assert all(name.startswith('joint_flexibility.') for name in found.undetermined)
    told = [warning for warning in found.warnings if 'not determined' in warning]
    assert [warning.split(' = ')[0] for warning in told] == list(found.undetermined)


def test_the_summary_says_so():
    cause = Cause('joint_flexibility', {'stiffness': (0.44, 0.57, 'N m/rad')}, 900.0,
                  undetermined=('stiffness',))  # fmt: skip
    gain = Gain('hip_angle', 'rad', 1e-4, 0.02, 0.001)
    assert 'do not determine joint_flexibility.stiffness' in summary_of(
        'explained', [cause], (gain,), {}
    )


def test_a_cause_knows_which_of_its_numbers_ended_at_an_edge(nominal):
    label = 'torque_constant'
    work = search_for(nominal, nominal.with_effect(label, error=0.1))
    found = try_candidate(Task(nominal, (label, None)), work.train, work.held)
    assert as_in(found, Cause(label, {}, 900.0)).at_edge == ()
    place = [u.name for u in found.train.unknowns].index(f'{label}.error')
    values = found.train.values.copy()
    values[place] = found.train.unknowns[place].upper
    ended = replace(found, train=replace(found.train, values=values))
    assert as_in(ended, Cause(label, {}, 900.0)).at_edge == ('error',)


@pytest.mark.parametrize(('torque', 'ends'), [(0.0, True), (2e-5, False), (50.0, True)])
def test_little_friction_of_a_light_machine_is_no_edge(nominal, torque, ends):
    name = 'coulomb_friction'
    model = nominal.without_effect(name).with_effect(name, torque=torque)
    known = [(u, model.values[u.name]) for u in unknowns_of(model)]
    assert ('torque' in edges(name, model.effect(name).parameters, known)) == ends


def test_the_summary_says_where_a_number_ended_at_an_edge():
    cause = Cause('cogging_torque', {'cycles': (1.0, 0.1, '1')}, 900.0, at_edge=('cycles',))
    gain = Gain('hip_angle', 'rad', 1e-4, 0.02, 0.001)
    said = summary_of('explained', [cause], (gain,), {})
    assert 'The fit drove cogging_torque.cycles to the edge of what was tried: what acts' in said


def test_a_size_that_is_not_determined_is_no_cause(nominal):
    """A motor that gives 1 N m and another loss: a limit explains nothing, whatever it gains."""
    machine = nominal.with_effect('quadratic_friction', coefficient=0.05)
    data_sets = prepare(nominal, [
        rehearse(
            f'record_{k}', machine, Setup(springs=SPRINGS), [0.1, -0.1, 0.3, -0.5],
            [lambda t, k=k: math.sin(2 * math.pi * (0.5 + 0.1 * k + 0.4 * t) * t)], 6.0, 0.004, k,
        )
        for k in range(2)
    ])  # fmt: skip
    train, held = data_sets[:1], data_sets[1:]
    base, limited = (
        try_candidate(Task(nominal, effect), train, held)
        for effect in (None, ('torque_saturation', None))
    )
    judged = ModelSelection(train, held).judge(base, limited, gained=1e3)
    assert 'is not determined' in judged.reason
    quadratic = try_candidate(Task(nominal, ('quadratic_friction', None)), train, held)
    assert (
        'determined' not in ModelSelection(train, held).judge(base, quadratic, gained=1e3).reason
    )


@pytest.mark.parametrize(
    ('sigma', 'told'),
    [
        (0.2, 'distance not determined'),
        (float('inf'), 'distance not determined'),
        (0.05, 'distance = 0.170 \u00b1 0.050 m'),
    ],
)
def test_a_place_is_told_where_the_interval_tells_one(sigma, told):
    """Payloads are sought 0.2, 0.6 and 1 m from the joint: +- 0.4 m holds two of these."""
    cause = Cause(
        'payload@outer', {'mass': (1.2, 0.1, 'kg'), 'distance': (0.17, sigma, 'm')}, 900.0
    )
    gain = Gain('hip_angle', 'rad', 1e-2, 2e-3, 0.001)
    text = summary_of('explained', [cause], (gain,), {})
    assert 'mass = 1.20 \u00b1 0.10 kg' in text
    assert told in text
    assert ('0.17' in text) == (sigma < 0.1)


def test_a_cause_whose_numbers_are_of_each_recording_has_no_empty_brackets():
    assert described(Cause('encoder_zero', {}, 94.0)) == 'encoder_zero'
    stiff = Cause('joint_flexibility', {'stiffness': (44.0, 1.0, 'N m/rad')}, 94.0)
    assert described(stiff).startswith('joint_flexibility (stiffness = 44.0 ± 1.0 N m/rad)')


def test_a_learned_function_that_hardly_varies_is_called_a_constant(nominal):
    """A wave found on a torque of 0.21 N m that is always there is no wave."""
    s = np.linspace(-0.08, 0.08, 5)
    shape = Shape(s, np.full(5, 0.21), np.full(5, 0.01), np.ones(5, bool), (0.0, 6.0), mean=0.21,
                  rms=0.2105, peak=0.22, even=None, stretch=None)  # fmt: skip
    kind = UNMODELLED['unmodelled_joint_torque_periodic_in_time']
    effect = kind(nominal.mechanism, kind.sites(nominal.mechanism)[0])
    found = Unmodelled(effect, shape, (0.16, 1e-3), {}, 400.0, 9.0, 0.72, None, (), None, None)
    assert found.text == (
        'A torque at the hip that is constant, 0.21 N m. It explains 72 % of the error above the '
        'noise on records held out.'
    )
    wave = replace(found, shape=replace(shape, mean=0.02))
    assert 'that follows the time of the record: repeating every 0.16 s' in wave.text
    assert '0.21 N m RMS and 0.22 N m at most' in wave.text
    # What is not sure has no largest value, or one below the mean over the samples.
    for peak, words in ((0.15, 'where it is largest'), (0.0, 'anywhere')):
        unsure = replace(wave, shape=replace(wave.shape, peak=peak))
        assert f'0.21 N m RMS, its size not sure {words}. ' in unsure.text
    # One place is not a stretch from itself to itself.
    for stretch, words in (((0.81, 1.93), 'from 0.81 to 1.9 s'), ((0.808, 0.811), 'near 0.81 s')):
        narrow = replace(wave, shape=replace(wave.shape, stretch=stretch))
        assert f', mostly {words}, ' in narrow.text


def test_a_spring_that_winds_up_by_turns_is_no_transmission(nominal):
    machine = nominal.with_effect('actuator_lag', time_constant=0.01)
    data_sets = prepare(nominal, [
        rehearse(
            f'record_{k}', machine, Setup(springs=SPRINGS), [0.1, -0.1, 0.3, -0.5],
            [lambda t, k=k: 9 * math.sin(2 * math.pi * (0.5 + 0.1 * k + 0.4 * t) * t)], 4.0, 0.004,
            k,
        )
        for k in range(2)
    ])  # fmt: skip
    train, held = data_sets[:1], data_sets[1:]
    base, soft = (
        try_candidate(Task(model, effect, iterations=1), train, held)
        for model, effect in ((nominal, None), (nominal, ('joint_flexibility', None)))
    )
    for stiffness, told in ((1.0, 'winds up by 1.4 turns'), (2.0, '')):
        name = 'joint_flexibility.stiffness'
        model = soft.train.model.with_values({name: stiffness})
        fitted = replace(soft, train=replace(soft.train, model=model))
        reason = ModelSelection(train, held).judge(base, fitted, gained=1e3).reason
        assert told in reason
        assert ('winds up' in reason) == bool(told)
