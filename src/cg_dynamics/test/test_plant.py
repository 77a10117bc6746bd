"""The simulated machine: a push at the hip is an impulse; off its blocks it walks."""

import numpy as np
import pytest
import scipy

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup
from cg_dynamics.walking.hybrid import WalkOptions, walk

MODEL = Model.load(model_path('compass_gait_mit'))
X0 = np.array([0.1, -0.2, 0.3, 0.1])
# Falls forward onto the swing leg.
START = np.array([0.05, -0.2, 0.6, 0.0])


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


@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_machine_off_its_blocks_lands_where_the_hybrid_model_does(bare, stance):
    start = START if stance == 'inner' else START[[1, 0, 3, 2]]
    machine = Plant(bare, Setup(stance=stance, on_blocks=False), start)
    expected = walk(bare, stance, start, 0.4, None, WalkOptions(minimum_step=0.1))
    assert len(expected.impacts) == 1
    for _ in range(200):
        machine.advance()
    assert machine.stance == expected.stance != stance
    # Steps of 1 ms and of 0.1 ms.
    np.testing.assert_allclose(machine.state, expected.state, atol=1e-8)
    contact = machine.measure().contact
    assert contact[machine.stance] > 0 == contact[stance]


@pytest.mark.parametrize(
    'ground', [('impact_restitution', 'coefficient', 0.3), ('foot_slip', 'friction', 0.3)]
)
def test_machine_bounces_and_slides_as_the_hybrid_model_does(bare, ground):
    effect, parameter, value = ground
    model = bare.with_effect(effect, None, **{parameter: value})
    machine = Plant(model, Setup(on_blocks=False), START)
    expected = walk(model, 'inner', START, 0.4, None, WalkOptions(minimum_step=0.1))
    assert {'flight', 'slide'} & {arc.mode for arc in expected.arcs}
    for _ in range(200):
        machine.advance()
    assert machine.stance == expected.stance == 'outer'
    np.testing.assert_allclose(machine.state, expected.state, atol=1e-7)


def test_on_blocks_the_foot_passes(bare):
    machine = Plant(bare, Setup(stance='inner'), START)
    for _ in range(200):
        machine.advance()
    assert machine.stance == 'inner'


def test_steps_shorter_than_the_least_do_not_land(bare):
    machine = Plant(bare, Setup(on_blocks=False), START, minimum_step=0.6)
    for _ in range(200):
        machine.advance()
    assert machine.stance == 'inner'


def test_no_landing_is_looked_for_where_legs_pass_each_other(bare, monkeypatch):
    def located(*args, **kwargs):
        raise AssertionError('looked for')

    monkeypatch.setattr(scipy.optimize, 'brentq', located)
    machine = Plant(bare, Setup(on_blocks=False), np.array([0.02, -0.08, 0.0, 1.0]))
    heights = []
    for _ in range(50):
        machine.advance()
        inner, outer = machine.state[:2]
        heights.append(np.cos(inner) - np.cos(outer))
    assert heights[0] > 0.0 > min(heights)


def test_a_body_that_is_put_somewhere_rests_there_and_is_measured_there():
    plant = Plant(MODEL, Setup(), X0)
    plant.advance()
    plant.place({'q_outer': 0.4})
    np.testing.assert_allclose(plant.state[[1, 2, 3]], [0.4, 0.0, 0.0])
    measured = plant.measure().outputs
    noise = 6 * 5e-4  # rad, of the sensors, and some counts
    assert measured['hip_angle'] == pytest.approx(plant.state[0] - 0.4, abs=noise)
