"""Laws of one friction are compared once each may turn about rest as the machine does."""

from dataclasses import replace

import numpy as np
import pytest
from searches import search_for

from cg_dynamics.model import Model
from cg_sysid.diagnosis.free_shapes import compared_with_free_shapes, with_shapes_of_causes
from cg_sysid.search import settings
from cg_sysid.search.candidates import Task, chi2, try_candidate
from cg_sysid.search.ranking import effect_name

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


def test_the_law_that_fits_with_its_shape_let_go_is_first(search):
    work, comparison = search
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
