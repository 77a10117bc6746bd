"""Doubt by itself: a cause's place is contested by numbers that are known, without any fit."""

from dataclasses import replace

import numpy as np
import pytest
from searches import search_for

from cg_dynamics.model import Model
from cg_sysid.deadline import OutOfTime
from cg_sysid.diagnosis import comparing, doubt, forward
from cg_sysid.diagnosis.comparing import done, less_shapes
from cg_sysid.diagnosis.doubt import exchange
from cg_sysid.search import settings
from cg_sysid.search.look import Screening
from cg_sysid.search.model_selection import Comparison, above_noise
from cg_sysid.search.nuisance import with_nuisances
from cg_sysid.search.task import Task
from cg_sysid.search.torque_screening import Scores
from cg_sysid.search.whole_fit import try_candidate

OWN, RIVAL = 'torque_bias', 'encoder_offset'


@pytest.fixture(scope='module')
def search(model_file):
    """A workspace, the nominal outcome, and those of two effects on top of it."""
    nominal = Model.load(model_file)
    machine = nominal.with_effect(OWN, bias=0.8)
    work = search_for(nominal, machine)
    base, own, rival = (
        try_candidate(Task(nominal, effect, iterations=8), work.train, work.held)
        for effect in (None, (OWN, None), (RIVAL, None))
    )
    return work, base, own, rival


def _contested(search, gap, reason=''):
    """What doubt makes of the cause if its rival has `gap` nats more evidence."""
    work, base, own, rival = search
    judged = work.selection.compare(base, [own, rival])
    ranked = {c.label: (c, o) for c, o in judged.ranked}
    best = settings.SELECTION.margin + 100.0
    pairs = [
        (replace(ranked[OWN][0], evidence=best, reason=reason), ranked[OWN][1]),
        (replace(ranked[RIVAL][0], evidence=best + gap, reason=''), ranked[RIVAL][1]),
    ]
    pairs.sort(key=lambda pair: -pair[0].evidence)
    work.comparisons[frozenset(), False] = Comparison(base, tuple(pairs), 100.0, 6.0)
    return exchange(work, base, own)


def test_a_cause_stays_beside_a_rival_within_the_margin(search):
    assert _contested(search, 5.0) is None
    assert _contested(search, -5.0) is None


def test_a_rival_beyond_the_margin_takes_the_place(search):
    assert _contested(search, 7.0).label == RIVAL


def test_what_is_not_earned_goes_for_what_is(search):
    assert _contested(search, -50.0, 'evidence 3 nats, 10 needed').label == RIVAL


def test_what_was_left_before_any_cause_is_known(search, monkeypatch):
    work, base, own, _ = search
    monkeypatch.setattr(work, 'comparisons', {})
    monkeypatch.setattr(work, 'torques', {})
    monkeypatch.setattr(work.selection, 'before_causes', np.inf)
    monkeypatch.setattr(comparing, 'done', lambda work, o: True)
    comparing.compare(work, own)
    assert work.selection.before_causes == np.inf
    comparing.compare(work, base)
    assert work.selection.before_causes == pytest.approx(above_noise(base))


@pytest.mark.parametrize(('white', 'ends'), [(0.6, True), (0.4, False)])
def test_beside_a_cause_half_white_is_white_enough(search, monkeypatch, white, ends):
    work, base, own, _ = search
    monkeypatch.setattr(comparing, 'settled', lambda o: True)
    monkeypatch.setattr(work.selection, 'imitated', lambda o: True)
    monkeypatch.setattr(work.selection, 'whiteness', lambda o: white)
    monkeypatch.setattr(work.selection, 'nothing_material', lambda o: False)
    assert done(work, own) == ends
    # Where no cause is there, small faults have to come to white noise.
    there = replace(own, model=base.model)
    assert not done(work, there)


def test_what_gives_the_law_of_a_cause_another_shape_is_no_second_cause(search):
    """Nothing fades near standstill: how it fades is not determined."""
    work, base, _, _ = search
    lossy, other = (
        try_candidate(Task(base.model, (name, None), iterations=2), work.train, work.held)
        for name in ('quadratic_friction', 'payload')
    )
    for cause, told in ((lossy, True), (other, False)):
        faded = try_candidate(
            Task(cause.model, ('stribeck_friction', None), iterations=2), work.train, work.held
        )
        comparison = work.selection.compare(cause, [faded])
        ((candidate, _),) = comparison.ranked
        earned = replace(comparison, ranked=((replace(candidate, reason=''), faded),))
        # A law of the same kind at the same joint; a load is none.
        assert 'stribeck_friction.stribeck_rate' in faded.train.undetermined
        reason = less_shapes(work, earned).ranked[0][0].reason
        assert ('gives the law of quadratic_friction another shape' in reason) == told


def test_a_second_law_whose_numbers_are_known_may_be_a_second_cause(search):
    work, base, _, _ = search
    lossy = try_candidate(
        Task(base.model, ('quadratic_friction', None), iterations=2), work.train, work.held
    )
    faded = try_candidate(
        Task(lossy.model, ('stribeck_friction', None), iterations=2), work.train, work.held
    )
    known = replace(
        faded, train=replace(faded.train, covariance=np.zeros_like(faded.train.covariance))
    )
    assert not known.train.undetermined
    comparison = work.selection.compare(lossy, [known])
    ((candidate, _),) = comparison.ranked
    earned = replace(comparison, ranked=((replace(candidate, reason=''), known),))
    assert less_shapes(work, earned) is earned


@pytest.mark.parametrize(('imitated', 'white', 'all_of_them'), [
    (True, 0.6, False), (True, 0.4, True), (False, 0.6, True),
])  # fmt: skip
def test_beside_small_faults_that_imitate_all_but_white_noise_no_rotor_is_sought(
    search, monkeypatch, imitated, white, all_of_them
):
    work, base, _, _ = search
    monkeypatch.setattr(work.selection, 'imitated', lambda o: imitated)
    monkeypatch.setattr(work.selection, 'whiteness', lambda o: white)
    light = [('payload', None), ('stribeck_friction', None), ('presliding_friction', None)]
    moving = [('joint_flexibility', None), ('backlash', None), ('actuator_lag', None)]
    # How dry friction gives way before it slides is what sound machines have.
    left = comparing.beside_imitation(work, base, [*moving, *light])
    assert left == ([*moving, *light] if all_of_them else light)


@pytest.mark.parametrize(
    ('share', 'by_law', 'taken_up'),
    [(0.85, False, True), (0.95, False, False), (0.85, True, True)],
)
def test_small_faults_that_waited_are_taken_up_where_no_cause_was_found(
    search, monkeypatch, share, by_law, taken_up
):
    work, base, own, rival = search
    train, held = (
        replace(fit, mse=share * fit.mse + (1 - share)) for fit in (base.train, base.held)
    )
    bounds = {'actuator_delay.delay': 1e-3}
    waiting = replace(base, train=train, held=held, task=Task(base.model, bounds=bounds))
    assert above_noise(waiting) == pytest.approx(share * above_noise(base))
    asked = []

    def raced(work, o):
        asked.append(o)
        work.law = rival if by_law and o is waiting else None
        return o, own if o is waiting and not by_law else None

    work.faulty[frozenset()] = waiting
    monkeypatch.setattr(forward, 'with_small_faults', lambda work, o: o)
    monkeypatch.setattr(forward, 'raced', raced)
    monkeypatch.setattr(forward, 'refitted', lambda work, o: o)
    monkeypatch.setattr(forward, 'rather_one_cause', lambda *_: None)
    found = forward.extend(work, base)
    work.faulty.clear()
    # A law that sound machines follow stands on top of the small faults, and they with it.
    assert found is work.found is ((waiting if by_law else own) if taken_up else base)
    work.law = None
    assert asked[:2] == ([base, waiting] if taken_up else [base])


@pytest.fixture
def raced(search):
    """Small faults beside a base, and first looks at three effects on top of the base alone."""
    work, base, _, _ = search
    model, bounds = with_nuisances(base.model, work.setups())
    lean = replace(base, model=model, task=Task(model, bounds=bounds))
    work.comparisons[frozenset(), False] = Comparison(base, (), 100.0, 6.0)
    work.halving.screenings.clear()
    for effect, error in ((OWN, 4.0), (RIVAL, 39.0), ('payload', 41.0)):
        task = Task(base.model, (effect, None))
        work.halving.screenings[effect,] = Screening(effect, task, error)
    yield work, lean
    work.halving.screenings.clear()
    work.comparisons.clear()


def test_beside_small_faults_who_was_ten_times_worse_does_not_race_again(raced):
    work, lean = raced
    outrun = doubt.outrun(work, lean, OWN)
    assert [name for name, _ in outrun] == ['payload']
    # From the point of view of the second, nobody is far behind.
    assert not doubt.outrun(work, lean, RIVAL)


def test_who_was_ruled_out_by_torques_does_not_race_again(raced, monkeypatch):
    work, lean = raced
    asked = [(OWN, None), (RIVAL, None), ('payload', None)]
    said = Scores({('torque_constant', None): 0.0}, {effect: 100.0 for effect in asked}, ('hip',))
    monkeypatch.setitem(work.torques, (frozenset(), False), said)
    outrun = doubt.outrun(work, lean, OWN)
    assert {('payload', None), ('torque_constant', None)} < set(outrun)
    assert not {(OWN, None), (RIVAL, None)} & set(outrun)


def test_without_a_race_before_all_race(raced):
    work, lean = raced
    bare = replace(lean, task=replace(lean.task, bounds={}))
    assert not doubt.outrun(work, bare, OWN)
    work.comparisons.clear()
    assert not doubt.outrun(work, lean, OWN)


def test_few_that_are_left_need_no_torques(raced, monkeypatch):
    work, lean = raced
    monkeypatch.setattr(comparing, 'scores', lambda *_: pytest.fail('torques were asked'))
    every = comparing.effects_on(work, lean)
    few = comparing.worth_a_look(work, lean, every[3:])
    assert few == every[:3]


def test_torques_asked_of_some_are_not_kept_for_all(raced, monkeypatch):
    work, lean = raced
    monkeypatch.setattr(comparing, 'scores', lambda model, train, effects, *_: None)
    every = comparing.effects_on(work, lean)
    assert comparing.worth_a_look(work, lean, every[:1]) == every[1:]
    assert not work.torques
    assert comparing.worth_a_look(work, lean) == every
    assert list(work.torques) == [(frozenset(), True)]
    work.torques.clear()


def test_doubt_beside_small_faults_goes_on_from_what_is_known(raced, search, monkeypatch):
    work, lean = raced
    own = search[2]
    model, bounds = with_nuisances(own.model, work.setups())
    final = replace(own, model=model, task=Task(model, bounds=bounds))
    monkeypatch.setitem(work.faulty, frozenset(), lean)
    fitted, compared = [], []

    def fit(tasks, what):
        fitted.extend(tasks)
        return [lean]

    def compare(work, base, beaten, idle):
        compared.extend(idle)
        work.comparisons[frozenset(), True] = Comparison(base, (), 100.0, 6.0)

    monkeypatch.setattr(work.halving, 'fit', fit)
    monkeypatch.setattr(doubt, 'compare', compare)
    doubt.without(work, lean, final, OWN)
    ((start,),) = (task.warm_starts for task in fitted)
    known = {u.name: v for u, v in zip(lean.train.unknowns, lean.train.values, strict=True)}
    assert {u.name: v for u, v in zip(start.unknowns, start.values, strict=True)}.items() >= (
        known.items()
    )
    assert compared == list(doubt.outrun(work, lean, OWN))
    assert ('payload', None) in compared


def test_an_answer_before_the_end_has_the_small_faults_that_were_found(raced, search, monkeypatch):
    work, lean = raced

    def out_of_time(*_):
        raise OutOfTime

    monkeypatch.setattr(forward, 'with_small_faults', lambda work, o: lean)
    monkeypatch.setattr(forward, 'finished', lambda *_: False)
    monkeypatch.setattr(forward, 'done', out_of_time)
    with pytest.raises(OutOfTime):
        forward.extend(work, search[1])
    assert work.found is lean


def test_what_later_causes_have_left_nothing_of_goes_without_a_race(search, monkeypatch):
    work, base, _, _ = search
    train, held = work.train, work.held
    own = try_candidate(Task(base.model, (OWN, None), iterations=60), train, held)
    final = try_candidate(Task(own.model, ('torque_constant', None), iterations=60), train, held)
    monkeypatch.setattr(work, 'comparisons', {})
    monkeypatch.setattr(doubt, 'compare', lambda *_: pytest.fail('the library raced'))
    fitted = []

    def fit(tasks, what):
        fitted.extend(tasks)
        return [own]

    monkeypatch.setattr(work.halving, 'fit', fit)
    gone = doubt.without(work, base, final, 'torque_constant')
    assert gone.base is own
    assert gone.winner() is None
    # The bias sets out from where it is, not from none.
    ((start,),) = (task.warm_starts for task in fitted)
    assert start.numbers[f'{OWN}.bias'] == pytest.approx(0.8, abs=0.05)
