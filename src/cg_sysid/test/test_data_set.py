"""A record made ready for simulation: inputs as a model asks for them."""

from dataclasses import replace

import numpy as np
import pytest

from cg_dynamics.effects.effect import SESSION_TIME, TIME
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_dynamics.rollout.compiled import compile_model
from cg_sysid.diagnosis.diagnose import split
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.search.nuisance import turning
from cg_sysid.search.outcome import events_of
from cg_sysid.search.task import Task, candidates_for
from cg_sysid.search.whole_fit import try_candidate


def test_model_gets_torque_time_and_switches_in_its_order(model_file):
    nominal = Model.load(model_file)
    record = rehearse('swing', nominal, Setup('inner', 'inner_fixed'), [0.2, 0.5], [np.sin], 0.3)
    (data_set,) = prepare(nominal, [record])
    asking = nominal.with_effect('friction_drift').with_effect('back_emf')
    names = compile_model(asking, data_set.setup).input_names
    assert names == ('hip_torque', 'time', 'session_time', 'drive_enabled')
    inputs = data_set.inputs_for(names)
    np.testing.assert_array_equal(inputs[:, 0], record.inputs['hip_torque'])
    # A clock is held from row to row as the torque is: at the middle.
    np.testing.assert_allclose(inputs[:, 1], data_set.time + 0.001)
    np.testing.assert_allclose(inputs[:, 2], data_set.time + 0.001)
    np.testing.assert_array_equal(inputs[:, 3], 1.0)


def test_only_effects_that_can_show_are_tried(model_file):
    nominal = Model.load(model_file)
    fixed = {name for name, _ in candidates_for(nominal, [Setup('inner', 'inner_fixed')])}
    free = {name for name, _ in candidates_for(nominal, [Setup()])}
    unseen = {'foot_radius', 'foot_compliance', 'ankle_friction', 'tether_force', 'external_push',
              'boom_mass', 'foot_creep'}  # fmt: skip
    assert free - fixed == unseen
    assert not {'spring_damping', 'spring_nonlinearity'} & free


def test_an_effect_of_a_switch_is_tried_where_the_switch_was_recorded(model_file):
    nominal = Model.load(model_file)
    without = {name for name, _ in candidates_for(nominal, [Setup()])}
    recorded = {name for name, _ in candidates_for(nominal, [Setup()], None, {'drive_enabled'})}
    assert recorded - without == {'back_emf'}


def test_late_torque_and_late_readings_are_told_apart_by_nothing(model_file):
    """After the first moments they are the same motion: a thorough fit must not tell them apart.

    Coarse rows do, by several units of chi2: the mean of a late torque over a row is not the
    late torque.
    """
    nominal = Model.load(model_file)
    machine = nominal.with_effect('actuator_delay', None, delay=0.0068)
    rng = np.random.default_rng(3)
    steps = rng.normal(0.0, 6.0, 200)
    records = [
        rehearse(f'steps {k}', machine, Setup('inner', 'inner_fixed'), [0.2, 0.5],
                 [lambda t, k=k: steps[int(25 * t) + 70 * k]], 3.0, seed=k)
        for k in range(2)
    ]  # fmt: skip
    data_sets = [
        replace(t, outputs=np.where(t.time[:, None] < 0.1, np.nan, t.outputs))
        for t in prepare(nominal, records)
    ]
    chi2 = {}
    for name in ('actuator_delay', 'sensor_delay'):
        for thorough in (False, True):
            found = fit(nominal.with_effect(name), data_sets, only=[f'{name}.delay', 'c1', 'c4'],
                        thorough=thorough)  # fmt: skip
            chi2[name, thorough] = (found.mse * found.count).sum()
    apart = [abs(chi2['actuator_delay', t] - chi2['sensor_delay', t]) for t in (False, True)]
    assert apart[1] < 1.0, apart
    assert apart[1] < apart[0], apart


def test_dry_friction_that_is_tried_turns_as_fast_as_that_of_the_model(model_file):
    nominal = Model.load(model_file).with_values({'coulomb_friction.transition_rate': 0.003})
    assert turning(nominal, 'stribeck_friction', None) == {'transition_rate': 0.003}
    assert turning(nominal, 'viscous_friction', None) == {}
    assert turning(nominal.without_effect('coulomb_friction'), 'stribeck_friction', None) == {}


def test_whole_recordings_are_held_out_and_pieces_only_of_a_single_one(model_file):
    nominal = Model.load(model_file)
    swing = rehearse('swing', nominal, Setup('inner', 'inner_fixed'), [0.2, 0.5], [np.sin], 2.0)
    once = [replace(p, source='once') for p in swing.segments(0.5)]
    train, held = split(prepare(nominal, once))
    assert [len(side) for side in (train, held)] == [2, 2]
    assert {t.name for t in held} == {once[1].name, once[3].name}
    thrice = [replace(p, source=s, name=f'{s} {p.name}') for s in 'abc' for p in swing.segments(1)]
    train, held = split(prepare(nominal, thrice))
    assert [t.recording for t in train] == ['a', 'a', 'c', 'c']
    assert [t.recording for t in held] == ['b', 'b']


def test_time_goes_on_through_all_pieces_of_a_recording(model_file):
    nominal = Model.load(model_file)
    machine = nominal.with_effect('imu_drift', rate=0.01)
    setup = Setup('inner', 'inner_fixed')
    whole = rehearse(
        'swing', machine, setup, [0.2, 0.5], [lambda t: 3 * np.sin(5 * t)], 8.0, 0.004
    )
    parts = [piece for half in whole.segments(4.0) for piece in half.segments(2.0)]
    data_sets = prepare(nominal, parts)
    assert [data_set.since for data_set in data_sets] == pytest.approx(
        [0.0, 2.0, 4.0, 6.0], abs=0.003
    )
    clocks = np.concatenate([data_set.inputs_for((TIME,))[:, 0] for data_set in data_sets])
    np.testing.assert_allclose(clocks, whole.time + 0.002, atol=1e-9)
    found = fit(nominal.with_effect('imu_drift'), data_sets, only=['imu_drift.rate'])
    assert found.normalised_error == pytest.approx(1.0, abs=0.05)
    assert abs(found.values[0] - 0.01) < 4 * found.sigmas[0] < 0.001


def test_recordings_that_follow_one_another_are_a_session(model_file):
    nominal = Model.load(model_file)
    setup = Setup('inner', 'inner_fixed')
    made = rehearse('swing', nominal, setup, [0.2, 0.5], [lambda t: 3 * np.sin(5 * t)], 4.0, 0.004)

    def taken(*begins_s):
        return [
            replace(made, name=f'{begin} s', stamp_ns=made.stamp_ns + round((7 + begin) * 1e9))
            for begin in begins_s
        ]

    late, first, second = taken(60.0, 0.0, 4.5)
    data_sets = prepare(nominal, [late, *first.segments(2.0), *second.segments(2.0)])
    assert [t.session for t in data_sets] == pytest.approx([60.0, 0.0, 0.0, 4.5, 4.5])
    clock = data_sets[-1].inputs_for((SESSION_TIME,))[:, 0]
    np.testing.assert_allclose(clock, 4.5 + data_sets[-1].since + data_sets[-1].time + 0.002)
    # Two robots at once, or simulated ones whose clocks begin anew: whose session would it be?
    assert {t.session for t in prepare(nominal, taken(0.0, 3.9, 60.0))} == {0.0}


def test_a_push_is_found_in_the_piece_that_it_hit_and_by_the_time_of_the_recording(model_file):
    nominal = Model.load(model_file)
    springs = tuple(Spring('inner', 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3))
    machine = nominal.with_effect('external_push', impulse=2.0, instant=7.3, duration=0.1)
    whole = rehearse('pushed', machine, Setup(springs=springs), [0.1, -0.1, 0.3, -0.5],
                     [lambda t: 4 * np.sin(5 * t)], 12.0, 0.004)  # fmt: skip
    data_sets = prepare(nominal, whole.segments(4.0))
    outcome = try_candidate(Task(nominal, ('external_push', None)), data_sets[1:], data_sets[:1])
    events = events_of(outcome, 'external_push')
    assert max(events, key=lambda name: events[name]['impulse'][0]) == data_sets[1].name
    value, sigma, _ = events[data_sets[1].name]['instant']
    assert abs(value - 7.3) < 4 * sigma + 0.005
