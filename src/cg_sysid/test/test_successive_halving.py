"""What keeps the race of all candidates short, and does not decide it."""

import math
from dataclasses import replace

import finger
import hanging_arm
import numpy as np
import pytest

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_sysid.errors import Failure
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification import torque_error
from cg_sysid.identification.data_set import pieces, prepare
from cg_sysid.identification.hope import out_of_reach
from cg_sysid.identification.identify import COARSE, fit
from cg_sysid.search import look, settings, whole_fit
from cg_sysid.search.events import undisturbed
from cg_sysid.search.look import first_seconds
from cg_sysid.search.nuisance import with_nuisances
from cg_sysid.search.outcome import events_of, own_parameters
from cg_sysid.search.starts import starting_models
from cg_sysid.search.successive_halving import SuccessiveHalving, worth_having
from cg_sysid.search.task import Rival, Task
from cg_sysid.search.whole_fit import try_candidate

SPRINGS = tuple(Spring('inner', 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3))
OFF = {'c1': 1.06, 'c5': 0.92}  # of the nominal values


@pytest.fixture(scope='module')
def nominal(model_file):
    return Model.load(model_file)


def _machine(nominal, *effects):
    machine = nominal.with_values({n: x * nominal.values[n] for n, x in OFF.items()})
    for name, values in effects:
        machine = machine.with_effect(name, **values)
    return machine


def _data_sets(nominal, machine, seconds=8.0):
    records = [
        rehearse(
            f'record_{k}', machine, Setup(springs=SPRINGS), [0.1 - 0.2 * k, -0.1, 0.3, -0.5],
            [lambda t, k=k: 9.0 * math.sin(2 * math.pi * (0.5 + 0.2 * k + 0.1 * t) * t)],
            seconds, 0.004, k,
        )
        for k in range(2)
    ]  # fmt: skip
    return prepare(nominal, records)


PUSH = ('external_push', {'impulse': -3.0, 'instant': 4.3, 'duration': 0.1})


def test_pieces_leave_out_what_begins_without_samples(nominal):
    data_set = _data_sets(nominal, nominal, seconds=6.5)[0]
    gap = (data_set.time > 1.9) & (data_set.time < 2.1)
    spoilt = replace(data_set, outputs=np.where(gap[:, None], np.nan, data_set.outputs))
    found = pieces(nominal.mechanism, spoilt, 2.0)
    assert [begin for begin, _ in found] == pytest.approx([0.0, 4.0], abs=0.005)
    missing = replace(
        data_set, outputs=np.where(data_set.time[:, None] < 2.0, np.nan, data_set.outputs)
    )
    assert [begin for begin, _ in pieces(nominal.mechanism, missing, 2.0)] == pytest.approx(
        [2.0, 4.0], abs=0.005
    )
    assert not pieces(nominal.mechanism, _data_sets(nominal, nominal, seconds=0.6)[0], 2.0)


def test_a_push_in_records_too_short_for_pieces(nominal):
    machine = _machine(nominal, ('external_push', {**PUSH[1], 'instant': 0.4}))
    train, held = ([data_set] for data_set in _data_sets(nominal, machine, seconds=0.9))
    outcome = try_candidate(Task(nominal, ('external_push', None)), train, held)
    # Held-out records take the model's own numbers for certain: their intervals are too narrow.
    of_fitted = events_of(outcome, 'external_push')[train[0].name]
    assert own_parameters(outcome)['impulse'] == of_fitted['impulse']
    # One second says little about the lumps, and what they lack the push makes up for.
    assert own_parameters(outcome)['impulse'][0] == pytest.approx(-3.0, rel=0.1)
    assert own_parameters(outcome)['instant'][0] == pytest.approx(0.4, abs=0.01)


def test_a_fit_out_of_reach_is_broken_off(nominal):
    data_sets = _data_sets(nominal, _machine(nominal, PUSH))
    patient, hasty = (fit(nominal, data_sets, reach=reach) for reach in (np.inf, 3.0))
    assert hasty.evaluations < patient.evaluations
    assert not hasty.converged
    assert min(hasty.normalised_error, patient.normalised_error) > 30.0  # both are hopeless


def test_a_fit_that_comes_into_reach_is_not(nominal):
    data_sets = _data_sets(nominal, _machine(nominal))
    patient, hasty = (fit(nominal, data_sets, reach=reach) for reach in (np.inf, 3.0))
    np.testing.assert_array_equal(hasty.values, patient.values)
    assert hasty.converged


def test_numbers_of_pieces_that_nothing_spoils(nominal):
    machine = _machine(nominal, PUSH)
    data_sets = _data_sets(nominal, machine)
    calm, spoilt = undisturbed(nominal, data_sets, {}), fit(nominal, data_sets)
    away = {
        name: [abs(f.model.values[name] / machine.values[name] - 1) for f in (calm, spoilt)]
        for name in OFF
    }
    # Six of eight pieces of 2 s say as much as their own intervals claim.
    sigmas = dict(zip((u.name for u in calm.unknowns), calm.sigmas, strict=True))
    for name, (calm_error, _) in away.items():
        assert calm_error < 4 * sigmas[name] / machine.values[name]
    assert max(b for _, b in away.values()) > 3 * max(a for a, _ in away.values())


@pytest.mark.parametrize(
    'effects', [(), (('coulomb_friction', {'torque': 1.5}),), (('payload', {'mass': 1.0}),)]
)
def test_what_is_wrong_all_the_time_did_not_happen(nominal, effects):
    bare = nominal.without_effect('coulomb_friction')
    assert undisturbed(bare, _data_sets(bare, _machine(bare, *effects)), {}) is None


def test_a_look_serves_beside_other_small_faults_too(nominal):
    """What every robot has a little of is let go when the cause is known: no need to look anew."""
    train = _data_sets(nominal, _machine(nominal, ('payload', {'mass': 1.0})), seconds=5.0)
    asked = []

    def carry_out(function, arguments, what):
        asked.append((what, len(arguments)))
        return [function(*a) for a in arguments]

    halving = SuccessiveHalving(train, train, carry_out)
    model, bounds = with_nuisances(nominal, [data_set.setup for data_set in train])
    faulty = Task(model, ('payload', None), bounds=bounds)
    (screening,) = halving.screen([faulty], 'beside small faults')
    lean = Task(nominal, ('payload', None))
    (same,) = halving.screen_beside([lean], 'alone')
    assert asked == [('beside small faults', 1), ('alone', 0)]
    assert same.task.model is nominal
    own = {u.name for u in screening.task.warm_starts[0].unknowns}
    assert own - {u.name for u in same.task.warm_starts[0].unknowns} == set(bounds)
    # It is a start for a fit of this structure, and a good one.
    outcome = try_candidate(replace(same.task, iterations=8), train, train)
    assert outcome.train.normalised_error == pytest.approx(1.0, abs=0.05)
    # Another base is another matter.
    other = Task(nominal.with_effect('torque_bias'), ('payload', None))
    halving.screen_beside([other], 'on top of another cause')
    assert asked[-1] == ('on top of another cause', 1)


def test_what_torques_ruled_out_stays_so_beside_small_faults():
    believed = finger.finger()
    train = finger.data(believed.with_effect('coulomb_friction', torque=1.1e-3), 2, 8.0)
    asked = []

    def carry_out(function, arguments, what):
        asked.append(len(arguments))
        return [function(*a) for a in arguments]

    halving = SuccessiveHalving(train, train, carry_out)
    rival = Rival(believed.with_effect('coulomb_friction', None), {}, {})
    model, bounds = with_nuisances(believed, [data_set.setup for data_set in train])
    plain = Task(believed, ('backlash', None), rival=rival)
    faulty = Task(model, ('backlash', None), bounds=bounds, rival=rival)
    for task in (plain, faulty):
        (look,) = halving.screen([task], 'look')
        assert np.isinf(look.error)
    assert asked == [1, 0]
    # Where nothing has to be beaten it gets a look of its own.
    assert (
        halving.screen_beside([replace(faulty, rival=None, bounds={})], 'look')[0].error < np.inf
    )


def test_an_event_is_sought_before_all_others_are_fitted(nominal):
    data_sets = _data_sets(nominal, _machine(nominal, PUSH), seconds=10.0)
    done = []

    def carry_out(function, arguments, what):
        done.append(what.rpartition(', ')[2])
        return [function(*a) for a in arguments]

    train, held = data_sets[:1], data_sets[1:]
    base = try_candidate(Task(nominal), train, held)
    task = Task(nominal, base=base.train)
    task = replace(task, first=first_seconds(task, train))
    names = ('external_push', 'gyro_bias', 'torque_bias', 'imu_offset')
    found, _ = SuccessiveHalving(train, held, carry_out).run(
        task, [(n, None) for n in names], 'race'
    )
    best = min(found, key=lambda o: o.train.normalised_error)
    assert best.label == 'external_push'
    assert best.held.normalised_error == pytest.approx(1.0, abs=0.05)
    assert done.index('events') == min(k for k, w in enumerate(done) if w in ('events', 'race'))


def test_a_base_is_led_out_of_a_local_minimum(nominal):
    """As play has many, what is put on top of it would seem to help."""
    train = _data_sets(nominal, _machine(nominal, ('torque_constant', {'error': 0.1})))
    model = nominal.with_effect('torque_constant')
    alone = Task(model, base=fit(model, train))
    alone = replace(alone, first=first_seconds(alone, train))
    stuck = replace(alone.first, mse=4 * alone.first.mse)
    effects = [('payload', None), ('torque_bias', None)]
    halving = SuccessiveHalving(train, train, _one_after_the_other)
    assert halving.lead_deeper(alone, effects, 'a fit at its minimum') is None
    warm_start = halving.lead_deeper(replace(alone, first=stuck), effects, 'a fit that is stuck')
    assert warm_start.normalised_error == pytest.approx(alone.first.normalised_error, rel=0.01)
    assert [u.name for u in warm_start.unknowns] == [u.name for u in alone.first.unknowns]
    # The first seconds fit, all of the record does not: from there it is tried again.
    lost = replace(alone, base=replace(alone.base, mse=4 * alone.base.mse))
    assert halving.lead_deeper(lost, effects, 'a fit that got lost') is alone.first
    # Where an effect leaves a hundredth of what the base does, that is what is missing.
    far = 0.9 * warm_start.normalised_error / settings.SCREENING.hopeless
    halving.screenings = {k: replace(look, error=far) for k, look in halving.screenings.items()}
    assert (
        halving.lead_deeper(replace(alone, first=stuck), effects, 'an effect is missing') is None
    )


def _one_after_the_other(function, arguments, what):
    return [function(*a) for a in arguments]


@pytest.mark.parametrize(('error', 'followed'), [(1.11, True), (3.5, False)])
def test_a_start_near_the_noise_is_followed_whatever_the_reach(
    nominal, monkeypatch, error, followed
):
    """Where only beliefs are at stake the reach is a hair above the noise, and looks are rough."""
    train = _data_sets(nominal, _machine(nominal), 2.0)
    found = fit(nominal.with_effect('payload'), train, iterations=2)
    starts = tuple(replace(found, mse=np.full_like(found.mse, e)) for e in (1.06, error))
    tried = []

    def whole(task, model, train, start, iterations):
        tried.append(start.normalised_error)
        return replace(start, converged=True)

    monkeypatch.setattr(whole_fit, '_whole', whole)
    monkeypatch.setattr(whole_fit, 'far', lambda fitted, bounds: {'leg_mass': 4.9})
    task = Task(nominal, ('payload', None), warm_starts=starts, reach=1.07)
    whole_fit._own_fit(task, train)
    assert tried == pytest.approx([1.06, error][: 1 + followed])


def test_what_explains_next_to_nothing_of_what_is_above_the_noise(nominal):
    base = fit(nominal, _data_sets(nominal, _machine(nominal), 2.0))
    leaving = replace(base, mse=np.full_like(base.mse, 1.06))
    assert worth_having(1.06, leaving) == worth_having(np.inf, leaving) == pytest.approx(1.06)
    assert worth_having(1.01, leaving) == pytest.approx(1.06 - 0.05 * settings.HALVING.idle)
    assert worth_having(1.01, None) == np.inf


def test_no_rotor_is_sought_where_only_beliefs_speak(nominal):
    train, held = ([data_set] for data_set in _data_sets(nominal, nominal, seconds=2.0))
    asked = []

    def carry_out(function, arguments, what):
        arguments = list(arguments)
        asked.extend(task.effect for task, *_ in arguments if isinstance(task, Task))
        return [function(*each) for each in arguments]

    found = fit(nominal, train)
    base = Task(nominal, base=found, first=found)
    effects = [('torque_bias', None), ('joint_flexibility', None), ('backlash', None)]
    halving = SuccessiveHalving(train, held, carry_out)
    outcomes, aside = halving.run_by_belief(base, effects, 'effects')
    assert {outcome.label for outcome in outcomes} == {'torque_bias'}
    assert set(asked) == {('torque_bias', None)}
    assert set(aside) == {'joint_flexibility', 'backlash'}


@pytest.fixture(scope='module')
def quick(nominal):
    """Training and held-out records, and a base with a look that leaves 60 variances."""
    train, held = ([d] for d in _data_sets(nominal, _machine(nominal), seconds=4.5))
    found = fit(nominal, train, iterations=2)
    first = replace(found, mse=np.full_like(found.mse, 60.0), horizon=2.0)
    return train, held, Task(nominal, base=first, first=first)


@pytest.mark.parametrize(
    ('rotor', 'ahead', 'fitted'),
    [
        # Share of what the best look explains: 5 of 45, then 30 of 45.
        (55.0, 15.0, {'torque_bias', 'payload'}),
        (30.0, 15.0, {'torque_bias', 'payload', 'backlash'}),
        # No look explains half of the error: the first seconds say little.
        (55.0, 40.0, {'torque_bias', 'payload', 'backlash'}),
    ],
)
def test_what_takes_long_waits_where_it_is_idle_beside_the_best_look(quick, rotor, ahead, fitted):
    train, held, base = quick
    tried = []

    def carry_out(function, arguments, what):
        tasks = [each[0] for each in arguments]
        if function is look.screen:
            looks = {'torque_bias': ahead, 'payload': 55.0, 'backlash': rotor}
            return [look.Screening(t.effect[0], t, looks[t.effect[0]]) for t in tasks]
        if function is undisturbed:
            return [(None, None)]
        tried.extend(t.effect[0] for t in tasks)
        return [Failure('not asked here') for _ in tasks]

    effects = [(name, None) for name in ('torque_bias', 'payload', 'backlash')]
    SuccessiveHalving(train, held, carry_out).run(base, effects, 'race')
    assert set(tried) == fitted


@pytest.mark.parametrize(
    ('behind', 'left', 'looked_at', 'waits'),
    [
        # Of the torques' deviance; what a fit of the one spoken for leaves of 60 variances.
        (101.0, 20.0, ['backlash'], True),
        (99.0, 20.0, ['backlash', 'joint_flexibility'], False),
        # It was not that.
        (101.0, 40.0, ['backlash', 'joint_flexibility'], False),
    ],
)
def test_a_rotor_that_torques_speak_less_for_waits(behind, left, looked_at, waits):
    believed = finger.finger()
    train = finger.data(believed.with_effect('backlash', gap=0.02), 2, 5.0)
    plain = try_candidate(Task(believed, iterations=1), train, train)
    first = replace(plain.train, mse=np.full_like(plain.train.mse, 60.0), horizon=2.0)
    said = {'backlash': 500.0, 'joint_flexibility': 500.0 + behind}
    looks = []

    def carry_out(function, arguments, what):
        tasks = [each[0] for each in arguments]
        if function is look.torque_fits:
            fitted = torque_error.fit_by_torque(believed, train)
            return [(replace(fitted, deviance=said[t.effect[0]]),) for t in tasks]
        if function is look.screen:
            looks.extend(t.effect[0] for t in tasks)
            return [look.Screening(t.effect[0], t, left) for t in tasks]
        if function is undisturbed:
            return [(None, None)]
        fits = replace(plain.train, mse=np.full_like(plain.train.mse, left))
        return [replace(plain, task=t, label=t.effect[0], train=fits) for t in tasks]

    effects = [(name, None) for name in said]
    base = Task(believed, base=first, first=first)
    found, aside = SuccessiveHalving(train, train, carry_out).run(base, effects, 'race')
    assert sorted(looks) == looked_at
    assert {o.label for o in found} == set(looked_at)
    assert bool(aside) == waits


@pytest.mark.parametrize(('missed', 'first'), [(41.0, 1), (39.0, 3)])
def test_what_moves_by_itself_is_looked_at_on_the_joint_that_stands_out(missed, first):
    robot = hanging_arm.nominal()
    train = prepare(robot, [hanging_arm.recorded(robot, 1.0, 1)])
    found = fit(robot, train, iterations=1)
    # What is left of hip, thigh and shank: four times as much of the shank, or nearly so.
    base = Task(robot, base=replace(found, mse=np.array([[10.0, 2.0, missed]])))
    tasks = [replace(base, effect=('backlash', joint)) for joint in robot.mechanism.coordinates]
    halving = SuccessiveHalving(train, train, lambda _, arguments, what: [()] * len(arguments))
    looked_at, waiting = halving._spoken_for(tasks, base, 'race')
    assert len(looked_at) == first
    assert ('backlash', 'shank_joint') in {task.effect for task in looked_at}
    assert len(looked_at) + len(waiting) == len(tasks)


@pytest.mark.parametrize(('left', 'deeper'), [(42.0, False), (40.0, True)])
def test_a_push_that_takes_little_is_not_sought_again(quick, left, deeper):
    train, held, base = quick  # 59 variances above the noise, of which a push may leave a third
    plain = try_candidate(Task(base.model, iterations=1), train, held)
    tried = []

    def carry_out(function, arguments, what):
        tried.extend(each[0].effect[0] for each in arguments)
        return [Failure('not asked here') for _ in arguments]

    def leaving(name):
        fit_ = replace(plain.train, mse=np.full_like(plain.train.mse, left), converged=False)
        task = replace(base, effect=(name, None))
        return replace(plain, task=task, label=name, train=fit_)

    found = {name: leaving(name) for name in ('external_push', 'torque_bias')}
    halving = SuccessiveHalving(train, held, carry_out)
    halving._in_more_depth(found, base.base, np.inf, np.inf, 'race')
    assert 'torque_bias' in tried
    assert ('external_push' in tried) == deeper


def test_a_look_at_a_law_without_states_goes_on_from_where_the_base_stands(quick):
    _, _, base = quick
    laws = {name: nominal_with(base.model, name) for name in ('torque_bias', 'backlash')}
    starts = {
        name: look._beside_base(replace(base, effect=(name, None)), model, [])
        for name, model in laws.items()
    }
    assert starts['backlash'] is None  # a rotor sets out from what the file believes
    known = dict(zip((u.name for u in base.first.unknowns), base.first.values, strict=True))
    found = starts['torque_bias']
    values = dict(zip((u.name for u in found.unknowns), found.values, strict=True))
    assert values == known | {'torque_bias.bias': values['torque_bias.bias']}


def nominal_with(model, name):
    """A model with an effect at its first start."""
    return next(starting_models(Task(model, (name, None))))


def test_first_looks_in_the_plane_take_coarse_steps(quick):
    train, _, base = quick
    screening = look.screen(replace(base, effect=('torque_bias', None)), train)
    (found, *_) = screening.task.warm_starts
    assert found.refinement == COARSE
    assert base.first.refinement == 1.0


def test_first_looks_at_a_robot_take_fine_steps():
    robot = finger.finger()
    found = fit(robot, finger.data(robot, 1), iterations=1, company=True)
    assert found.refinement == 1.0  # torques lead it so near that coarse steps would lead away


@pytest.mark.parametrize(('reach', 'lost'), [(5.9, True), (6.1, False)])
def test_three_steps_have_to_gain_a_third_of_what_is_lacking(reach, lost):
    # From 10 to 9 in three steps, unevenly: three times that leads to 6, and no further.
    assert out_of_reach([12.0, 10.0, 9.8, 9.5, 9.0], reach) == lost
    assert not out_of_reach([10.0, 9.8, 9.5], reach)  # too soon to tell
