"""Settings refuse what their fields do not allow, and say why."""

from dataclasses import dataclass

import pytest

from cg_interfaces.settings import Settings, describe, setting, table


@dataclass(frozen=True)
class Sample(Settings):
    rate: float = setting(500.0, 'rate', unit='Hz', minimum=1.0, maximum=2000.0)
    mode: str = setting('a', 'mode', choices=('a', 'b'))
    weights: tuple[float, ...] = setting((1.0,), 'weights', minimum=0.0)
    name: str = setting('', 'free text')


def test_defaults_are_valid():
    assert Sample().rate == 500.0


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'rate': 0.5}, r'rate is 0\.5; allowed is 1\.0 to 2000\.0 Hz'),
        ({'rate': float('nan')}, 'rate is nan'),
        ({'mode': 'c'}, "mode is 'c'; allowed are a, b"),
        ({'mode': 1000 * 'c'}, "mode is 'c{1,99}…'; allowed are a, b"),
        ({'weights': [1.0, -2.0]}, r'weights is -2\.0; allowed is 0\.0 or more'),
    ],
)
def test_refusals_name_the_setting_its_value_and_what_is_allowed(change, message):
    with pytest.raises(ValueError, match=message):
        Sample(**change)


def test_the_table_says_name_default_unit_and_range_of_each():
    assert table(Sample) == (
        '  rate  [500.0]\n      rate [Hz], 1.0 to 2000.0\n'
        '  mode  [a]\n      mode (one of: a, b)\n'
        '  weights  [[1.0]]\n      weights, 0.0 or more\n'
        "  name  ['']\n      free text"
    )


def test_lists_become_tuples_and_texts_stay():
    sample = Sample(weights=[1.0, 2.0], name='abc')
    assert sample.weights == (1.0, 2.0)
    assert sample.name == 'abc'


def test_description_carries_unit_and_choices():
    assert describe(Sample.field('rate')) == 'rate [Hz]'
    assert describe(Sample.field('mode')) == 'mode (one of: a, b)'
