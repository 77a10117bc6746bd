"""Hidden machines: repeatable, consistent, really different."""

import pytest

from cg_bringup.hidden import hide, hideable_effects
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_sysid.experiments.catalogue import ExperimentError

NOMINAL = Model.load(model_path('compass_gait_mit'))


@pytest.mark.parametrize('effect', hideable_effects(NOMINAL))
def test_every_effect_can_be_hidden(effect):
    hidden = hide(NOMINAL, effect, seed=5)
    assert hidden.effect == effect
    for name, value in hidden.values.items():
        assert hidden.model.values[f'{hidden.model.effect(effect).label}.{name}'] == value
    hidden.model.require_consistency()


@pytest.mark.parametrize('seed', range(20))
def test_believed_numbers_are_off_by_10_to_20_percent(seed):
    hidden = hide(NOMINAL, None, seed)
    assert {'c1', 'c2', 'c4', 'c5'} <= set(hidden.factors)
    assert all(0.1 <= abs(factor - 1.0) <= 0.2 for factor in hidden.factors.values())


def test_the_same_seed_hides_the_same():
    assert hide(NOMINAL, None, 3).model.text() == hide(NOMINAL, None, 3).model.text()
    assert len({hide(NOMINAL, None, seed).effect for seed in range(30)}) > 5


def test_unknown_effect_lists_those_there_are():
    with pytest.raises(ExperimentError, match='payload'):
        hide(NOMINAL, 'gremlins', 0)
