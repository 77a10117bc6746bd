"""Planning by workers: as here, and when some of them hang or die."""

import os
import pickle
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from small_growth import BOX, ROUND

from cg_control.grow_tree import LANDING, upright_tree
from cg_control.trees.extension import Extension
from cg_control.trees.growth import Branch, GivenUp, Grower, GrowthOptions, Region
from cg_dynamics.rollout.compiler import compiler
from cg_dynamics.watched_processes import WatchedProcesses

REGION = Region(np.array(BOX))
OPTIONS = GrowthOptions(seed=2, round_size=ROUND)
NEVER = 10_000.0  # s
SOON, LONG = 0.5, 60.0  # s


class Failing(WatchedProcesses):
    """Processes that do something else with some pieces of work, counted from zero.

    Args:
        instead: Function and argument, by number of the piece.
    """

    def __init__(self, count, instead):
        super().__init__(count, LONG)
        self.instead, self.number = instead, 0

    def submit(self, function, /, *arguments):
        number, self.number = self.number, self.number + 1
        if number in self.instead:
            return super().submit(*self.instead[number])
        return super().submit(function, *arguments)

    def _result(self, k, call):
        # What hangs is not waited for as long as for a process that compiles all it needs.
        self._limit = SOON if pickle.loads(call)[0] is time.sleep else LONG
        return super()._result(k, call)


def same(a, b):
    assert a.onto == b.onto
    np.testing.assert_array_equal(a.trajectory.phases[0].states, b.trajectory.phases[0].states)


def test_workers_plan_what_is_planned_here(robot):
    leg, x = REGION.draw(np.random.default_rng(1), 12)
    nodes = upright_tree(robot).nodes
    here = Extension(robot)(nodes, leg, x)
    assert sum(isinstance(branch, Branch) for branch in here) > 3
    with ThreadPoolExecutor(1) as threads:  # whatever is an executor
        there = Extension(robot, executor=threads)(nodes, leg, x)
    for a, b in zip(here, there, strict=True):
        assert (a is None) == (b is None)
        if a is not None:
            same(a, b)


@pytest.mark.slow
def test_a_planner_that_hangs_or_dies_costs_its_state_alone(robot):
    leg, x = REGION.draw(np.random.default_rng(1), 12)
    nodes = upright_tree(robot).nodes
    here = Extension(robot)(nodes, leg, x)
    asked = np.flatnonzero(Extension(robot).promising(leg, x) <= 1)
    instead = {1: (time.sleep, NEVER), 2: (os._exit, 3)}
    with Failing(1, instead) as failing:
        there = Extension(robot, executor=failing)(nodes, leg, x)
    lost = [k for k, branch in enumerate(there) if isinstance(branch, GivenUp)]
    assert lost == asked[[1, 2]].tolist()
    for k, (a, b) in enumerate(zip(here, there, strict=True)):
        if k not in lost:
            assert (a is None) == (b is None)
            if a is not None:
                same(a, b)


@pytest.mark.skipif(
    compiler() is None, reason='no C compiler: thousands of rollouts would take too long'
)
def test_a_tree_grows_on_without_the_states_that_were_given_up(robot):
    with Failing(1, {0: (os._exit, 3), 3: (os._exit, 3)}) as failing:
        grower = Grower(
            robot, upright_tree(robot), REGION, Extension(robot, executor=failing), OPTIONS,
            simulation=LANDING,
        )  # fmt: skip
        first, second = grower.round(), grower.round()
    assert (first.given_up, second.given_up) == (2, 0)
    assert first.grown > 3
    assert len(grower.nodes) > 100
    assert first.covered + first.grown + first.rejected + first.given_up <= first.samples


def test_an_error_of_the_planner_is_no_lost_state(robot):
    leg, x = REGION.draw(np.random.default_rng(1), 4)
    with (
        Failing(1, {0: (int, 'x')}) as failing,
        pytest.raises(ValueError, match='invalid literal'),
    ):
        Extension(robot, executor=failing)(upright_tree(robot).nodes, leg, x)
