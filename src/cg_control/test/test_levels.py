"""Levels of funnels: what came by, and how large a funnel that leaves."""

import numpy as np
import pytest

from cg_control.trees.levels import EDGES, PER_DECADE, Levels

STEP = 10.0 ** (1 / PER_DECADE)  # from one edge to the next


def test_a_funnel_is_infinite_until_somebody_fails():
    levels = Levels(0.0).extended(2)
    levels.add(np.array([0, 0]), np.array([0.1, 50.0]), np.array([True, True]))
    assert levels.rho(np.array([0, 1])).tolist() == [np.inf, np.inf]


def test_without_tolerance_a_funnel_ends_below_the_least_failure():
    levels = Levels(0.0).extended(1)
    cost = np.array([0.3, 7.0, 40.0, 1.0, 600.0])
    levels.add(np.zeros(5, int), cost, np.array([True, False, False, True, True]))
    (rho,) = levels.rho(np.array([0]))
    assert 7.0 / STEP <= rho < 7.0


def test_one_failure_among_hundreds_is_tolerated():
    levels = Levels(0.01).extended(1)
    cost = np.geomspace(0.1, 10.0, 500)
    home = np.ones(500, bool)
    home[250] = False
    levels.add(np.zeros(500, int), cost, home)
    # Up to the failure 250 came by: one in 250 is less than a percent.
    assert levels.rho(np.array([0]))[0] == np.inf
    levels.add(np.zeros(20, int), np.full(20, 9.0), np.zeros(20, bool))
    assert 1.0 < levels.rho(np.array([0]))[0] < 9.0


@pytest.mark.parametrize('tolerated', [0.0, 0.02])
def test_levels_are_what_their_words_say(tolerated):
    rng = np.random.default_rng(0)
    levels = Levels(tolerated).extended(5)
    node, cost = rng.integers(0, 5, 4000), 10.0 ** rng.uniform(-3, 4, 4000)
    home = rng.random(4000) > 1 / (1 + (30.0 / cost) ** 2)
    levels.add(node, cost, home)
    for k, rho in enumerate(levels.rho(np.arange(5))):
        shares = [
            np.mean(~home[(node == k) & (cost <= edge)]) for edge in EDGES
            if ((node == k) & (cost <= edge)).any()
        ]  # fmt: skip
        edges = [edge for edge in EDGES if ((node == k) & (cost <= edge)).any()]
        holds = [edge for edge, share in zip(edges, shares, strict=True) if share <= tolerated]
        assert rho == (max(holds) if holds else EDGES[EDGES < cost[node == k].min()].max())


def test_room_for_more_nodes_keeps_what_was_counted():
    levels = Levels(0.0).extended(1)
    levels.add(np.array([0]), np.array([2.0]), np.array([False]))
    before = levels.rho(np.array([0]))
    levels = levels.extended(4)
    assert levels.rho(np.array([0])) == before
    assert np.isinf(levels.rho(np.array([1, 2, 3]))).all()


def test_levels_that_are_known_are_kept_until_more_is_known():
    known = np.array([EDGES[20], np.inf, EDGES[0], 0.0])
    levels = Levels.of(0.01, known)
    np.testing.assert_allclose(levels.rho(np.arange(4)), known)
    levels.add(np.zeros(200, int), np.full(200, EDGES[25]), np.ones(200, bool))
    assert levels.rho(np.array([0])) == np.inf
    levels.add(np.ones(1, int), np.ones(1), np.zeros(1, bool))
    assert levels.rho(np.array([1])) < 1.0
