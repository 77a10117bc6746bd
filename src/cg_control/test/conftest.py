"""Robots that the tests share."""

import pytest

from cg_control.following.planning import plan
from cg_control.trajectories.collocation import Options
from cg_control.trajectories.task import Task
from cg_control.trajectories.trajectory import Trajectory
from cg_description.paths import model_path
from cg_dynamics.model import Model


@pytest.fixture(scope='session')
def robot() -> Model:
    """The robot of the thesis, friction included."""
    return Model.load(model_path('compass_gait_mit'))


@pytest.fixture(scope='session')
def step(robot) -> Trajectory:
    """From upright on the inner leg to upright on the outer leg, with feedback."""
    return plan(robot, Task(('inner', 'outer'), reach=0.2), Options(fine=25))


@pytest.fixture(scope='session')
def back(robot) -> Trajectory:
    """From upright on the outer leg to upright on the inner leg, with feedback."""
    return plan(robot, Task(('outer', 'inner'), reach=0.2), Options(fine=25))


@pytest.fixture(scope='session')
def frictionless_step(robot) -> Trajectory:
    """As `step`, planned without friction, which the controller is to compensate."""
    return plan(robot, Task(('inner', 'outer'), reach=0.2), Options(fine=25), friction=False)
