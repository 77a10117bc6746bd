"""A cause whose numbers end where a simpler effect begins is told by that one's name."""

from dataclasses import replace

import numpy as np
import pytest
from searches import search_for, swings_of

from cg_dynamics.model import Model
from cg_sysid.diagnosis.causes import cause_among
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.diagnosis.simpler import simplified, turned_into
from cg_sysid.search import settings
from cg_sysid.search.outcome import chi2, parameters_of
from cg_sysid.search.task import Task
from cg_sysid.search.whole_fit import try_candidate

WITH_SHARE, WITHOUT = 'motor_side_friction', 'joint_flexibility'
SURELY = 3.3  # standard deviations: 99.9 % of intervals hold
DRIVE = {'stiffness': 6.0, 'damping': 0.2, 'rotor_inertia': 0.05}
NONE = pytest.mark.parametrize('search', [0.0], indirect=True)
MOST = pytest.mark.parametrize('search', [0.6], indirect=True)


@pytest.fixture(scope='module')
def search(request, model_file):
    """A workspace and the richer effect alone on top of the base, by its share in the machine."""
    nominal = Model.load(model_file)
    machine = nominal.with_effect(WITH_SHARE, share=request.param, **DRIVE)
    work = search_for(nominal, machine)
    rich = try_candidate(Task(nominal, (WITH_SHARE, None)), work.train, work.held)
    return work, rich


@NONE
def test_a_share_of_nothing_is_the_simpler_effect(search):
    work, rich = search
    simple = simplified(work, rich)
    assert work.added(simple) == {WITHOUT}
    assert simple.label == WITHOUT
    # The same minimum, with the numbers that the machine has.
    assert chi2(simple) < chi2(rich) + 2 * settings.SELECTION.earned
    ((number, (value, sigma, _)), *_) = parameters_of(simple, WITHOUT).items()
    assert number == 'stiffness'
    assert abs(value - DRIVE['stiffness']) < SURELY * sigma
    assert simplified(work, simple) is simple


@MOST
def test_a_share_stays_where_it_is_needed(search):
    """Though that of one fit may end at nothing."""
    work, rich = search
    assert simplified(work, rich) is rich
    model = rich.train.model.with_values({f'{WITH_SHARE}.share': 0.0})
    ended = replace(rich, train=replace(rich.train, model=model))
    assert simplified(work, ended) is ended


@MOST
def test_only_a_number_that_ends_at_nothing_turns_an_effect(search):
    _, rich = search
    for share, simpler in ((0.0, WITHOUT), (0.3, None), (1.0, None)):
        model = rich.train.model.with_values({f'{WITH_SHARE}.share': share})
        turned = turned_into(replace(rich, train=replace(rich.train, model=model)), WITH_SHARE)
        assert (turned and turned[0]) == simpler


@MOST
def test_what_the_machine_has_already_comes_not_twice(search):
    _, rich = search
    model = rich.train.model.with_values({f'{WITH_SHARE}.share': 0.0})
    both = rich.model.with_effect(WITHOUT, **DRIVE)
    o = replace(rich, model=both, train=replace(rich.train, model=model))
    assert turned_into(o, WITH_SHARE) is None


@NONE
def test_its_evidence_is_that_of_the_richer_one(search):
    work, rich = search
    base = try_candidate(Task(work.nominal), work.train, work.held)
    comparison = work.selection.compare(base, [rich])
    cause = cause_among(simplified(work, rich), WITHOUT, [comparison])
    assert cause.label == WITHOUT
    assert cause.evidence == comparison.ranked[0][0].evidence
    assert cause.rivals == ()


def test_a_diagnosis_that_tried_only_the_richer_one_names_the_simpler(model_file):
    nominal = Model.load(model_file)
    machine = nominal.with_effect(WITHOUT, **DRIVE)
    records = swings_of(machine, 4)
    found = diagnose(nominal, records, Options(effects=(WITH_SHARE,), workers=1))
    (cause,) = found.causes
    assert cause.label == WITHOUT
    assert cause.rivals == ()
    assert np.isfinite(cause.evidence)
    # The records are of that very model; 1000 samples held out spread chi2/N by 0.03.
    assert found.extended.held.normalised_error < 1.1
