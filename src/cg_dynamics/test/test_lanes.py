"""Windows of a record in lanes: every row once, rows alike beside each other, the same result."""

import numpy as np
import pytest

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.rig import Setup
from cg_dynamics.rollout import native
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.rollout.lanes import window_edges
from cg_dynamics.rollout.vector_code import WIDTH

START = np.array([0.05, 0.12, 0.2, -0.3])


def steps_side_by_side(work, edges):
    """Steps that vectors of windows take, each row as many as the lane that takes most."""
    total = 0.0
    for group in np.split(np.arange(len(edges) - 1), range(WIDTH, len(edges) - 1, WIDTH)):
        lanes = [work[edges[i] : edges[i + 1]] for i in group]
        beside = np.zeros((len(lanes), max(map(len, lanes))))
        for lane, row in zip(beside, lanes, strict=True):
            lane[: len(row)] = row
        total += beside.max(axis=0).sum()
    return total


@pytest.mark.parametrize('rows', [1, 2, 7, 8, 9, 17, 100, 1003])
def test_windows_hold_every_row_once(rows, rng):
    work = np.where(rng.random(rows) < 0.1, 30.0, 1.0)
    edges = window_edges(work)
    assert edges[0] == 0
    assert edges[-1] == rows
    assert (np.diff(edges) > 0).all()


def test_even_work_is_one_vector_of_windows():
    assert len(window_edges(np.full(1000, 3.0))) - 1 == WIDTH


def test_stiff_rows_do_not_make_the_others_wait():
    """Four times a joint turns round, at places that no window begins at."""
    work = np.ones(2000)
    for turn in (130, 610, 1290, 1770):
        work[turn : turn + 40] = 12.0
    even = np.linspace(0, len(work), WIDTH + 1).astype(int)
    cut, whole = (steps_side_by_side(work, e) for e in (window_edges(work), even))
    # In even windows each turn makes seven idle lanes wait: 1570 steps, of 470 to be shared.
    assert cut < 0.7 * whole


@pytest.fixture
def uneven_record(robot, springs):
    """Rows of 2 ms, and three spells of rows of 24 ms, which take a dozen steps each."""
    spacing = np.full(600, 0.002)
    for spell in (70, 240, 470):
        spacing[spell : spell + 30] = 0.024
    time = np.concatenate([[0.0], np.cumsum(spacing)])
    torque = 6 * np.sin(2 * np.pi * 1.7 * time)[:, None]
    setup = Setup(springs=springs)
    return compile_model(robot, setup), time, torque, parameter_vector(robot, setup)


def test_cut_windows_give_the_same_normal_equations(uneven_record, rng, monkeypatch):
    compiled, time, torque, p = uneven_record
    m2, nf = 2 * compiled.equations.coordinates, len(compiled.free)
    x0, by_motion, by_free = compiled.initial_sensitivity(START, torque[0], p)
    measured = rng.normal(0, 0.1, size=(len(time), compiled.ny))
    weight, column = np.arange(2.0, 2.0 + compiled.ny), np.arange(m2, m2 + nf)
    s0 = np.hstack([by_motion, by_free])

    def found(edges_of):
        counts = []

        def watched(work):
            edges = edges_of(work)
            counts.append(len(edges) - 1)
            return edges

        monkeypatch.setattr(native, 'window_edges', watched)
        normal, _, J = compiled.normal(
            time, torque, x0, s0, p, column, measured, weight, keep=True
        )
        return counts[0], normal, J

    windows, cut, by_cut = found(window_edges)
    assert windows > WIDTH  # else there is nothing to compare
    _, whole, by_whole = found(lambda work: np.linspace(0, len(work), WIDTH + 1).astype(int))
    # The products of a longer chain round otherwise: by 1e-16 of the largest, some tens of times.
    scale = np.abs(by_whole).max(axis=(0, 1))
    np.testing.assert_allclose(by_cut / scale, by_whole / scale, atol=1e-11)
    size = np.sqrt(np.diag(whole.hessian))
    both = np.outer(size, size)
    np.testing.assert_allclose(cut.hessian / both, whole.hessian / both, atol=1e-11)
    np.testing.assert_allclose(cut.gradient / size, whole.gradient / size, rtol=1e-9)
