"""The zero of a sensor moves while the observer runs: no rate follows from that."""

import math

import numpy as np
import pytest

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup
from cg_estimation.observer_settings import METHODS, ObserverSettings, make_estimator

MODEL = Model.load(model_path('compass_gait_mit'))
T = 2_000_000  # ns


@pytest.fixture
def estimator(request):
    return make_estimator(ObserverSettings(method=request.param), MODEL, Setup())


def run(estimator, n, begin=0, hip=0.1, lean=0.05):
    """So many measurements of a robot that is held; the estimates. An angle may be a function."""
    told = lambda angle, k: angle(k) if callable(angle) else angle  # noqa: E731
    return [
        estimator.step((begin + k) * T, 0.0, {
            'imu_angle': told(lean, k), 'imu_rate': 0.0, 'hip_angle': told(hip, k),
        }) for k in range(n)
    ]  # fmt: skip


@pytest.mark.parametrize('estimator', METHODS, indirect=True)
@pytest.mark.parametrize('jumps', ['hip', 'lean'])
def test_a_zero_that_moves_starts_the_estimate_anew(estimator, jumps):
    run(estimator, 50)
    # 2 ms later everything is elsewhere, and stays there.
    after = run(estimator, 50, 50, **{jumps: 0.6})
    assert estimator.restarts == 1
    rates = np.abs([e.x[2:4] for e in after])
    assert rates.max() < 1.0  # of a jump of 0.5 rad in 2 ms they would be 250 rad/s
    q_inner, q_outer = after[-1].x[:2]
    expected = {'hip': (0.05, -0.55), 'lean': (0.6, 0.5)}[jumps]
    assert (q_inner, q_outer) == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize('estimator', METHODS, indirect=True)
def test_a_reading_that_is_wrong_once_is_left_out(estimator):
    run(estimator, 50)
    after = run(estimator, 50, 50, hip=lambda k: 2.0 if k in (5, 20, 21) else 0.1)
    assert estimator.restarts == 0
    assert np.abs([e.x[2:4] for e in after]).max() < 1.0
    assert after[21].blind == pytest.approx(0.004)  # and says for how long nothing was believed


@pytest.mark.parametrize('estimator', METHODS, indirect=True)
def test_an_encoder_that_was_silent_for_long_starts_the_estimate_anew(estimator):
    """As while a drive homes: nothing comes, and what comes then has another zero."""
    run(estimator, 50)
    during = run(estimator, 500, 50, hip=math.nan)
    assert during[-1].blind == pytest.approx(1.0)
    after = run(estimator, 20, 550, hip=0.0)
    assert estimator.restarts == 1
    assert np.abs([e.x[2:4] for e in after]).max() < 1.0
    assert after[-1].x[0] - after[-1].x[1] == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize('estimator', METHODS, indirect=True)
def test_no_motion_of_the_robot_is_taken_for_a_jump(estimator):
    """A hard fall with as much torque as there is, noise and counts and all."""
    plant = Plant(MODEL, Setup(), np.array([-0.15, 0.4, 4.0, -6.0]), 0.002, seed=3)
    fastest = 0.0
    for k in range(150):
        measured = plant.measure()
        torque = 40.0 * (-1.0) ** (k // 25)
        estimator.step(measured.time_ns, torque, measured.outputs)
        fastest = max(fastest, *np.abs(measured.state[2:4]))
        plant.latch(np.array([torque]))
        plant.advance()
    assert fastest > 6.0
    assert estimator.restarts == 0
