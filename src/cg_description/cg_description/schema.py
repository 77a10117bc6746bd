"""What a file may hold, as data: a schema checks plain data and names the path of what is wrong.

    RULE = Mapping({'column': Key(Text()), 'from': Key(Number(), default=None)})
    rule = RULE.of(parse_yaml(text, 'map.yaml'), 'map.yaml')

A message is one line: file, path inside it, what stands there, what is allowed, such as
`robot.yaml: effects[2].parameters.mass.value: 'abc' is no number`. The same schema writes the
reference of the format (model_file.md).
"""

import contextlib
import difflib
import math
import re
import sys
from abc import ABC, abstractmethod
from collections.abc import Mapping as Mapped
from dataclasses import dataclass
from typing import Any

from cg_description.reading import SHOWN, DocumentError, shown

NEEDED = object()  # the default of a key that must be there
# YAML 1.1 takes numbers with an exponent for text, unless they have a point and a sign.
_EXPONENT = re.compile(r'[-+]?[0-9]{1,20}(\.[0-9]{0,30})?[eE][-+]?[0-9]{1,3}')


class Place:
    """Where a value stands: file, path in it, and the kind of error to raise.

    The path is put together only when it is needed, by an error.
    """

    __slots__ = ('above', 'error', 'step', 'where')

    def __init__(
        self,
        where: str,
        step: str | int = '',
        error: type[Exception] = DocumentError,
        above: 'Place | None' = None,
    ):
        self.where, self.step, self.error, self.above = where, step, error, above

    @property
    def path(self) -> str:
        """Such as `effects[2].parameters.mass`."""
        above = self.above.path if self.above else ''
        if isinstance(self.step, int):
            return f'{above}[{self.step}]'
        name = self.step if len(self.step) <= SHOWN else f'{self.step[:SHOWN]}…'
        name = name if name.isprintable() else repr(name)
        return f'{above}.{name}' if above else name

    def key(self, name: str) -> 'Place':
        """The entry of that name."""
        return Place(self.where, name, self.error, self)

    def item(self, index: int) -> 'Place':
        """The entry of that number, from 0."""
        return Place(self.where, index, self.error, self)

    def wrong(self, message: str) -> Exception:
        """The error to raise."""
        return self.error(': '.join(filter(None, (self.where, self.path, message))))


class Kind(ABC):
    """A kind of value. `words` says what it is, for messages and the reference."""

    words: str

    @abstractmethod
    def read(self, value: Any, place: Place) -> Any:
        """The value, checked, with defaults filled in.

        Raises:
            The error of `place`: naming the path, what stands there and what is allowed.
        """

    def of(
        self, value: Any, where: str, error: type[Exception] = DocumentError, path: str = ''
    ) -> Any:
        """As `read`, for a whole document."""
        return self.read(value, Place(where, path, error))


@dataclass(frozen=True)
class Number(Kind):
    """A number; read as a float.

    Attributes:
        lower: Smallest value allowed.
        upper: Largest value allowed.
        positive: Whether 0 is forbidden too.
        infinite: Whether `.inf` is allowed.
        nan: Whether `.nan`, no measurement, is allowed.
    """

    lower: float = -math.inf
    upper: float = math.inf
    positive: bool = False
    infinite: bool = False
    nan: bool = False

    @property
    def words(self) -> str:  # type: ignore[override]
        """In words."""
        if self.positive:
            return 'a positive number'
        bounds = (math.isfinite(self.lower), math.isfinite(self.upper))
        return {
            (False, False): 'a number' if self.infinite else 'a finite number',
            (True, False): f'a number of {self.lower:g} or more',
            (False, True): f'a number of {self.upper:g} or less',
            (True, True): f'a number from {self.lower:g} to {self.upper:g}',
        }[bounds]

    def read(self, value: Any, place: Place) -> float:
        """The number."""
        if isinstance(value, str) and _EXPONENT.fullmatch(value):
            value = float(value)
        if isinstance(value, bool) or not isinstance(value, int | float):
            quoted = isinstance(value, str) and re.fullmatch(r'[-+]?[0-9.]{1,40}', value)
            hint = '; numbers have no quotes' if quoted else f'; {self.words} is needed'
            raise place.wrong(f'{shown(value)} is no number{hint}')
        if isinstance(value, int) and abs(value) > sys.float_info.max:
            raise place.wrong(f'{shown(value)}… is too large; {self.words} is needed')
        if not self.holds(value):
            raise place.wrong(f'{shown(value)} is not allowed; {self.words} is needed')
        return float(value)

    def holds(self, value: float) -> bool:
        """Whether a number lies in the range."""
        if math.isnan(value):
            return self.nan
        if math.isinf(value) and not self.infinite:
            return False
        return self.lower <= value <= self.upper and not (self.positive and value <= 0)


@dataclass(frozen=True)
class Whole(Kind):
    """A whole number from `lower` to `upper`."""

    lower: int
    upper: int = 2**31 - 1

    @property
    def words(self) -> str:  # type: ignore[override]
        """In words."""
        return f'a whole number of {self.lower} or more'

    def read(self, value: Any, place: Place) -> int:
        """The number."""
        if isinstance(value, bool) or not isinstance(value, int):
            raise place.wrong(f'{shown(value)} is not allowed; {self.words} is needed')
        if not self.lower <= value <= self.upper:
            raise place.wrong(f'{shown(value)} is not allowed; {self.words} is needed')
        return value


@dataclass(frozen=True)
class Text(Kind):
    """A text, one of `choices` where there are any; a whole number stands for its digits.

    Attributes:
        choices: The words allowed; empty for any.
        longest: Characters allowed; a name has 100.
    """

    choices: tuple[str, ...] = ()
    longest: int = 1_000_000

    @property
    def words(self) -> str:  # type: ignore[override]
        """In words."""
        if len(self.choices) == 1:
            return f'{self.choices[0]}'
        return f'one of {", ".join(self.choices)}' if self.choices else 'text'

    def read(self, value: Any, place: Place) -> str:
        """The text."""
        if isinstance(value, int) and not isinstance(value, bool):
            value = str(value)
        if not isinstance(value, str):
            quotes = '' if isinstance(value, list | dict) else '; write it in quotes'
            raise place.wrong(f'{shown(value)} is no text{quotes}')
        if self.choices and value not in self.choices:
            hint = meant(value, self.choices) if len(self.choices) > 1 else ''
            raise place.wrong(f'{shown(value)} is not {self.words}{hint}')
        if len(value) > self.longest:
            raise place.wrong(f'{shown(value)} is too long; {self.longest} characters are allowed')
        if any(c < ' ' and c not in '\n\t' for c in value):
            raise place.wrong(f'{shown(value)} holds a control character')
        return value


NAME = Text(longest=100)


@dataclass(frozen=True)
class Flag(Kind):
    """True or false."""

    words = 'true or false'

    def read(self, value: Any, place: Place) -> bool:
        """The truth."""
        if not isinstance(value, bool):
            raise place.wrong(f'{shown(value)} is neither true nor false')
        return value


@dataclass(frozen=True)
class Anything(Kind):
    """Plain data of any form, less numbers that are not finite."""

    words = 'anything'

    def read(self, value: Any, place: Place) -> Any:
        """The data as they are."""
        if isinstance(value, dict):
            return {name: self.read(entry, place.key(name)) for name, entry in value.items()}
        if isinstance(value, list):
            return [self.read(entry, place.item(i)) for i, entry in enumerate(value)]
        if isinstance(value, float) and not math.isfinite(value):
            raise place.wrong(f'{shown(value)} is not allowed; a finite number is needed')
        return value


@dataclass(frozen=True)
class ListOf(Kind):
    """A list of one kind, of `least` to `most` entries."""

    kind: Kind
    least: int = 0
    most: int | None = None

    @property
    def words(self) -> str:  # type: ignore[override]
        """In words."""
        count = f'{self.least} ' if self.least and self.least == self.most else ''
        return f'a list of {count}{plural(self.kind.words)}'

    def read(self, value: Any, place: Place) -> list:
        """The entries."""
        if not isinstance(value, list | tuple):
            raise place.wrong(f'{shown(value)} is no list; {self.words} is needed')
        if len(value) < self.least or (self.most is not None and len(value) > self.most):
            exact = self.least == self.most
            needed = f'{self.least}' if exact else f'{self.least} or more'
            raise place.wrong(f'{shown(value)}; {needed} entries are needed')
        if isinstance(self.kind, Number) and set(map(type, value)) <= {float, int}:
            # Trajectories hold many: the path of each is made only if one is wrong.
            with contextlib.suppress(OverflowError):
                if all(map(self.kind.holds, value)):
                    return list(map(float, value))
        return [self.kind.read(entry, place.item(i)) for i, entry in enumerate(value)]


@dataclass(frozen=True)
class MapOf(Kind):
    """A mapping of any names to one kind."""

    kind: Kind

    @property
    def words(self) -> str:  # type: ignore[override]
        """In words."""
        return f'a mapping from names to {plural(self.kind.words)}'

    def read(self, value: Any, place: Place) -> dict[str, Any]:
        """The entries by name."""
        if not isinstance(value, dict):
            raise place.wrong(f'{shown(value)} is no mapping; {self.words} is needed')
        return {name: self.kind.read(entry, place.key(name)) for name, entry in value.items()}


@dataclass(frozen=True)
class Key:
    """An entry of a mapping.

    Attributes:
        kind: Its kind.
        meaning: One phrase for people.
        default: What is read where it is absent or empty; NEEDED if it must be there.
        unit: Of a number, as people read it.
    """

    kind: Kind
    meaning: str = ''
    default: Any = NEEDED
    unit: str = ''


@dataclass(frozen=True)
class Mapping(Kind):
    """A mapping with known keys.

    Attributes:
        keys: Key -> what it holds.
        further: Whether other keys may stand there too; they are kept as they are.
        fill: Whether keys that are absent get their defaults; otherwise they remain absent.
    """

    keys: Mapped[str, Key]
    further: bool = False
    fill: bool = True

    @property
    def words(self) -> str:  # type: ignore[override]
        """In words."""
        return f'a mapping with {", ".join(self.needed)}' if self.needed else 'a mapping'

    @property
    def needed(self) -> list[str]:
        """Keys that must be there."""
        return [name for name, key in self.keys.items() if key.default is NEEDED]

    def read(self, value: Any, place: Place) -> dict[str, Any]:
        """The entries in the order of the file, then known ones that are absent, by default."""
        if value is None and not self.needed:
            value = {}
        if value is None:
            raise place.wrong(f'nothing is there; {self.words} is needed')
        if not isinstance(value, dict):
            raise place.wrong(f'{shown(value)} is no mapping; {self.words} is needed')
        if 'format' in self.keys:  # a file of another form is told as such, not by its keys
            self._entry('format', value, place)
        others = {name: entry for name, entry in value.items() if name not in self.keys}
        if others and not self.further:
            name = next(iter(others))
            raise place.wrong(
                f'unknown entry {shown(name)}; allowed: {", ".join(self.keys)}'
                f'{meant(name, self.keys)}'
            )
        found = {}
        for name in dict.fromkeys((*value, *self.keys)):
            if name in others:
                found[name] = Anything().read(others[name], place.key(name))
            elif self.fill or value.get(name) is not None or self.keys[name].default is NEEDED:
                found[name] = self._entry(name, value, place)
        return found

    def _entry(self, name: str, value: dict[str, Any], place: Place) -> Any:
        key, entry, place = self.keys[name], value.get(name), place.key(name)
        if entry is not None:
            return key.kind.read(entry, place)
        if key.default is NEEDED:
            raise place.wrong(f'is missing; {key.kind.words} is needed')
        return key.default


def meant(name: str, known: Any) -> str:
    """The nearest known name as the end of a sentence; empty if none is near."""
    near = difflib.get_close_matches(str(name)[:SHOWN], list(known), n=1)
    return f'; did you mean {near[0]!r}?' if near else ''


def plural(words: str) -> str:
    """`a finite number` -> `finite numbers`: the noun comes after at most two adjectives."""
    return re.sub(
        r'^(an? )?((\w+ ){0,1}?)(text|mapping|number|expression|list)\b', r'\2\4s', words, count=1
    )
