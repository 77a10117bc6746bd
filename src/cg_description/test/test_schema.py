"""Schemas: values come back checked, and a message names path, value and what is allowed."""

import math

import pytest

from cg_description.reading import DocumentError
from cg_description.schema import Anything, Flag, Key, ListOf, MapOf, Mapping, Number, Text, Whole

POINT = Mapping({'x': Key(Number(0.0, 10.0)), 'y': Key(Number(), default=0.0)})
FORM = Mapping({
    'name': Key(Text(), default=''),
    'kind': Key(Text(('inner', 'outer')), default='inner'),
    'count': Key(Whole(1), default=1),
    'sure': Key(Flag(), default=False),
    'points': Key(ListOf(POINT), default=()),
    'levels': Key(MapOf(ListOf(Number(positive=True), 2, 2)), default={}),
    'rest': Key(Anything(), default=None),
})  # fmt: skip


def test_defaults_are_filled_in():
    assert POINT.of({'x': 1}, 'f') == {'x': 1.0, 'y': 0.0}
    assert FORM.of({}, 'f') == FORM.of(None, 'f')
    partial = Mapping(FORM.keys, fill=False)
    assert partial.of({'count': 3, 'name': None}, 'f') == {'count': 3}
    assert Mapping({}, further=True).of({'a': [1]}, 'f') == {'a': [1]}


@pytest.mark.parametrize(
    ('tree', 'message'),
    [
        ([], 'f: an empty list is no mapping; a mapping is needed'),
        ({'nme': 1}, "f: unknown entry 'nme'; allowed: name, kind, .*; did you mean 'name'"),
        ({'name': 1.5}, 'f: name: 1.5 is no text; write it in quotes$'),
        ({'name': True}, 'f: name: true is no text; write it in quotes$'),
        ({'name': {'a': 1}}, 'f: name: a mapping of 1 is no text$'),
        ({'name': 'a\x00b'}, r"f: name: 'a\\x00b' holds a control character"),
        ({'kind': 'iner'}, "f: kind: 'iner' is not one of inner, outer; did you mean 'inner'"),
        ({'count': 0}, 'f: count: 0 is not allowed; a whole number of 1 or more is needed'),
        ({'count': 1.0}, 'f: count: 1.0 is not allowed; a whole number'),
        ({'count': True}, 'f: count: true is not allowed'),
        ({'sure': 'yes'}, "f: sure: 'yes' is neither true nor false"),
        ({'points': {'x': 1}}, 'f: points: a mapping of 1 is no list; a list of mappings with x'),
        ({'points': [{'x': 1}, {'y': 1}]}, r'f: points\[1\].x: is missing; a number from 0 to 10'),
        ({'points': [{'x': 11}]}, r'f: points\[0\].x: 11 is not allowed; a number from 0 to 10'),
        ({'points': [{'x': math.nan}]}, r'f: points\[0\].x: nan is not allowed'),
        ({'points': [{'x': 10**400}]}, r'f: points\[0\].x: 1000.*… is too large'),
        ({'points': [None]}, r'f: points\[0\]: nothing is there; a mapping with x is needed'),
        ({'levels': {'a b': [1]}}, r'f: levels.a b: a list of 1; 2 entries are needed'),
        ({'levels': {'a': [1, 0]}}, r'f: levels.a\[1\]: 0 is not allowed; a positive number'),
        ({'levels': {'a': [1, '2']}}, r"f: levels.a\[1\]: '2' is no number; numbers have no"),
        ({'levels': {'k' * 99: 1}}, r'f: levels.k{40}…: 1 is no list; a list of 2 positive num'),
        ({'levels': {'a\nb': 1}}, r"f: levels.'a\\nb': 1 is no list"),
        ({'rest': [{'a': [1, math.inf]}]}, r'f: rest\[0\].a\[1\]: inf is not allowed'),
    ],
)
def test_message_names_path_value_and_what_is_allowed(tree, message):
    with pytest.raises(DocumentError, match=message) as caught:
        FORM.of(tree, 'f')
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize('text', ['1e-3', '1E3', '+2.5e10', '-1.e2'])
def test_numbers_with_an_exponent_are_numbers(text):
    assert Number().of(text, 'f') == float(text)


def test_long_lists_of_numbers_come_back_as_floats():
    assert ListOf(Number()).of([1, 2.5], 'f') == [1.0, 2.5]
    assert all(type(x) is float for x in ListOf(Number()).of([1, 2.5], 'f'))
    with pytest.raises(DocumentError, match=r'f: \[1\]: true is no number'):
        ListOf(Number()).of([1.0, True], 'f')


def test_error_is_of_the_kind_that_is_asked_for():
    with pytest.raises(KeyError, match='f: x: is missing'):
        POINT.of({}, 'f', KeyError)
