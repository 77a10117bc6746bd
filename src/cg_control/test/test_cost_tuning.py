"""Cost tuning: the score is a basin that weights can lose, the search finds and reports."""

import math

import numpy as np
import pytest

from cg_control.cost_tuning import Trial, draw, score, search, starts
from cg_control.following.planning import plan
from cg_control.trajectories.collocation import Options
from cg_control.trajectories.task import Task
from cg_control.trajectories.tvlqr import Weights


@pytest.fixture(scope='module')
def step(robot):
    return plan(robot, Task(('inner', 'outer'), reach=0.2), Options(fine=25))


def test_score_counts_who_stands_and_bad_weights_lose(robot, step):
    deviations = starts(8, 'inner') * 0.6
    good = score(step, robot, Weights(), deviations)
    # All states weighted alike, hardly any torque: what the thesis warns of.
    bad = score(step, robot, Weights(1, 1, 1, 1, 100.0, 1e-6), deviations)
    assert good >= 0.75
    assert bad <= good - 0.25


def test_search_finds_the_summit_of_a_known_landscape():
    """Score falls with the logarithmic distance from a known best set."""
    summit = Weights(1000.0, 11.0, 69.0, 0.016, 1 / 1600, 1.0)

    def measure(weights):
        return -abs(math.log(weights.stance_angle / summit.stance_angle))

    seen = []
    trials = search(
        measure, 40, seed=1, report=lambda number, trial, best: seen.append(best.score)
    )
    assert len(trials) == len(seen) == 41
    assert seen == sorted(seen)
    best = max(trials, key=lambda trial: trial.score)
    assert best.score > 0.2 * trials[0].score


def test_search_is_drawn(tmp_path):
    rng = np.random.default_rng(0)
    trials = [Trial(Weights(stance_angle=10 * (k + 1)), rng.uniform()) for k in range(5)]
    draw(trials, tmp_path / 'search.png')
    assert (tmp_path / 'search.png').read_bytes()[:4] == b'\x89PNG'
