"""The screen before planning: closed forms, and no motion where it says that there is none."""

import numpy as np
import pytest

from cg_control.balancing.linearise import linearise_stance
from cg_control.trajectories.collocation import Options, PlanningError, optimise, planning_model
from cg_control.trajectories.reach import HELD, Screen, cheap
from cg_control.trajectories.task import Box, Task
from cg_dynamics.rig import STANCES
from cg_dynamics.walking.impact import other


@pytest.fixture(scope='module')
def plant(robot):
    return planning_model(robot, friction=False)


@pytest.fixture(scope='module')
def screen(plant):
    return Screen(plant)


def lean(stance, angle, rate=0.0, swing=0.0, swing_rate=0.0):
    st = STANCES.index(stance)
    x = np.zeros(4)
    x[st], x[2 + st], x[1 - st], x[3 - st] = angle, rate, swing, swing_rate
    return x


@pytest.mark.parametrize('stance', STANCES)
def test_a_capture_coordinate_of_one_is_where_the_limit_holds_the_linear_model(plant, stance):
    """Under constant full torque zeta = 1 stays, and what is beyond grows by exp(lambda t)."""
    screen = Screen(plant, torque_limit=7.0)
    linear = linearise_stance(plant, stance)
    growth = np.linalg.eigvals(linear.A).real.max()
    for zeta in (1.0, 1.3):
        x = lean(stance, 0.02, 0.01)
        x *= zeta / screen.zeta(stance, x)
        push = np.ravel(linear.B) * 7.0
        slope = min(screen.zeta(stance, linear.A @ x + sign * push) for sign in (-1, 1))
        assert slope == pytest.approx(growth * (zeta - 1), abs=1e-9)
    assert Screen(plant, 14.0).zeta(stance, x) == pytest.approx(screen.zeta(stance, x) / 2)


@pytest.mark.parametrize('stance', STANCES)
def test_what_falls_backward_is_lost_and_what_falls_forward_may_step(screen, stance):
    states = np.array(
        [
            lean(stance, 0.0),
            lean(stance, -0.3),  # the foot cannot get behind the hip
            lean(stance, 0.15, 0.3, swing=-0.3),  # nearly there
            lean(stance, 0.5, 1.5, swing=1.0),  # far behind, falling fast
        ]
    )
    said = screen.reach(stance, states)
    assert [said.allows(steps).tolist() for steps in range(3)] == [
        [True, False, False, False],
        [True, False, True, False],
        [True, False, True, said.allows(2)[3]],
    ]
    assert said.zeta[1] < -HELD < HELD < said.zeta[2]


def test_one_state_is_judged_as_among_many(screen):
    rng = np.random.default_rng(3)
    states = rng.uniform(-1, 1, (9, 4)) * [0.4, 0.6, 1.0, 2.0]
    together = screen.reach('inner', states)
    for i, x in enumerate(states):
        alone = screen.reach('inner', x[None])
        # A lane's neighbours are others, and vector code is compiled without them in mind.
        for name in ('zeta', 'caught', 'landing', 'ahead'):
            assert getattr(alone, name)[0] == pytest.approx(getattr(together, name)[i], rel=1e-9)


@pytest.mark.evidence
def test_no_plan_is_found_where_the_screen_says_no(plant, screen):
    """Twelve states of the box, planned for by the full search: a no is a no, a yes often one."""
    rng, agreed, tried = np.random.default_rng(46), 0, 0
    while tried < 12:
        stance = STANCES[tried % 2]
        angle, swing, rate, swing_rate = rng.uniform(-1, 1, 4) * [0.4, 0.5, 1.0, 2.0]
        x = lean(stance, angle, rate, angle + swing, rate + swing_rate)
        said = screen.reach(stance, x[None])
        if abs(said.zeta[0]) > 2.5:
            continue
        tried += 1
        for steps, modes in enumerate([(stance,), (stance, other(stance))]):
            allowed = bool(said.allows(steps)[0])
            options = cheap(steps) if allowed else Options(guesses=1)
            try:
                optimise(plant, Task(modes, Box.point(x)), options)
                found = True
            except PlanningError:
                found = False
            assert allowed or not found
            agreed += allowed == found
    assert agreed >= 20
