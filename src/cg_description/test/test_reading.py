"""The one reader: plain data comes back, everything else is refused before it is built."""

import json
import time

import pytest
import yaml

from cg_description import reading
from cg_description.reading import DocumentError, Limits, parse_json, parse_yaml, read_text, shown

LOADERS = [yaml.SafeLoader, *([yaml.CSafeLoader] if yaml.__with_libyaml__ else [])]


@pytest.fixture(params=LOADERS, ids=lambda loader: loader.__name__, autouse=True)
def loader(request, monkeypatch):
    """With the compiled parser and without."""
    monkeypatch.setattr(reading, '_LOADER', request.param)


PLAIN = {
    'text': 'words', 'quoted': '1.5', 'number': -1.5, 'whole': 12, 'small': 1e-07, 'big': 1e300,
    'yes': 'yes', 'truth': True, 'lie': False, 'nothing': None, 'list': [1, [2.5, 'x'], {}, []],
    'date': '2011-03-04', 'time': '12:30', 'octal': '010', 'exponent': '1e3', 'hash': '92546e15',
    'multi': 'a\nb\n', 'umlaut': 'ü§€', 'equals': '=', 'merge': '<<', 'under': '1_000',
    'infinite': float('inf'), 'minus': -float('inf'),
}  # fmt: skip


def test_what_pyyaml_writes_comes_back():
    for flow in (True, False):
        for unicode in (True, False):
            text = yaml.safe_dump(PLAIN, default_flow_style=flow, allow_unicode=unicode)
            assert parse_yaml(text, 'x') == PLAIN


def test_shared_entries_come_back():
    shared = {'a': [1.0, 2.0]}
    text = yaml.safe_dump({'first': shared, 'second': shared})
    assert '*id001' in text
    assert parse_yaml(text, 'x') == {'first': shared, 'second': shared}


def test_what_json_writes_comes_back():
    tree = {'a': [1, 2.5, None, True, 'é"\\\n'], 'b': {'c': {}}, 'd': 10**15}
    assert parse_json(json.dumps(tree), 'x') == tree
    assert parse_json(json.dumps(tree, ensure_ascii=False, indent=1), 'x') == tree


def short(words):
    """The name of a case in reports."""
    return words[:30]


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('a: [1, 2', 'here: not YAML: line 1|here: not YAML: line 2'),
        ('a: 1\nb:\n  c: 1\n  c: 2', r"line 4: b: the key 'c' stands there twice"),
        ('a: !!float 3', 'line 1: a: the tag .*float. is not allowed'),
        ('a: !!python/object/apply:os.system [x]', 'the tag .* is not allowed'),
        ('%TAG ! tag:x,2000:\n--- a', 'tags .* are not allowed'),
        ('a: *b', "line 1: a: the alias 'b' has no anchor before it"),
        ('a: &a [1, *a]', "the alias 'a' has no anchor before it"),
        ('[1, 2]: 3', 'a list or mapping cannot be a key'),
        ('a: 1\n---\nb: 2', 'line 2: a second document begins here'),
        ('[' * 1500, 'lie more than 40 deep'),
        ('- ' * 1500 + 'x', 'lie more than 40 deep'),
        ('a: "\\ud800"', 'surrogate|not YAML'),
        ('a: "\\U7FFFFFFF"', 'not YAML'),
        ('a: \x00', 'not YAML: the character 0x00'),
    ],
    ids=short,
)
def test_what_is_no_plain_yaml_is_refused(text, message):
    with pytest.raises(DocumentError, match=message) as caught:
        parse_yaml(text, 'here')
    assert '\n' not in str(caught.value)


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('{"a": ', 'here: not JSON: line 1, column 7'),
        ('{"a": 1, "b": {"c": 1, "c": 2}}', "the key 'c' stands twice"),
        ('[' * 100_000, 'more than 40 deep'),
        ('{"a":' * 100_000, 'more than 40 deep'),
        ('"\\ud800"', 'surrogate'),
        ('"' + '\\"' * 50_000, 'not JSON'),
        ('[' + '[],' * 400_000 + '1]', 'more than 300000 values'),
    ],
    ids=short,
)
def test_what_is_no_plain_json_is_refused(text, message):
    began = time.process_time()
    with pytest.raises(DocumentError, match=message):
        parse_json(text, 'here')
    assert time.process_time() - began < 1.0


def test_aliases_of_aliases_count_as_often_as_they_are_used():
    lines = ['a: &a0 [x, x, x, x, x, x, x, x, x]']
    lines += [f'b{k}: &a{k} [{", ".join([f"*a{k - 1}"] * 9)}]' for k in range(1, 20)]
    with pytest.raises(DocumentError, match='line 5: b4: more than 20000 values'):
        parse_yaml('\n'.join(lines), 'x')
    with pytest.raises(DocumentError, match='more than 20000 values'):
        parse_yaml('[&a ' + 'x' * 100_000 + ', *a' * 100 + ']', 'x')


def test_limits_are_stated(tmp_path):
    few = Limits(size=100, depth=2, nodes=5)
    assert parse_yaml('[[1, 2]]', 'x', limits=few) == parse_json('[[1, 2]]', 'x', limits=few)
    for parse in (parse_yaml, parse_json):
        with pytest.raises(DocumentError, match=r'x: .*more than 2 deep'):
            parse('[[[1]]]', 'x', limits=few)
        with pytest.raises(DocumentError, match=r'x: .*more than 5 values'):
            parse('[1, 2, 3, 4, 5, 6]', 'x', limits=few)
        with pytest.raises(DocumentError, match=r'x: larger than 0.0001 MB'):
            parse('[' + ' ' * 100 + ']', 'x', limits=few)
    (tmp_path / 'a').write_bytes(b'x' * 101)
    with pytest.raises(DocumentError, match=r'a: larger than 0.0001 MB'):
        read_text(tmp_path / 'a', limits=few)


@pytest.mark.parametrize('digits', [18, 30, 300, 400, 100_000])
def test_integers_of_any_length_are_read_or_remain_text(digits):
    text = '7' * digits
    for value in (parse_yaml(text, 'x'), parse_json(text, 'x')):
        assert value == (int(text) if digits <= 18 else float(text) if digits <= 300 else text)


def test_files_that_are_no_text_are_refused(tmp_path):
    (tmp_path / 'a').write_bytes(b'name: x\nunit: \xb0\n')
    with pytest.raises(DocumentError, match='a: line 2: the byte 0xb0 is not UTF-8'):
        read_text(tmp_path / 'a')
    (tmp_path / 'b').write_bytes(b'\xef\xbb\xbfname: x\r\n')
    assert parse_yaml(read_text(tmp_path / 'b'), 'b') == {'name': 'x'}
    for path in (tmp_path, tmp_path / 'none', 'a\0b'):
        with pytest.raises(DocumentError, match=r'cannot be read|no name of a file'):
            read_text(path)


def test_values_are_shown_in_short_and_in_one_line():
    values = ['a\nb', 'x' * 10_000, {'a': 1}, [1, 2], None, True, 10**50, '\x1b[31m']
    for value in values:
        assert len(shown(value)) < 60
        assert shown(value).isprintable()
