"""What every robot has a little of is no cause, and hides none."""

import math
from dataclasses import replace
from types import SimpleNamespace

import hanging_arm
import pytest
from searches import search_for

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_sysid.deadline import Deadline
from cg_sysid.diagnosis import small_faults
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.identification.unknowns import unknowns_of
from cg_sysid.search import settings, whole_fit
from cg_sysid.search.look import screen
from cg_sysid.search.model_selection import Comparison, at_noise
from cg_sysid.search.nuisance import SOUND, as_sound_robots, nuisances, with_nuisances
from cg_sysid.search.outcome import Outcome, one_minimum
from cg_sysid.search.task import Task
from cg_sysid.search.whole_fit import try_candidate

EFFECTS = (
    'torque_bias', 'encoder_offset', 'actuator_delay', 'actuator_lag', 'quadratic_friction',
    'spring_stiffness', 'imu_offset', 'viscous_friction',
)  # fmt: skip


def _springs(stiffness):
    pair = (Spring('inner', 1.0, (x, 1.0), stiffness, 0.5) for x in (1.3, -1.3))
    return Setup(springs=tuple(pair))


def _records(machine, duration=4.0):
    """Four records on springs 1 % stiffer than their notes say."""
    return _records_on(machine, _springs(202.0), duration)


def _records_on(machine, setup, duration=4.0):
    found = []
    for k in range(4):
        record = rehearse(
            f'record_{k}', machine, setup, [0.1 - 0.07 * k, -0.1, 0.3, -0.5],
            [lambda t, k=k: 9.0 * math.sin(2 * math.pi * (0.4 + 0.1 * k + 0.15 * t) * t)],
            duration, 0.004, k,
        )  # fmt: skip
        found.append(replace(record, setup=_springs(200.0)))
    return found


def _with_small_faults(machine):
    key = 'coulomb_friction.transition_rate'
    machine = machine.with_values({key: 0.5 * machine.values[key]})
    return machine.with_effect('actuator_delay', delay=0.001).with_effect(
        'encoder_offset', offset=3e-4
    )


@pytest.fixture
def nominal(model_file):
    return Model.load(model_file)


@pytest.mark.slow
def test_small_faults_alone_are_consistent(nominal):
    machine = _with_small_faults(nominal.with_values({'c4': 1.08 * nominal.values['c4']}))
    found = diagnose(nominal, _records(machine), Options(effects=EFFECTS, workers=1))
    assert found.verdict == 'consistent'
    # They are many times the noise all the same, and found to be what they are.
    assert found.baseline.held.normalised_error > 10
    assert any(f.startswith('actuator_delay.delay = ') for f in found.findings)
    identified = found.extended.train.model.values['actuator_delay.delay']
    assert identified == pytest.approx(0.001, rel=0.05)  # a quarter of a sample


@pytest.mark.evidence
@pytest.mark.slow
def test_hard_friction_is_consistent(nominal):
    """Friction that turns fifty times as fast as the model was drawn."""
    key = 'coulomb_friction.transition_rate'
    machine = nominal.with_values({key: nominal.values[key] / 50})
    found = diagnose(nominal, _records(machine), Options(effects=EFFECTS, workers=1))
    assert found.verdict == 'consistent'
    values = found.extended.train.model.values
    assert values[key] < nominal.values[key] / 20


def test_friction_gets_ever_harder_but_no_softer_than_its_leeway(nominal):
    key = 'coulomb_friction.transition_rate'
    for bound, factor in ((math.log(5.0), 5.0), (math.log(100.0), 100.0)):
        found = next(u for u in unknowns_of(nominal, bounds={key: bound}) if u.name == key)
        assert found.lower == pytest.approx(nominal.values[key] / factor)
        assert found.upper == pytest.approx(nominal.values[key] * 5.0)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('effect', 'values'),
    [
        pytest.param('torque_bias', {'bias': 0.3}, marks=pytest.mark.evidence),
        pytest.param('encoder_offset', {'offset': 0.012}, marks=pytest.mark.evidence),
        ('actuator_delay', {'delay': 0.008}),
        pytest.param('quadratic_friction', {'coefficient': 0.2}, marks=pytest.mark.evidence),
    ],
)
def test_a_cause_is_named_among_small_faults(nominal, effect, values):
    machine = nominal
    for name, value in (('actuator_delay', 0.001), ('encoder_offset', 3e-4)):
        if name != effect:
            machine = machine.with_effect(name, None, **{SOUND[name][0]: value})
    machine = machine.with_effect(effect, None, **values)
    found = diagnose(nominal, _records(machine), Options(effects=EFFECTS, workers=1))
    assert [cause.label for cause in found.causes] == [effect]
    for name, true in values.items():
        value, sigma, _ = found.causes[0].parameters[name]
        # Four standard deviations, and what integrators differ by.
        assert abs(value - true) < 4 * sigma + 5e-3 * abs(true)


FRICTIONS = ('stribeck_friction', 'presliding_friction', 'quadratic_friction', 'torque_bias')


def _with_bristles(machine):
    return machine.with_effect(
        'presliding_friction', None, torque=0.4, deflection=2.1e-3, damping=0.5
    )


@pytest.mark.slow
def test_friction_that_gives_way_a_little_is_consistent(nominal):
    records = _records(_with_bristles(nominal), 12.0)
    found = diagnose(nominal, records, Options(effects=FRICTIONS, workers=1))
    assert found.baseline.held.normalised_error > settings.NOISE.quick
    assert (found.verdict, found.causes) == ('consistent', ())
    assert any(f.startswith('presliding_friction.deflection = ') for f in found.findings)


@pytest.mark.evidence
@pytest.mark.slow
def test_friction_that_gives_way_a_little_is_no_cause_and_hides_none(nominal):
    """Bristles as sound machines have them, on top of Stribeck friction that nobody stated."""
    machine = _with_bristles(nominal).with_effect(
        'stribeck_friction', None, torque=1.0, stribeck_rate=0.6
    )
    records = _records(machine, 12.0)
    found = diagnose(nominal, records, Options(effects=FRICTIONS, workers=1))
    assert [cause.label for cause in found.causes] == ['stribeck_friction']
    assert any(f.startswith('presliding_friction.deflection = ') for f in found.findings)
    value, sigma, _ = found.causes[0].parameters['torque']
    # Four standard deviations, and what integrators differ by.
    assert abs(value - 1.0) < 4 * sigma + 5e-3
    assert found.extended.held.normalised_error < settings.NOISE.quick


@pytest.mark.parametrize(
    ('deflection', 'left', 'cause', 'ends'),
    [
        (2e-3, 0.4, None, True),
        (2e-3, 5.0, None, False),
        (4e-3, 0.4, None, False),
        (2e-3, 0.1, 80.0, True),
        (2e-3, 0.4, 80.0, False),  # it may leave that cause
        (2e-3, 0.1, 120.0, False),
    ],
)
def test_such_friction_ends_the_search_only_near_the_noise(
    nominal, monkeypatch, deflection, left, cause, ends
):
    """Evidence 100 nats for it, `cause` for another that is earned."""
    name = 'presliding_friction'
    above = {'base': 100.0, name: left}  # chi2/N less 1
    monkeypatch.setattr(small_faults, 'above_noise', lambda o: above[o.label])
    monkeypatch.setattr(small_faults, 'at_noise', lambda o: above[o.label] < 0.3)
    sizes = {'deflection': (deflection, 2e-5, 'rad')}
    model = nominal.with_effect(name, None, torque=0.4, deflection=deflection)
    fit_there = SimpleNamespace(model=model)
    o = Outcome(
        Task(nominal, (name, None)), name, model, fit_there, fit_there, (), 0.0, 0, {}, ((), ()),
    )  # fmt: skip
    reason = '; '.join(as_sound_robots(name, sizes))
    law = SimpleNamespace(label=name, parameters=sizes, reason=reason, evidence=100.0)
    ranked = [(law, o)]
    if cause is not None:
        other = SimpleNamespace(label='torque_bias', parameters={}, reason='', evidence=cause)
        ranked.append((other, replace(o, label='base')))
    comparison = Comparison(replace(o, label='base'), tuple(ranked), independent=1e3, margin=6.0)
    assert (small_faults.sound_law(comparison) is not None) == ends


@pytest.mark.slow
def test_small_faults_that_leave_no_white_noise_have_imitated_a_cause(nominal):
    """Together they come to the noise, and no cause without them does."""
    machine = nominal.with_effect('actuator_delay', delay=0.001)
    found = diagnose(nominal, _records(machine.with_effect('torque_bias', bias=0.06)),
                     Options(effects=EFFECTS, workers=1))  # fmt: skip
    assert [(cause.label, cause.rivals) for cause in found.causes] == [('torque_bias', ())]
    value, sigma, _ = found.causes[0].parameters['bias']
    assert abs(value - 0.06) < 4 * sigma < 0.01
    # What is left of the small faults is what was there.
    identified = found.extended.train.model.values
    assert identified['actuator_delay.delay'] == pytest.approx(0.001, rel=0.05)
    assert identified.get('imu_offset.offset', 0.0) == pytest.approx(0.0, abs=2e-4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('coefficient', 'told'),
    [
        pytest.param(0.006, 'where no small fault does', marks=pytest.mark.evidence),
        (0.008, 'a small cause may hide behind them'),
    ],
)
def test_what_hides_behind_small_faults_and_is_small_itself_is_no_cause(
    nominal, coefficient, told
):
    machine = nominal.with_effect('actuator_delay', delay=0.001)
    machine = machine.with_effect('quadratic_friction', coefficient=coefficient)
    found = diagnose(nominal, _records(machine, 5.0), Options(effects=EFFECTS, workers=1))
    # Nor is the delay, or a lag that looks like it: that small it is a small fault.
    assert (found.verdict, found.causes) == ('consistent', ())
    reasons = [c.reason for r in found.rounds for c in r.candidates
               if c.label == 'quadratic_friction']  # fmt: skip
    assert any(told in words for words in (*reasons, *found.findings))


PULLED = ('tether_force', 'torque_bias', 'encoder_offset', 'quadratic_friction')


def test_a_tether_and_two_springs_that_conspire_are_not_told_apart(nominal):
    machine = nominal.with_effect('tether_force', force=3.0)
    records = _records_on(machine, _springs(200.0))
    experiments = (load_experiment('legs_tied'),)
    options = Options(effects=PULLED, workers=1, experiments=experiments)
    found = diagnose(nominal, records, options)
    assert found.verdict == 'ambiguous'
    rivals = {'spring_stiffness', 'spring_stiffness@spring1'}
    assert [(c.label, set(c.rivals)) for c in found.causes] == [('tether_force', rivals)]
    # Nor would the same springs in another pose: recorded, legs_tied leaves the two as they are.
    assert found.causes[0].proposals[0].experiment == 'legs_tied'
    assert found.causes[0].proposals[0].evidence < settings.SELECTION.margin


@pytest.mark.evidence
@pytest.mark.slow
def test_what_small_faults_take_a_part_of_is_not_small_itself(nominal):
    """Of a tether two springs may be any part that their bounds allow: its force is uncertain."""
    records = _records(nominal.with_effect('tether_force', force=5.0))
    options = Options(effects=(*PULLED, 'spring_stiffness'), workers=1)
    found = diagnose(nominal, records, options)
    assert found.verdict == 'ambiguous'
    (cause,) = found.causes
    assert 'tether_force' in (cause.label, *cause.rivals)
    assert {label.partition('@')[0] for label in (cause.label, *cause.rivals)} == {
        'tether_force', 'spring_stiffness',
    }  # fmt: skip


def test_springs_that_do_not_conspire_are_no_tether(nominal):
    left, right = _springs(200.0).springs
    uneven = replace(left, stiffness=202.0), replace(right, stiffness=198.6)
    records = _records_on(nominal, Setup(springs=uneven))
    records = [replace(record, setup=_springs(200.0)) for record in records]
    found = diagnose(nominal, records, Options(effects=PULLED, workers=1))
    assert (found.verdict, found.causes) == ('consistent', ())


@pytest.mark.slow
@pytest.mark.parametrize(
    ('effect', 'values', 'shape', 'rival'),
    [
        pytest.param('stribeck_friction', {'torque': 0.9, 'stribeck_rate': 0.3}, ('exponent', 1.0),
                     'quadratic_friction', marks=pytest.mark.evidence),
        ('torque_saturation', {'limit': 6.5}, ('roundness', 1.5), 'torque_constant'),
        pytest.param('position_dependent_friction', {'torque': 3.5, 'tightest': 0.4},
                     ('cycles', 2.0), 'asymmetric_friction', marks=pytest.mark.evidence),
    ],
)  # fmt: skip
def test_an_effect_by_another_law_is_that_effect_and_not_two(
    nominal, effect, values, shape, rival
):
    """Texts differ in how friction fades and motors saturate; their machines have one cause."""
    name, true = shape
    machine = nominal.with_effect(effect, None, **values, **{name: true})
    found = diagnose(nominal, _records_on(machine, _springs(200.0)),
                     Options(effects=(effect, rival, 'viscous_friction'), workers=1))  # fmt: skip
    assert [(c.label, c.rivals) for c in found.causes] == [(effect, ())]
    assert found.extended.held.normalised_error < 1.1
    value, sigma, _ = found.causes[0].parameters[name]
    assert abs(value - true) < 4 * sigma < 0.4 * true


def test_what_moves_beside_one_joint_does_not_contest_small_faults_at_others():
    """Friction that bends sharply at thigh and shank, of an arm of three joints."""
    levels = {f'coulomb_friction@{joint}.torque': 0.2 for joint in ('thigh_joint', 'shank_joint')}
    believed = hanging_arm.nominal().with_values(levels)
    machine = believed.with_values({
        f'coulomb_friction@{joint}.slow_share': 1.0 for joint in ('thigh_joint', 'shank_joint')
    })  # fmt: skip
    train, held = (
        prepare(believed, [hanging_arm.recorded(machine, 4.0, seed) for seed in seeds])
        for seeds in ((1, 3, 4), (2,))
    )
    work = Workspace(believed, train, held, Options(workers=1), lambda *_: None, None, Deadline())
    model, bounds = with_nuisances(believed, work.setups())
    plain, faulty = (
        try_candidate(task, train, held) for task in (Task(believed), Task(model, bounds=bounds))
    )
    off = {name.rpartition('.')[0] for name in small_faults.shapes_off(faulty, faulty.model)}
    assert {f'coulomb_friction@{joint}' for joint in ('thigh_joint', 'shank_joint')} <= off
    assert at_noise(faulty)
    idle = small_faults.beside_one_joint(work, plain, faulty)
    assert ('backlash', 'thigh_joint') in idle
    assert ('presliding_friction', 'hip_joint') in idle
    assert not {'stribeck_friction', 'torque_bias', 'actuator_delay'} & {name for name, _ in idle}
    # Where they leave more than noise anything may be behind them.
    assert small_faults.beside_one_joint(work, plain, plain) == []


def test_a_fit_with_small_faults_that_goes_astray_goes_on_from_the_one_without(
    nominal, monkeypatch
):
    """From the numbers of the file it may be broken off far from the data."""
    machine = _with_small_faults(nominal)
    train, held = (prepare(nominal, records) for records in (_records(machine)[:3],
                                                             _records(machine)[3:]))  # fmt: skip
    work = Workspace(nominal, train, held, Options(workers=1), lambda *_: None, None, Deadline())
    plain = try_candidate(Task(nominal), train, held)
    assert not at_noise(plain)

    def astray(task, data_sets):
        far = task.model.with_values({'coulomb_friction.torque': 9.0})
        return fit(far, data_sets, only=(), bounds=task.bounds)

    monkeypatch.setattr(whole_fit, '_own_fit', astray)
    found = small_faults.with_small_faults(work, plain)
    assert at_noise(found)


@pytest.mark.parametrize(('times', 'asked'), [(20.0, False), (10.0, True)])
def test_no_fit_without_a_small_fault_is_asked_where_that_is_clear(
    nominal, monkeypatch, times, asked
):
    work = search_for(nominal, nominal)
    model = nominal.with_effect('actuator_delay').with_effect('imu_offset')
    bounds = {'actuator_delay.delay': 1.2e-3, 'imu_offset.offset': 2e-3}
    final = try_candidate(Task(model, bounds=bounds), work.train, work.held)
    sizes = {'actuator_delay': {'delay': (times * 1e-5, 1e-5, 's')},
             'imu_offset': {'offset': (1e-4, 1e-4, 'rad')}}  # fmt: skip
    monkeypatch.setattr(small_faults, 'parameters_of', lambda o, label: sizes[label])
    taken = []

    def without(work, o, gone, reach):
        taken.append(gone)

    monkeypatch.setattr(small_faults, 'without_small_faults', without)
    assert small_faults.less_small_faults(work, final) is final
    both, idle = ['actuator_delay', 'imu_offset'], ['imu_offset']
    assert taken == ([both, idle] if asked else [idle])


def test_small_faults_stay_within_their_bounds(nominal):
    model, bounds = with_nuisances(nominal, [_springs(200.0)])
    assert nuisances(model, bounds) == {
        'actuator_delay', 'encoder_offset', 'imu_offset', 'spring_stiffness',
        'spring_stiffness@spring1',
    }  # fmt: skip
    # What the file itself states is no small fault.
    stated = nominal.with_effect('encoder_offset', offset=0.01)
    assert 'encoder_offset' not in nuisances(*with_nuisances(stated, [_springs(200.0)]))


def test_other_starts_of_a_cause_have_the_unknowns_of_its_fit(nominal):
    """A friction with a smoothing of its own, which is a small fault even where it is a cause."""
    machine = nominal.with_effect('asymmetric_friction', excess=0.3)
    data_sets = prepare(nominal, _records(machine, 5.0)[:2])
    effect = ('asymmetric_friction', None)
    model, bounds = with_nuisances(nominal.with_effect(*effect), [_springs(200.0)])
    assert 'asymmetric_friction.transition_rate' in bounds
    whole = fit(model, data_sets, bounds=bounds, iterations=2)
    task = Task(model.without_effect(effect[0]), effect, bounds=bounds)
    warm_start = screen(task, data_sets).task.warm_starts[0]
    assert {u.name for u in warm_start.unknowns} == {u.name for u in whole.unknowns}
    assert one_minimum(whole, whole, effect[0])
    # Fits of other structures are compared too, and are not one minimum.
    assert not one_minimum(whole, fit(nominal, data_sets, iterations=2), effect[0])


@pytest.mark.parametrize('late', ['actuator_delay', 'sensor_delay'])
def test_a_small_delay_is_no_cause_where_only_beliefs_speak_for_it(nominal, late):
    """At the noise, but with numbers that a confident file does not believe."""
    sure = replace(nominal, quantities={
        name: replace(q, tolerance=0.1 * q.tolerance) if q.tolerance else q
        for name, q in nominal.quantities.items()
    })  # fmt: skip
    records = [
        rehearse(
            f'record_{k}', nominal.with_effect(late, delay=0.001), _springs(200.0),
            [0.03 - 0.02 * k, -0.03, 0.09, -0.15],
            [lambda t, k=k: 2.7 * math.sin(2 * math.pi * (0.4 + 0.1 * k + 0.15 * t) * t)],
            4.0, 0.004, k,
        )
        for k in range(4)
    ]  # fmt: skip
    effects = ('actuator_delay', 'sensor_delay', 'actuator_lag', 'torque_bias')
    found = diagnose(sure, records, Options(effects=effects, workers=1))
    assert (found.verdict, found.causes) == ('consistent', ())


@pytest.mark.parametrize(
    ('label', 'sizes', 'small'),
    [
        ('actuator_delay', {'delay': (1.2e-3, 1e-5, 's')}, True),
        ('sensor_delay@imu', {'delay': (-1.1e-3, 1e-5, 's')}, True),
        ('sensor_delay', {'delay': (1.3e-3, 1e-5, 's')}, False),
        ('encoder_offset', {'offset': (-5e-4, 1e-5, 'rad')}, True),
        ('torque_bias', {'bias': (1e-6, 1e-7, 'N m')}, False),
        ('actuator_delay', {}, False),
        (
            'presliding_friction',
            {'torque': (0.6, 1e-3, 'N m'), 'deflection': (2e-3, 2e-5, 'rad')},
            True,
        ),
        (
            'presliding_friction',
            {'torque': (0.6, 1e-3, 'N m'), 'deflection': (4e-3, 2e-5, 'rad')},
            False,
        ),
    ],
)
def test_no_cause_is_as_small_as_a_small_fault(label, sizes, small):
    assert bool(as_sound_robots(label, sizes)) == small


def test_behind_steps_of_a_drive_a_small_delay_is_one_of_the_readings(model_file):
    """What acts before a staircase has no slope by its delay: a fit does not find it."""
    nominal = Model.load(model_file)
    stepped = nominal.with_effect('torque_quantisation', step=1.17)
    machine = stepped.with_effect('sensor_delay', delay=1e-3)
    data_sets = prepare(nominal, _records_on(machine, _springs(200.0)))
    model, bounds = with_nuisances(stepped, [data_sets[0].setup])
    assert 'sensor_delay.delay' in bounds
    assert not any(name.startswith(('actuator_delay', 'sensor_delay@')) for name in bounds)
    found = fit(model, data_sets, bounds=bounds)
    late = dict(zip((u.name for u in found.unknowns), found.values, strict=True))
    assert late['sensor_delay.delay'] == pytest.approx(1e-3, abs=1e-4)
    assert found.normalised_error < 1.1

    before = stepped.with_effect('actuator_delay', delay=1e-6)
    names = {'torque_quantisation.roundness', 'actuator_delay.delay'}
    bounds = {n: b for n, b in bounds.items() if n in names} | {'actuator_delay.delay': 1.2e-3}
    assert fit(before, data_sets, bounds=bounds).normalised_error > 2
