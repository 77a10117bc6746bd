"""The simulated machine off its blocks: it walks as the hybrid simulation does."""

import numpy as np
import pytest

from cg_dynamics.hybrid import WalkOptions, walk
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup

# Falls forward onto the swing leg.
START = np.array([0.05, -0.2, 0.6, 0.0])


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
