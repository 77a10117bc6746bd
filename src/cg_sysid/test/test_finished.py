"""What quick fits leave near the noise is not taken for something that the model lacks."""

from dataclasses import replace

import numpy as np
import pytest
from searches import search_for

from cg_dynamics.model import Model
from cg_sysid.diagnosis.thorough import finished
from cg_sysid.search import settings
from cg_sysid.search.task import Task
from cg_sysid.search.whole_fit import try_candidate


@pytest.fixture
def search(model_file):
    """A workspace and the outcome of a model that lacks nothing."""
    nominal = Model.load(model_file)
    work = search_for(nominal, nominal)
    return work, try_candidate(Task(nominal, iterations=8), work.train, work.held)


def leaving(o, times):
    """The same outcome with so many times the noise left on records held out."""
    return replace(o, held=replace(o.held, mse=times * np.ones_like(o.held.mse)))


def fits_of(work, monkeypatch):
    """Titles of the thorough fits that are asked for."""
    asked = []
    fit = work.halving.fit
    monkeypatch.setattr(
        work.halving, 'fit', lambda tasks, what: asked.append(what) or fit(tasks, what)
    )
    return lambda: [title for title in asked if title.startswith('thorough')]


def test_near_the_noise_a_thorough_fit_tells(search, monkeypatch):
    work, o = search
    asked = fits_of(work, monkeypatch)
    near = leaving(o, 0.9 * settings.NOISE.quick)
    assert finished(work, near)
    assert finished(work, near)
    assert asked() == ['thorough fits of nominal']  # once


def test_what_a_thorough_fit_leaves_as_well_is_not_finished(search, monkeypatch):
    work, o = search
    near = leaving(o, 0.9 * settings.NOISE.quick)
    monkeypatch.setattr(work.halving, 'fit', lambda tasks, what: [])
    assert not finished(work, near)


def test_far_from_the_noise_none_is_asked_for(search, monkeypatch):
    work, o = search
    asked = fits_of(work, monkeypatch)
    assert not finished(work, leaving(o, 1.1 * settings.NOISE.quick))
    assert not asked()


def test_at_the_noise_none_is_asked_for(search, monkeypatch):
    work, o = search
    asked = fits_of(work, monkeypatch)
    assert finished(work, o)
    assert not asked()
