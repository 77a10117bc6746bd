"""Rivals that data cannot tell apart differ by chance on records held out, not in a joint fit."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import score
from cg_sysid.search import model_selection
from cg_sysid.search.model_selection import ModelSelection
from cg_sysid.search.nuisance import with_nuisances
from cg_sysid.search.task import Task
from cg_sysid.search.whole_fit import fit_to_all, try_candidate

SPRINGS = tuple(Spring('inner', 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3))
TWINS = 'foot_compliance', 'spring_nonlinearity'  # where springs may be off a little besides


@pytest.fixture(scope='module')
def fitted(model_file):
    """The jury, the nominal model's outcome, those of the twins, and all data sets."""
    nominal = Model.load(model_file)
    machine = nominal.with_effect('foot_compliance', stiffness=5.0)
    records = [
        rehearse(
            f'record_{k}', machine, Setup(springs=SPRINGS), [0.1 - 0.1 * k, -0.1, 0.3, -0.5],
            [lambda t, k=k: 4.0 * math.sin(2 * math.pi * (0.5 + 0.2 * k + 0.1 * t) * t)],
            4.0, 0.004, k,
        )
        for k in range(2)
    ]  # fmt: skip
    train, held = ([data_set] for data_set in prepare(nominal, records))
    model, bounds = with_nuisances(nominal, [train[0].setup])
    base = try_candidate(Task(model, bounds=bounds), train, held)
    twins = [
        try_candidate(Task(model, (name, None), bounds=bounds, thorough=True), train, held)
        for name in TWINS
    ]
    return ModelSelection(train, held), base, twins, [*train, *held]


def _apart(comparison):
    one, other = (comparison.of(name)[0].evidence for name in TWINS)
    return one - other


def test_a_joint_fit_is_at_least_as_good(fitted):
    _, _, twins, data_sets = fitted
    for outcome in twins:
        found = fit_to_all(outcome, data_sets)
        mine = outcome.train.squares + outcome.held.squares + outcome.train.belief
        # What it gains is what values fitted to one half lose on the other, by chance; the shape
        # of friction about rest, of which 4 s say little, loses most.
        gain = mine - found.squares - found.belief
        assert -0.1 < gain < 10 * len(found.unknowns)


@pytest.mark.parametrize(('explained', 'compared'), [(4.9, True), (5.1, False)])
def test_only_a_push_that_explains_little_is_compared_with_friction(
    fitted, monkeypatch, explained, compared
):
    selection, base, (one, _), _ = fitted
    impulse = replace(one.train.unknowns[0], each='record')
    sigmas = tuple(np.ones(1) for _ in one.train.motions)
    event = replace(one, train=replace(one.train, own=(impulse,), own_sigmas=sigmas))
    monkeypatch.setattr(model_selection, 'explained_by', lambda base, o: explained)
    monkeypatch.setattr(model_selection, 'within_friction', lambda o: ['no more than friction'])
    assert ('no more than friction' in selection.judge(base, event, 50.0).reason) == compared
    monkeypatch.setattr(model_selection, 'never_happens', lambda o: ['happened nowhere'])
    assert 'happened nowhere' in selection.judge(base, event, 50.0).reason
    # What all records share is no event.
    assert 'no more than friction' not in selection.judge(base, one, 50.0).reason


def test_twins_are_level_wherever_their_fits_to_one_half_ended(fitted):
    selection, base, (one, other), data_sets = fitted
    # The half that is fitted may have led the one astray, as a wrong belief does here.
    values = {
        'foot_compliance.stiffness': 2.0 * one.train.model.values['foot_compliance.stiffness']
    }
    astray = replace(one.train, values=np.array([
        values.get(u.name, v) for u, v in zip(one.train.unknowns, one.train.values, strict=True)
    ]))  # fmt: skip
    held = score(one.train.model.with_values(values), data_sets[1:])
    one = replace(one, train=astray, held=held)
    twins = [one, other]
    assert _apart(selection.compare(base, twins)) < -10
    joint = selection.compare(base, twins, [fit_to_all(o, data_sets) for o in twins])
    assert abs(_apart(joint)) < 2


def test_without_all_joint_fits_none_counts(fitted):
    selection, base, twins, _ = fitted
    much = replace(twins[0].train, mse=1e-3 * twins[0].train.mse)
    joint = selection.compare(base, twins, [much, 'runs away'])
    assert _apart(joint) == _apart(selection.compare(base, twins))
    assert joint.margin <= selection.compare(base, twins).margin


def _leaving(o, train, held):
    """The outcome with these chi2/N, the same in all outputs."""
    return replace(
        o, train=replace(o.train, mse=np.full_like(o.train.mse, train)),
        held=replace(o.held, mse=np.full_like(o.held.mse, held)),
    )  # fmt: skip


def _winner_of(fitted, left):
    """Label of who wins by what each leaves (chi2/N) of 1000 variances, could all be earned."""
    selection, base, (one, _), _ = fitted
    found = [replace(_leaving(one, error, error), label=label) for label, error in left.items()]
    comparison = selection.compare(_leaving(base, 1e3, 1e3), found)
    ranked = tuple((replace(candidate, reason=''), o) for candidate, o in comparison.ranked)
    return replace(comparison, ranked=ranked, margin=0.1).winner()[0].label


@pytest.mark.parametrize(
    ('simple', 'elaborate', 'chosen'),
    [
        (2.0, 1.91, 'rotor_inertia@hip'),  # It takes 9 % of what the rotor leaves above the noise.
        (2.0, 1.89, 'joint_flexibility@hip'),
        (1.29, 1.28, 'joint_flexibility@hip'),  # At the noise evidence decides.
    ],
)
def test_what_takes_hardly_more_than_a_simpler_effect_is_not_preferred(
    fitted, simple, elaborate, chosen
):
    left = {'rotor_inertia@hip': simple, 'joint_flexibility@hip': elaborate}
    assert _winner_of(fitted, left) == chosen
    # Of two that do not contain each other the better one stays.
    away = {'rotor_inertia@knee': simple, 'joint_flexibility@hip': elaborate}
    assert _winner_of(fitted, away) == 'joint_flexibility@hip'


@pytest.mark.parametrize(
    ('simple', 'elaborate', 'chosen'),
    [
        (270.0, 100.0, 'viscous_friction@knee'),  # It explains 730 of 900 variances.
        (300.0, 100.0, 'presliding_friction@knee'),
        (50.0, 10.0, 'presliding_friction@knee'),  # Little is unexplained.
    ],
)
def test_where_most_is_unexplained_the_simpler_of_two_laws_is_taken_first(
    fitted, simple, elaborate, chosen
):
    left = {'viscous_friction@knee': simple, 'presliding_friction@knee': elaborate}
    assert _winner_of(fitted, left) == chosen
    # Of two that do not contain each other the better one stays.
    away = {'viscous_friction@hip': simple, 'presliding_friction@knee': elaborate}
    assert _winner_of(fitted, away) == 'presliding_friction@knee'


def test_nothing_can_be_earned_where_too_little_is_left(fitted):
    selection, base, _, _ = fitted
    assert selection.nothing_material(_leaving(base, 1.0, 1.85))
    assert selection.nothing_material(_leaving(base, 30.0, 1.85))
    assert not selection.nothing_material(_leaving(base, 1.0, 1.95))
    one = _leaving(base, 1.0, 1.0)
    one.held.mse[:, 1] = 2.1
    assert not selection.nothing_material(one)


def test_what_is_earned_explains_something_of_the_records_that_it_is_fitted_to(fitted):
    selection, base, _, _ = fitted
    # One output in three, three tenths of a squared standard deviation.
    assert selection.to_be_earned(_leaving(base, 9.0, 9.0)) == pytest.approx(8.9, abs=0.01)
    assert selection.to_be_earned(_leaving(base, 1.1, 9.0)) == pytest.approx(1.07, abs=1e-6)
    assert selection.to_be_earned(_leaving(base, 0.9, 9.0)) == pytest.approx(0.9, abs=1e-6)


def _after_causes(fitted, monkeypatch):
    """A jury that saw 10 000 variances before there was a cause."""
    selection, base, _, _ = fitted
    monkeypatch.setattr(selection, 'before_causes', np.inf)
    selection.without_cause(_leaving(base, 2e4 + 1, 2e4 + 1))
    selection.without_cause(_leaving(base, 1e4 + 1, 1e4 + 1))
    return selection


@pytest.mark.parametrize(
    ('before', 'left', 'counts'),
    [
        (10.0, 4.1, False),  # it leaves 3.1 of 9
        (10.0, 3.9, True),
        (12.0, 11.0, True),  # more than a thousandth of what the causes explain: not their laws
        (1.35, 1.29, True),  # what comes to the noise explains
        (0.98, 0.97, True),  # nothing is left there
    ],
)
def test_what_takes_the_edge_off_what_causes_leave_is_none(
    fitted, monkeypatch, before, left, counts
):
    selection = _after_causes(fitted, monkeypatch)
    _, base, (one, _), _ = fitted
    base, found = _leaving(base, before, before), _leaving(one, left, left)
    assert ('their laws' not in selection.judge(base, found, 1e3).reason) == counts
    # Where no cause was, there is no law that could be a little off.
    monkeypatch.setattr(selection, 'before_causes', np.inf)
    assert 'their laws' not in selection.judge(base, found, 1e3).reason


def test_who_takes_the_edge_off_is_not_fitted_to_the_end(fitted, monkeypatch):
    selection = _after_causes(fitted, monkeypatch)
    _, base, _, _ = fitted
    # Three tenths of the two thirds that have to be explained on records held out.
    assert selection.to_be_earned(_leaving(base, 6.0, 9.0)) == pytest.approx(5.0)
    assert selection.to_be_earned(_leaving(base, 12.0, 12.0)) == pytest.approx(11.9, abs=0.01)


def _believing(o, tolerances):
    """The outcome with the first number of the file so far from what it believes, others as is."""
    values = np.array([u.prior for u in o.train.unknowns])
    k = next(
        k for k, u in enumerate(o.train.unknowns)
        if np.isfinite(u.tolerance) and u.name not in o.task.bounds
    )  # fmt: skip
    u = o.train.unknowns[k]
    values[k] = u.to_value(u.to_coordinate(u.prior) + tolerances * u.tolerance)
    return replace(o, train=replace(o.train, values=values))


def test_what_takes_the_place_of_numbers_that_nobody_believes_lowers_no_error(fitted):
    selection, base, (one, _), _ = fitted
    # A law drawn a little differently is left, which nothing of the library explains.
    heavy, one = (_leaving(o, 1.4, 1.4) for o in (_believing(base, 6.0), _believing(one, 0.0)))
    assert selection.only_beliefs(heavy)
    reason = selection.judge(heavy, one, 30.0).reason
    assert 'held-out' not in reason
    assert 'believes' not in reason
    assert 'held-out' in selection.judge(_believing(heavy, 0.0), one, 30.0).reason
    assert 'believes' in selection.judge(heavy, _believing(one, 6.0), 30.0).reason
    worse = _leaving(one, 1.5, 1.4)
    assert 'believes' in selection.judge(heavy, worse, 30.0).reason
    assert not selection.only_beliefs(_leaving(heavy, 1.4, 2.0))
    assert selection.compare(heavy, [one]).margin == math.inf
