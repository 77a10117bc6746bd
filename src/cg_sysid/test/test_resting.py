"""Where friction lets a joint rest, against closed forms."""

import numpy as np
import pytest

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.checks.resting import resting_band

PENDULUM = Model.load(model_path('sydney_pendulum'))


def test_a_pendulum_rests_within_friction_over_weight():
    # 0.00545 N m over 0.307 N m: results.md, and the viscous share at 0.05 rad/s.
    band = resting_band(PENDULUM, Setup())
    assert band['angle'] == pytest.approx(0.018, rel=0.02)


def test_twice_the_friction_is_twice_the_band():
    none, once, twice = (
        resting_band(PENDULUM.with_values({'coulomb_friction.torque': torque}), Setup())['angle']
        for torque in (0.0, 0.005, 0.01)
    )
    assert twice - none == pytest.approx(2 * (once - none), rel=1e-6)


def test_a_leg_that_is_held_rests_where_it_is():
    robot = Model.load(model_path('compass_gait_mit'))
    held = resting_band(robot, Setup(fixture='inner_fixed'))
    free = resting_band(robot, Setup())
    assert held['imu_angle'] == 0.0
    assert np.all([0.0 < held['hip_angle'] < free['hip_angle']])
