"""A winner whose numbers end where a simpler effect begins: that one is judged beside it."""

from dataclasses import replace

import pytest
from searches import search_for

from cg_dynamics.model import Model
from cg_sysid.diagnosis.simpler import turned_into, with_simpler_one
from cg_sysid.search.candidates import Task, chi2, parameters_of, try_candidate

WITH_SHARE, WITHOUT = 'motor_side_friction', 'joint_flexibility'
DRIVE = {'stiffness': 6.0, 'damping': 0.2, 'rotor_inertia': 0.05}


@pytest.fixture(scope='module', params=[0.0, 0.6])
def search(request, model_file):
    """A workspace and the richer effect alone on top of the base, by its share in the machine."""
    nominal = Model.load(model_file)
    machine = nominal.with_effect(WITH_SHARE, share=request.param, **DRIVE)
    work = search_for(nominal, machine)
    base = try_candidate(Task(nominal), work.train, work.held)
    rich = try_candidate(Task(nominal, (WITH_SHARE, None), base=base.train), work.train, work.held)
    return request.param, work, work.selection.compare(base, [rich])


def test_a_share_of_nothing_is_the_simpler_effect(search):
    share, work, alone = search
    judged = with_simpler_one(work, alone)
    labels = [candidate.label for candidate, _ in judged.ranked]
    if share:
        assert labels == [WITH_SHARE]
        return
    assert sorted(labels) == [WITHOUT, WITH_SHARE]
    assert judged.winner()[0].label == WITHOUT
    # It is at the same minimum, as near as fits to 1000 samples come: two units of chi2 are a nat.
    rich, simple = (judged.of(label)[1] for label in (WITH_SHARE, WITHOUT))
    assert chi2(simple) < chi2(rich) + 2 * judged.margin
    ((number, (value, sigma, _)), *_) = parameters_of(simple, WITHOUT).items()
    assert number == 'stiffness'
    assert abs(value - DRIVE['stiffness']) < 3.3 * sigma
    # Who has it already is not fitted once more.
    assert with_simpler_one(work, judged) is judged


def test_only_a_number_that_ends_at_nothing_turns_an_effect(search):
    _, _, alone = search
    ((_, rich),) = alone.ranked
    for share, simpler in ((0.0, WITHOUT), (0.3, None), (1.0, None)):
        model = rich.train.model.with_values({f'{WITH_SHARE}.share': share})
        turned = turned_into(replace(rich, train=replace(rich.train, model=model)))
        assert (turned and turned[0]) == simpler
