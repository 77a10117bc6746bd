"""Settings of a node as a frozen dataclass: the one place of name, default, unit and bound.

    @dataclass(frozen=True)
    class GateSettings(Settings):
        torque_limit: float = setting(40.0, 'largest torque passed on', unit='N m', minimum=0.0)

The dataclass validates itself at construction, so that whoever builds one, from the command
line, from `ros2 param set` or from Python, gets the same refusal. `ros.py` declares the fields
as ROS parameters; nothing here needs ROS.
"""

from __future__ import annotations

import dataclasses
import math
import textwrap
import typing
from collections.abc import Sequence
from typing import Any

from cg_description.reading import shown

WIDTH, INDENT = 99, ' ' * 6  # of the table


def setting(
    default: Any,
    description: str,
    *,
    unit: str = '',
    minimum: float | None = None,
    maximum: float | None = None,
    choices: Sequence[str] = (),
    live: bool = False,
) -> Any:
    """Field of a Settings class.

    Args:
        default: Its type is the type of the setting; a tuple is a list of its annotated kind.
        description: One sentence for `ros2 param describe`.
        unit: SI unit of the value, '' where it has none.
        minimum: Smallest value allowed, in that unit; None for no bound.
        maximum: Largest value allowed, in that unit; None for no bound.
        choices: The words allowed, for a text.
        live: Whether it may change while the node is at work.
    """
    return dataclasses.field(
        default=default,
        metadata={
            'description': description,
            'unit': unit,
            'minimum': minimum,
            'maximum': maximum,
            'choices': tuple(choices),
            'live': live,
        },
    )


@dataclasses.dataclass(frozen=True)
class Settings:
    """Base of all settings: checks every field against its bounds at construction."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, typing.Iterable) and not isinstance(value, str | bytes):
                value = tuple(value)
                object.__setattr__(self, field.name, value)
            check_setting(field, value)

    @classmethod
    def field(cls, name: str) -> dataclasses.Field:
        """The field of that name; KeyError where there is none."""
        return {field.name: field for field in dataclasses.fields(cls)}[name]


def describe(field: dataclasses.Field) -> str:
    """Description with unit and allowed words, as `ros2 param describe` shows it."""
    text = field.metadata['description']
    if field.metadata['unit']:
        text += f' [{field.metadata["unit"]}]'
    if field.metadata['choices']:
        text += f' (one of: {", ".join(field.metadata["choices"])})'
    return text


def table(kind: type[Settings]) -> str:
    """Name, default, description, unit and range of every setting; `*` where it is live."""
    lines = []
    for field in dataclasses.fields(kind):
        minimum, maximum = field.metadata['minimum'], field.metadata['maximum']
        allowed = '' if minimum is None and maximum is None else f', {_range(minimum, maximum)}'
        live = ' *' if field.metadata['live'] else ''
        lines += [f'  {field.name}{live}  [{_shown(field.default)}]',
                  *textwrap.wrap(f'{describe(field)}{allowed}', WIDTH,
                                 initial_indent=INDENT, subsequent_indent=INDENT)]  # fmt: skip
    return '\n'.join(lines)


def _shown(value: Any) -> str:
    """A default as it is written after `-p name:=`."""
    if isinstance(value, tuple):
        return f'[{", ".join(map(_shown, value))}]'
    if isinstance(value, bool):
        return str(value).lower()
    return "''" if value == '' else str(value)


def check_setting(field: dataclasses.Field, value: Any) -> None:
    """Raise a ValueError that names the setting, its value and what is allowed."""
    choices = field.metadata['choices']
    if choices and value not in choices:
        raise ValueError(f'{field.name} is {shown(value)}; allowed are {", ".join(choices)}')
    minimum, maximum = field.metadata['minimum'], field.metadata['maximum']
    for number in value if isinstance(value, tuple) else (value,):
        if isinstance(number, bool) or not isinstance(number, int | float):
            continue
        below = minimum is not None and number < minimum
        above = maximum is not None and number > maximum
        if math.isnan(number) or below or above:
            raise ValueError(
                f'{field.name} is {number!r}; allowed is {_range(minimum, maximum)}'
                f' {field.metadata["unit"]}'.rstrip()
            )


def _range(minimum: float | None, maximum: float | None) -> str:
    if minimum is None and maximum is None:
        return 'any number but NaN'
    if maximum is None:
        return f'{minimum} or more'
    if minimum is None:
        return f'{maximum} or less'
    return f'{minimum} to {maximum}'
