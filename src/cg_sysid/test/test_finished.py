"""What quick fits leave near the noise is not taken for something that the model lacks."""

from dataclasses import replace

import numpy as np
import pytest

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.deadline import Deadline
from cg_sysid.diagnosis.result import Options
from cg_sysid.diagnosis.thorough import finished
from cg_sysid.diagnosis.workspace import Workspace
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.search import settings
from cg_sysid.search.candidates import Task, try_candidate


@pytest.fixture
def search(model_file):
    """A workspace and the outcome of a model that lacks nothing."""
    nominal = Model.load(model_file)
    records = [
        rehearse(f'r{k}', nominal, Setup(fixture='inner_fixed'), [0.1, 0.0],
                 [lambda t, k=k: 3 * np.sin((3 + k) * t)], 2.0, 0.004, k)
        for k in range(2)
    ]  # fmt: skip
    train, held = ([data_set] for data_set in prepare(nominal, records))
    work = Workspace(nominal, train, held, Options(workers=1), lambda *_: None, None, Deadline())
    return work, try_candidate(Task(nominal, iterations=8), train, held)


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
