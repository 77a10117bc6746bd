"""The one reader of YAML and JSON: from a file to plain data, within limits.

Every file that a person or another machine may have written comes through here. What is read is
plain: mappings with text keys, lists, texts, numbers, true, false and nothing. Size, depth and
number of values are checked before anything is built; a key that stands twice, tags and text that
is not UTF-8 are refused. What the data mean is for a schema (schema.py) to say.

YAML is read as PyYAML's safe loader does, less dates, octal, binary and sexagesimal numbers, which
remain the texts that they are. Aliases count as often as they are used.
"""

import json
import re
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import yaml

SHOWN = 40  # characters of a value or key in a message
LONGEST_INTEGER = 18  # digits that are read as an integer; longer ones become floating
LONGEST_NUMBER = 400  # characters that can be a number at all
TEXT_PER_NODE = 100  # characters of a text that count as one more value
NO_NAME = re.compile('[\x00-\x1f\x7f\ud800-\udfff]')  # would split messages or steer a terminal


class DocumentError(ValueError):
    """A file or text that cannot be used; the message says what, where and what is allowed."""


@dataclass(frozen=True)
class Limits:
    """What is read at most.

    Attributes:
        size: Bytes of a file, characters of a text.
        depth: Lists and mappings within each other.
        nodes: Values, keys and containers.
    """

    size: int
    depth: int
    nodes: int


YAML = Limits(size=1_000_000, depth=40, nodes=20_000)
JSON = Limits(size=8_000_000, depth=40, nodes=300_000)
JSON_LOG = Limits(size=400_000_000, depth=40, nodes=20_000_000)  # of samples, not of settings


def path_of(name: str | Path, error: type[Exception] = DocumentError) -> Path:
    """The path that somebody means by a name, `~` included, whether or not it is there.

    Raises:
        error: No file can have that name.
    """
    if NO_NAME.search(str(name)):
        raise error(f'{shown(str(name))} is no name of a file')
    try:
        path = Path(name).expanduser()
        path.exists()
    except OSError as problem:
        raise error(f'{shown(str(name))}: {problem.strerror}') from None
    except (RuntimeError, ValueError):  # the home of nobody; no text
        raise error(f'{shown(str(name))} is no name of a file') from None
    return path


def path_below(folder: Path, name: str, where: str, error: type[Exception]) -> Path:
    """The path of a file that is named inside another one: in its folder or below.

    A symbolic link there leads where its owner wanted.

    Args:
        folder: Of the file that has the name in it.
        name: Relative, without `..`.
        where: Place of the name, for the message.
        error: Kind of the error to raise.

    Raises:
        error: The name leads out of the folder, or no file can have it.
    """
    path = path_of(name, error)
    if path.is_absolute() or not path.parts or '..' in path.parts:
        raise error(f'{where}: {shown(name)} leads out of {folder}; a file in it is needed')
    return folder / path


def read_text(
    path: str | Path, error: type[Exception] = DocumentError, limits: Limits = YAML
) -> str:
    """The text of a file.

    Raises:
        error: It cannot be opened, is too large or is not UTF-8.
    """
    try:
        if NO_NAME.search(str(path)):
            raise ValueError
        with open(path, 'rb') as file:
            raw = file.read(limits.size + 1)
    except OSError as problem:
        raise error(f'{path}: cannot be read: {problem.strerror}') from None
    except ValueError:
        raise error(f'{shown(str(path))} is no name of a file') from None
    if len(raw) > limits.size:
        raise error(f'{path}: larger than {limits.size / 1e6:g} MB, the most that is read')
    try:
        return raw.decode('utf-8-sig')
    except UnicodeDecodeError as problem:
        line = raw.count(b'\n', 0, problem.start) + 1
        raise error(
            f'{path}: line {line}: the byte {raw[problem.start]:#04x} is not UTF-8; '
            'the file must be text in UTF-8'
        ) from None


def parse_yaml(
    text: str, where: str, error: type[Exception] = DocumentError, limits: Limits = YAML
) -> Any:
    """Plain data from YAML.

    Args:
        text: One document.
        where: What to call it in a message, such as the name of the file.
        error: Kind of the error to raise.
        limits: What is read at most.

    Raises:
        error: No YAML, beyond the limits, a tag, a key that stands twice.
    """
    _require_size(text, where, error, limits)
    if re.search(r'^%TAG', text, re.MULTILINE):
        raise error(f'{where}: tags (%TAG) are not allowed')
    builder = _Builder(limits)
    try:
        # One document more than allowed is enough to know.
        return builder.build(yaml.parse(text, Loader=_LOADER))
    except _Refused as problem:
        raise error(f'{where}: {problem}') from None
    except yaml.YAMLError as problem:
        raise error(f'{where}: not YAML: {_yaml_problem(problem)}') from None
    except (ValueError, OverflowError):  # an escaped character that does not exist
        raise error(f'{where}: not YAML: a character that does not exist') from None


def parse_json(
    text: str, where: str, error: type[Exception] = DocumentError, limits: Limits = JSON
) -> Any:
    """Plain data from JSON; otherwise as `parse_yaml`. NaN and Infinity are read as numbers."""
    _require_size(text, where, error, limits)
    try:
        _require_structure(text, limits)
        tree = json.loads(text, object_pairs_hook=_mapping, parse_int=_integer)
        if re.search(r'\\u[dD][89a-fA-F]', text):
            json.dumps(tree, ensure_ascii=False).encode()
    except json.JSONDecodeError as problem:
        raise error(
            f'{where}: not JSON: line {problem.lineno}, column {problem.colno}: {problem.msg}'
        ) from None
    except UnicodeEncodeError:
        raise error(f'{where}: not JSON: half of a character (a lone surrogate)') from None
    except _Refused as problem:
        raise error(f'{where}: {problem}') from None
    return tree


def shown(value: Any) -> str:
    """A value as a message shows it: short, in one line, in the words of the file."""
    if value is None:
        return 'nothing'
    if isinstance(value, bool):
        return 'true' if value else 'false'
    if isinstance(value, str):
        return repr(value if len(value) <= SHOWN else f'{value[:SHOWN]}…')
    if isinstance(value, dict):
        return f'a mapping of {len(value)}' if value else 'an empty mapping'
    if isinstance(value, list | tuple):
        return f'a list of {len(value)}' if value else 'an empty list'
    return str(value)[:SHOWN]


class _Refused(Exception):
    """What the limits or the rules of this module forbid; the message lacks the file."""


_LOADER = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
_NOTHING = object()
# No more than PyYAML takes for numbers: a text that it writes without quotes must come back.
_INTEGER = re.compile(r'[-+]?(0|[1-9][0-9]*)')
_FLOAT = re.compile(r'[-+]?[0-9]+\.[0-9]*([eE][-+][0-9]+)?|\.[0-9]+([eE][-+][0-9]+)?')
# A string may lack its end: then all that follows belongs to it, and no JSON comes of it.
_STRING = re.compile(r'"[^"\\]*(?:\\.[^"\\]*)*"?', re.DOTALL)
_BRACKET = re.compile(r'[][{}]')
_WORDS = {
    **dict.fromkeys(('', '~', 'null', 'Null', 'NULL'), None),
    **dict.fromkeys(('true', 'True', 'TRUE', 'yes', 'Yes', 'YES', 'on', 'On', 'ON'), True),
    **dict.fromkeys(('false', 'False', 'FALSE', 'no', 'No', 'NO', 'off', 'Off', 'OFF'), False),
    **dict.fromkeys(('.nan', '.NaN', '.NAN'), float('nan')),
    **dict.fromkeys((s + w for s in ('', '+') for w in ('.inf', '.Inf', '.INF')), float('inf')),
    **dict.fromkeys(('-.inf', '-.Inf', '-.INF'), -float('inf')),
}


@dataclass
class _Open:
    """A list or mapping that is being read, and the key that waits for its value."""

    content: Any
    anchor: str | None
    nodes: int
    key: Any = _NOTHING


class _Builder:
    """Builds a document out of the events of PyYAML, as they come."""

    def __init__(self, limits: Limits):
        self.limits = limits
        self.nodes = 0
        self.open: list[_Open] = []
        self.anchors: dict[str, tuple[Any, int]] = {}
        self.root: Any = None
        self.documents = 0
        self.line = 0

    def build(self, events: Iterable[yaml.Event]) -> Any:
        for event in events:
            self.line = event.start_mark.line + 1 if event.start_mark else 0
            if isinstance(event, yaml.DocumentStartEvent):
                self.documents += 1
                if self.documents > 1:
                    self._refuse('a second document begins here; one is allowed')
            elif isinstance(event, yaml.AliasEvent):
                name = str(event.anchor)
                if name not in self.anchors:
                    self._refuse(f'the alias {shown(name)} has no anchor before it')
                value, nodes = self.anchors[name]
                self._count(nodes)
                self._put(value)
            elif isinstance(event, yaml.ScalarEvent):
                self._scalar(event)
            elif isinstance(event, yaml.MappingStartEvent):
                self._begin({}, event)
            elif isinstance(event, yaml.SequenceStartEvent):
                self._begin([], event)
            elif isinstance(event, yaml.MappingEndEvent | yaml.SequenceEndEvent):
                done = self.open.pop()
                if done.anchor is not None:
                    self.anchors[done.anchor] = done.content, self.nodes - done.nodes
                self._put(done.content)
        return self.root

    def _scalar(self, event: yaml.ScalarEvent) -> None:
        text = event.value
        if event.tag is not None and event.tag != '!':
            self._refuse(f'the tag {shown(event.tag)} is not allowed')
        if not text.isascii() and any('\ud800' <= c <= '\udfff' for c in text):
            self._refuse('half of a character (a lone surrogate)')
        self._count(1 + len(text) // TEXT_PER_NODE)
        value = text if self._awaits_key() or not event.implicit[0] else _resolved(text)
        if event.anchor is not None:
            self.anchors[event.anchor] = value, 1 + len(text) // TEXT_PER_NODE
        self._put(value)

    def _begin(self, content: Any, event: yaml.CollectionStartEvent) -> None:
        if event.tag is not None and event.tag != '!':
            self._refuse(f'the tag {shown(event.tag)} is not allowed')
        if self._awaits_key():
            self._refuse('a list or mapping cannot be a key; a key is a word')
        if len(self.open) >= self.limits.depth:
            self._refuse(f'lists and mappings lie more than {self.limits.depth} deep')
        self.open.append(_Open(content, event.anchor, self.nodes))
        self._count(1)

    def _put(self, value: Any) -> None:
        if not self.open:
            self.root = value
            return
        top = self.open[-1]
        if isinstance(top.content, list):
            top.content.append(value)
        elif top.key is not _NOTHING:
            top.content[top.key] = value
            top.key = _NOTHING
        elif not isinstance(value, str):
            self._refuse(f'{shown(value)} cannot be a key; a key is a word')
        elif value in top.content:
            self._refuse(f'the key {shown(value)} stands there twice')
        else:
            top.key = value

    def _awaits_key(self) -> bool:
        if not self.open:
            return False
        top = self.open[-1]
        return isinstance(top.content, dict) and top.key is _NOTHING

    def _count(self, nodes: int) -> None:
        self.nodes += nodes
        if self.nodes > self.limits.nodes:
            self._refuse(f'more than {self.limits.nodes} values, the most that is read')

    def _refuse(self, message: str) -> None:
        keys = [o.key for o in self.open if o.key is not _NOTHING]
        path = f'{".".join(map(str, keys))}: ' if keys and len(keys) < 8 else ''
        raise _Refused(f'line {self.line}: {path[: 3 * SHOWN]}{message}')


def _resolved(text: str) -> Any:
    """A scalar without quotes: a number, true, false, nothing, or the text that it is."""
    if text in _WORDS:
        return _WORDS[text]
    if len(text) <= LONGEST_NUMBER:
        if _INTEGER.fullmatch(text):
            return _integer(text)
        if _FLOAT.fullmatch(text):
            return float(text)
    return text


def _require_structure(text: str, limits: Limits) -> None:
    """Refuse JSON that nests too deep or holds too much, before anything is built."""
    nodes, depth, end = 1, 0, 0
    for string in chain(_STRING.finditer(text), (None,)):
        between = text[end : string.start() if string else len(text)]
        nodes += (string is not None) + sum(map(between.count, ',[{'))
        if nodes > limits.nodes:
            raise _Refused(f'more than {limits.nodes} values, the most that is read')
        for bracket in _BRACKET.findall(between):
            depth += 1 if bracket in '[{' else -1
            if depth > limits.depth:
                raise _Refused(f'lists and mappings lie more than {limits.depth} deep')
        end = string.end() if string else end


def _integer(text: str) -> int | float | str:
    if len(text) <= LONGEST_INTEGER:
        return int(text)
    return float(text) if len(text) <= 300 else text  # 10^300 is a number, 10^400 none


def _mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        seen: set[str] = set()
        for key, _ in pairs:
            if key in seen:
                raise _Refused(f'the key {shown(key)} stands twice in one mapping')
            seen.add(key)
    return found


def _require_size(text: str, where: str, error: type[Exception], limits: Limits) -> None:
    if len(text) > limits.size:
        raise error(f'{where}: larger than {limits.size / 1e6:g} MB, the most that is read')


def _yaml_problem(problem: yaml.YAMLError) -> str:
    mark = getattr(problem, 'problem_mark', None)
    words = ' '.join(str(getattr(problem, 'problem', None) or '').split())
    if mark is not None:
        return f'line {mark.line + 1}, column {mark.column + 1}: {words}'
    if isinstance(problem, yaml.reader.ReaderError):
        character = problem.character
        code = character if isinstance(character, int) else ord(character[:1])
        return f'the character {code:#04x} at place {problem.position} is not allowed'
    return ' '.join(str(problem).split())
