"""Gains and basin of settings that change: at once, and soon."""

import dataclasses

import numpy as np
import pytest

from cg_control.balancing.balance import BalanceSettings, balance_gains
from cg_control.balancing.basin import sample_basin
from cg_control.balancing.basin_sampler import BasinError, BasinSampler
from cg_control.balancing.live_design import LiveDesign
from cg_control.balancing.lqr import LqrError
from cg_description.paths import model_path
from cg_dynamics.model import Model

PATH = model_path('compass_gait_mit')
MODEL = Model.load(PATH)
T = 0.002
SETTINGS = BalanceSettings()
SOFT = dataclasses.replace(SETTINGS, lean_scale=0.2, swing_scale=1.0)
PATIENCE = 60.0  # s; a compiler may have to run


@pytest.fixture
def design():
    design = LiveDesign(PATH, MODEL, SETTINGS, T, log=lambda text: None)
    yield design
    design.close()


def settle(design):
    basins = design._sampler.wait(PATIENCE)
    assert basins is not None
    return basins


def test_gains_are_those_of_the_weights(design):
    for settings in (SOFT, SETTINGS):
        design.judge(settings)
        design.adopt(settings)
        expected = balance_gains(MODEL, settings, T)
        for stance, gain in design.controller.gains.items():
            np.testing.assert_array_equal(gain, expected[stance])


def test_impossible_weights_are_refused_and_change_nothing(design):
    before = design.controller.gains
    with pytest.raises(LqrError, match='no gains for the inner leg'):
        design.judge(dataclasses.replace(SETTINGS, torque_scale=1e-6))
    assert design.controller.gains is before


def test_the_basin_that_follows_is_that_of_the_gains(design):
    before = design.controller.basins
    design.adopt(SOFT)
    assert design.controller.basins is before
    basins = settle(design)
    gain = balance_gains(MODEL, SOFT, T)['outer']
    assert basins['outer'].bounds == sample_basin(MODEL, 'outer', gain, MODEL.torque_limit).bounds


def test_a_lower_limit_makes_the_basin_smaller_at_once(design):
    before = design.controller.basins['inner'].bounds
    design.adopt(dataclasses.replace(SETTINGS, torque_limit=10.0))
    assert design.controller.basins['inner'].bounds == tuple(0.25 * bound for bound in before)
    design.adopt(SETTINGS)
    assert design.controller.basins['inner'].bounds == tuple(0.25 * bound for bound in before)
    assert settle(design)['inner'].bounds == before


def test_of_many_questions_only_the_last_is_answered():
    sampler = BasinSampler(PATH, MODEL)
    gains = balance_gains(MODEL, SETTINGS, T)
    for limit in np.linspace(5.0, MODEL.torque_limit, 100):
        sampler.ask(gains, float(limit))
    basins = sampler.wait(PATIENCE)
    sampler.close()
    assert basins['inner'].bounds[0] == pytest.approx(0.08775)
    assert not sampler.busy


def test_a_sampler_that_died_is_reported():
    sampler = BasinSampler(PATH, MODEL)
    sampler._process.kill()
    sampler.ask(balance_gains(MODEL, SETTINGS, T), 40.0)
    with pytest.raises(BasinError, match='ended with status'):
        sampler.wait(PATIENCE)
    sampler.close()
