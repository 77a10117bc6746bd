"""Robots that the tests share."""

import pytest

from cg_description.paths import model_path
from cg_dynamics.model import Model


@pytest.fixture(scope='session')
def robot() -> Model:
    """The robot of the thesis, friction included."""
    return Model.load(model_path('compass_gait_mit'))
