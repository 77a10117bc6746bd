"""The simulated machine: a push at the hip, against what an impulse is."""

import numpy as np
import pytest

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup

MODEL = Model.load(model_path('compass_gait_mit'))
X0 = np.array([0.1, -0.2, 0.3, 0.1])


@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_a_push_is_the_limit_of_a_short_strong_force(stance):
    pushed = Plant(MODEL, Setup(stance=stance), X0)
    pushed.push(3.0)
    jump = pushed.state - X0
    assert (jump[:2] == 0.0).all()
    # The effect spreads the same impulse over a Gaussian of 10 ms; the mean of the state before
    # and after it does not know how long it took, to first order.
    force = MODEL.with_effect('external_push', impulse=3.0, instant=0.1, duration=0.01)
    free, hit = (Plant(m, Setup(stance=stance), X0) for m in (MODEL, force))
    for _ in range(100):
        free.advance()
        hit.advance()
    late = Plant(MODEL, Setup(stance=stance), X0)
    for k in range(100):
        if k == 50:
            late.push(3.0)
        late.advance()
    # 3 N s change the rates by some 0.2 rad/s; the difference is of second order in 10 ms.
    assert np.abs(late.state - free.state)[2:].max() > 0.1
    np.testing.assert_allclose(late.state, hit.state, atol=2e-3)


def test_a_push_forward_throws_the_stance_leg_forward():
    plant = Plant(MODEL, Setup(), np.zeros(4))
    plant.push(1.0)
    assert plant.state[2] > 0
