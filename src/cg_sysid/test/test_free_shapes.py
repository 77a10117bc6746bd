"""Laws of one friction are compared once each may turn about rest as the machine does."""

from dataclasses import replace

import hanging_arm
import numpy as np
import pytest
from searches import search_for

from cg_dynamics.model import Model
from cg_sysid.deadline import Deadline
from cg_sysid.diagnosis import free_shapes, small_faults
from cg_sysid.diagnosis.free_shapes import (
    compared_with_free_shapes,
    with_mixed_friction,
    with_shapes_of_causes,
)
from cg_sysid.diagnosis.result import Options
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.identification.data_set import prepare
from cg_sysid.search import settings
from cg_sysid.search.model_selection import Comparison, settled
from cg_sysid.search.nuisance import with_nuisances
from cg_sysid.search.outcome import chi2
from cg_sysid.search.ranking import effect_name
from cg_sysid.search.starts import started_from
from cg_sysid.search.task import Task
from cg_sysid.search.whole_fit import try_candidate

TRUE, OTHER = 'coulomb_friction', 'position_dependent_friction'
SURELY = 3.3  # standard deviations: 99.9 % of intervals hold
HARD = 3e-4  # rad/s, over which the machine's friction turns; the law of a candidate takes 0.01


@pytest.fixture(scope='module')
def search(model_file):
    """A workspace, and a comparison in which the wrong law is ahead."""
    nominal = Model.load(model_file)
    for effect in nominal.effects:
        if effect.friction == 'dry':
            nominal = nominal.without_effect(effect.label)
    machine = nominal.with_effect(TRUE, torque=2.3, transition_rate=HARD)
    work = search_for(nominal, machine)
    base = try_candidate(Task(nominal), work.train, work.held)
    found = [try_candidate(Task(nominal, (name, None), base=base.train), work.train, work.held)
             for name in (TRUE, OTHER)]  # fmt: skip
    return work, work.selection.compare(base, found)


def _led_by(comparison, name):
    """The comparison with that law 25 nats ahead of all others, which leave twice the error."""
    best = 25.0 + max(c.evidence for c, _ in comparison.ranked)
    (leader,) = (o for c, o in comparison.ranked if effect_name(c.label) == name)

    def leaving_twice(o):
        times = 2 * chi2(leader) / chi2(o)
        return replace(
            o, train=replace(o.train, mse=times * o.train.mse),
            held=replace(o.held, mse=times * o.held.mse),
        )  # fmt: skip

    pairs = [
        (replace(c, reason='', evidence=best), o)
        if o is leader
        else (replace(c, reason=''), leaving_twice(o))
        for c, o in comparison.ranked
    ]
    return replace(comparison, ranked=tuple(sorted(pairs, key=lambda pair: -pair[0].evidence)))


def test_the_law_that_fits_with_its_shape_let_go_is_first(search, monkeypatch):
    work, comparison = search
    # Else the simpler one of the two is taken at once where so much is unexplained.
    monkeypatch.setattr(settings, 'SELECTION', replace(settings.SELECTION, far_off=np.inf))
    wrong = _led_by(comparison, OTHER)
    assert wrong.winner()[1].train.normalised_error > settings.NOISE.quick
    free = compared_with_free_shapes(work, wrong)
    assert effect_name(free.winner()[0].label) == TRUE
    assert (
        'once each may turn about rest as it likes' in free.of(wrong.winner()[0].label)[0].reason
    )
    # What is kept has the shape that the model states: small faults let it go later.
    (kept,) = (o for c, o in free.ranked if effect_name(c.label) == TRUE)
    assert not kept.task.bounds


def test_the_right_law_stays_ahead(search):
    work, comparison = search
    right = _led_by(comparison, TRUE)
    assert compared_with_free_shapes(work, right).winner()[0].label == right.winner()[0].label


def test_near_the_noise_shapes_are_not_let_go(search, monkeypatch):
    work, comparison = search
    wrong = _led_by(comparison, OTHER)
    label, fit = wrong.winner()[0].label, wrong.winner()[1].train
    near = replace(fit, mse=np.full_like(fit.mse, settings.NOISE.quick - 0.1))
    ranked = tuple((c, replace(o, train=near) if c.label == label else o) for c, o in wrong.ranked)
    near_noise = replace(wrong, ranked=ranked)
    monkeypatch.setattr(work.halving, 'fit', None)
    assert compared_with_free_shapes(work, near_noise) is near_noise


def test_where_shapes_are_free_already_nothing_is_fitted(search, monkeypatch):
    work, comparison = search
    wrong = _led_by(comparison, OTHER)
    base = replace(
        wrong.base, task=replace(wrong.base.task, bounds={'actuator_delay.delay': 1e-3})
    )
    monkeypatch.setattr(work.halving, 'fit', None)
    known = replace(wrong, base=base)
    assert compared_with_free_shapes(work, known) is known


def _level(o):
    names = [u.name for u in o.train.unknowns]
    return o.train.values[names.index(f'{o.label}.torque')]


def test_the_last_fit_has_the_shape_of_the_machine(search):
    work, comparison = search
    (o,) = (o for c, o in comparison.ranked if effect_name(c.label) == TRUE)
    shaped = with_shapes_of_causes(work, o)
    rate = f'{o.label}.transition_rate'
    names = [u.name for u in shaped.train.unknowns]
    assert shaped.train.values[names.index(rate)] < 3 * HARD
    level = names.index(f'{o.label}.torque')
    off = abs(shaped.train.values[level] - 2.3)
    assert off < SURELY * shaped.train.sigmas[level]
    assert off < 0.2 * abs(_level(o) - 2.3)
    assert shaped.train.normalised_error < 0.1 * o.train.normalised_error
    # It is as good as it gets now, and what has its shapes free is left alone.
    assert with_shapes_of_causes(work, shaped) is shaped


def test_at_the_noise_shapes_stay(search, monkeypatch):
    work, comparison = search
    o = comparison.ranked[0][1]
    quiet = [replace(side, mse=np.ones_like(side.mse)) for side in (o.train, o.held)]
    at_noise = replace(o, train=quiet[0], held=quiet[1])
    monkeypatch.setattr(work.halving, 'fit', None)
    assert with_shapes_of_causes(work, at_noise) is at_noise


def test_a_shape_that_explains_no_held_out_record_is_not_taken(search, monkeypatch):
    work, comparison = search
    o = comparison.ranked[0][1]
    worse = replace(o, held=replace(o.held, mse=1.01 * o.held.mse))
    monkeypatch.setattr(work.halving, 'fit', lambda tasks, what: [worse])
    assert with_shapes_of_causes(work, o) is o


def test_a_mixture_that_ended_pure_is_tried_from_its_middle(model_file, monkeypatch):
    """Soft friction by one law, held up where all of it turns by the other and the first is hard.

    Nothing says there how fast the first would turn, and a little of it so hard only hurts.
    """
    nominal = Model.load(model_file)
    soft = nominal.with_values({'coulomb_friction.transition_rate': 0.05})
    work = search_for(nominal, soft)
    model, bounds = with_nuisances(nominal, work.setups())
    hard = {'coulomb_friction.slow_share': 1.0, 'coulomb_friction.slow_rate': 0.02}
    plain = try_candidate(Task(nominal), work.train, work.held)
    start = started_from(plain.train, model, bounds)
    values = [hard.get(u.name, v) for u, v in zip(start.unknowns, start.values, strict=True)]
    start = replace(start, values=np.array(values))
    pure = try_candidate(Task(model, bounds=bounds, warm_starts=(start,)), work.train, work.held)
    ended = _values(pure)
    assert ended['coulomb_friction.slow_share'] == pytest.approx(1.0, abs=1e-3)
    assert ended['coulomb_friction.transition_rate'] == pytest.approx(0.01, rel=0.01)
    mixed = with_mixed_friction(work, pure)
    assert chi2(mixed) < chi2(pure) - 40.0  # a likelihood ratio that chance gives no three numbers
    ended = _values(mixed)
    assert ended['coulomb_friction.slow_share'] < 0.1
    assert ended['coulomb_friction.transition_rate'] == pytest.approx(0.05, rel=0.1)
    # Where no shape is free, or the noise is reached, nothing is fitted.
    monkeypatch.setattr(work.halving, 'fit', None)
    assert with_mixed_friction(work, plain) is plain
    monkeypatch.setattr(free_shapes, 'at_noise', lambda o: True)
    assert with_mixed_friction(work, pure) is pure


def _values(o):
    return {u.name: v for u, v in zip(o.train.unknowns, o.train.values, strict=True)}


@pytest.mark.parametrize('late', [0.0, 1e-3])
def test_a_cause_of_another_shape_asks_for_no_other_effect(model_file, monkeypatch, late):
    nominal = Model.load(model_file)
    machine = nominal.with_effect(
        'stribeck_friction', torque=1.5, stribeck_rate=0.3, exponent=1.0
    ).with_effect('actuator_delay', delay=late)
    work = search_for(nominal, machine)
    plain, faulty = _told_by_its_usual_shape(work, nominal)
    assert not settled(plain)
    raced = []
    monkeypatch.setattr(
        small_faults,
        'compare',
        lambda work, base, *_: raced.append(base) or Comparison(base, (), 2, 6),
    )
    assert small_faults.rather_one_cause(work, plain, faulty) is None
    # Where small faults do a part of it, one cause may do it in their place.
    assert bool(raced) == bool(late)


def _told_by_its_usual_shape(work, nominal):
    """The cause as the library draws it, and with small faults and shapes let go."""
    model = nominal.with_effect('stribeck_friction', torque=1.0, stribeck_rate=0.3)
    plain = try_candidate(Task(model), work.train, work.held)
    wider, bounds = with_nuisances(model, work.setups())
    return plain, try_candidate(Task(wider, bounds=bounds), work.train, work.held)


def _drawn_by(share, tails, mass):
    """A machine that draws its friction so and carries a load, and a search on its records."""
    nominal = hanging_arm.nominal()
    drawn = {}
    for joint in nominal.mechanism.driven:
        drawn[f'coulomb_friction@{joint}.slow_share'] = share
        drawn[f'coulomb_friction@{joint}.slow_tails'] = tails
    machine = nominal.with_values(drawn)
    if mass:
        load = {'mass': mass, 'x': 0.02, 'y': -0.03, 'z': -0.25}
        machine = machine.with_effect('payload', 'shank', **load)
    records = [hanging_arm.recorded(machine, 12.0, seed) for seed in (3, 4)]
    train, held = ([data_set] for data_set in prepare(nominal, records))
    work = Workspace(nominal, train, held, Options(workers=1), lambda *_: None, None, Deadline())
    return drawn, work


DRAWINGS = pytest.mark.parametrize(
    ('share', 'tails'), [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)], ids=['tanh', 'root', 'arctan']
)


@DRAWINGS
@pytest.mark.parametrize('mass', [0.0, 0.2])
def test_a_robots_friction_is_drawn_as_the_machine_draws_it_whether_it_carries_a_load_or_not(
    share, tails, mass
):
    drawn, work = _drawn_by(share, tails, mass)
    found = free_shapes.drawn_otherwise(work)
    if not share:
        assert found is None
        return
    assert {name: found.values[name] for name in drawn} == drawn
    # It is told, though no fit has let it go.
    told = small_faults.shapes(try_candidate(Task(found), work.train, work.held), work.nominal)
    assert [line.split(':')[0] for line in told if 'slow_share' in line] == [
        f'coulomb_friction@{joint}.slow_share = 1.000 and not 0'
        for joint in work.nominal.mechanism.driven
    ]


@DRAWINGS
def test_where_much_else_is_missing_friction_is_drawn_as_stated_or_as_it_is(share, tails):
    # The load leaves 450 times the noise, whatever the friction: a wrong law never fits better.
    drawn, work = _drawn_by(share, tails, mass=0.35)
    found = free_shapes.drawn_otherwise(work)
    assert found is None or {name: found.values[name] for name in drawn} == drawn


def test_a_mechanism_of_a_few_joints_is_not_asked_how_it_draws_friction(search):
    assert free_shapes.drawn_otherwise(search[0]) is None
