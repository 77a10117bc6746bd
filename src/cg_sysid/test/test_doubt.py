"""Doubt by itself: a cause's place is contested by numbers that are known, without any fit."""

from dataclasses import replace

import pytest
from searches import search_for

from cg_dynamics.model import Model
from cg_sysid.diagnosis.doubt import exchange
from cg_sysid.search import settings
from cg_sysid.search.candidates import Task, try_candidate
from cg_sysid.search.model_selection import Comparison

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
