"""A cart on a rail that is not level: one of the slope's two angles says nothing there."""

import pytest
from slide import CART_POLE, ride

from cg_dynamics.model import Model
from cg_sysid.diagnosis.diagnose import Options, diagnose


def test_a_slope_along_a_rail_is_named_though_nothing_is_known_across_it():
    level = Model.from_text(CART_POLE)
    tilted = level.with_effect('ground_slope', x=0.0, y=0.012)
    found = diagnose(
        level, [ride(tilted, k) for k in range(2)], Options(effects=['ground_slope'], workers=1)
    )
    (cause,) = found.causes
    assert cause.label == 'ground_slope'
    about_y, sigma, _ = cause.parameters['y']
    assert about_y == pytest.approx(0.012, abs=4 * sigma)


def test_a_slope_is_told_from_a_constant_torque_by_where_a_pole_comes_to_rest():
    """As torques say of it first: the drive's constant takes the rest."""
    level = Model.from_text(CART_POLE)
    tilted = level.with_effect('ground_slope', x=0.0, y=0.012)
    biased = level.with_effect('torque_bias', bias=-0.14)
    effects = ['ground_slope', 'torque_constant', 'coulomb_friction', 'payload']
    found = diagnose(
        biased, [ride(tilted, k) for k in range(2)], Options(effects=effects, workers=1)
    )
    (cause,) = found.causes
    assert cause.label == 'ground_slope'
    assert abs(found.model.values['torque_bias.bias']) < 0.01
