"""Robots that the tests share. All parameters differ, so that no swap can hide."""

import numpy as np
import pytest

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring

SPRINGS = (
    Spring('inner', point=0.9, anchor=(-0.6, 1.0), stiffness=400.0, free_length=0.3),
    Spring('inner', point=0.8, anchor=(0.7, 0.9), stiffness=350.0, free_length=0.25),
)


@pytest.fixture
def robot() -> Model:
    """The robot of the thesis, friction included."""
    return Model.load(model_path('compass_gait_mit'))


@pytest.fixture
def bare(robot) -> Model:
    """Rigid bodies only, with a hip body heavy enough to be noticed."""
    bodies = robot.without_effect('viscous_friction').without_effect('coulomb_friction')
    return bodies.with_values({'c3': 0.004, 'c6': 0.011})


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(seed=0)


@pytest.fixture
def springs() -> tuple[Spring, ...]:
    return SPRINGS


@pytest.fixture(
    params=[
        Setup(),
        Setup(stance='outer'),
        Setup(fixture='inner_fixed'),
        Setup(stance='outer', fixture='outer_fixed'),
        Setup(fixture='legs_tied'),
        Setup(springs=SPRINGS),
        Setup(stance='outer', springs=SPRINGS),
        Setup(fixture='legs_tied', springs=SPRINGS),
    ],
    ids=lambda s: f'{s.stance}-{s.fixture}-{len(s.springs)}springs',
)
def setup(request) -> Setup:
    """Every kind of set-up."""
    return request.param
