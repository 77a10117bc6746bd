"""Expressions of import mappings: how a channel is made of the columns of a table.

A closed set, spelt in YAML; nothing is ever evaluated as code. An expression is a number, the
name of a column, or a mapping with exactly one of

    column: NAME        a column; with `unit`, its unit, converted to SI
    constant: NUMBER
    sum: [e, e, ...]
    product: [e, e, ...]
    divide: [e, e]

and optionally `gain` (a factor) and `offset` (in the unit of the result), applied in this order:
value = gain * expression + offset.
"""

from collections.abc import Mapping as Mapped
from typing import Any

import numpy as np

from cg_description.reading import shown
from cg_description.schema import Key, Kind, ListOf, Mapping, Number, Place, Text
from cg_sysid.errors import RecordingError
from cg_sysid.records.tables import Table

# Factor to SI. A unit that is not listed here is converted with `gain`.
UNITS = {
    '1': 1.0,
    'rad': 1.0,
    'rad/s': 1.0,
    'deg': np.pi / 180.0,
    'deg/s': np.pi / 180.0,
    'rev': 2.0 * np.pi,
    'rpm': 2.0 * np.pi / 60.0,
    'N m': 1.0,
    'mN m': 1e-3,
    'V': 1.0,
    'mV': 1e-3,
    'A': 1.0,
    'mA': 1e-3,
    's': 1.0,
    'ms': 1e-3,
    'us': 1e-6,
    'ns': 1e-9,
}
COUNTS = 'counts'
OPERATIONS = ('column', 'constant', 'sum', 'product', 'divide')


class Expression(Kind):
    """An expression as it may stand in a mapping file; read as a mapping."""

    words = 'an expression'

    def read(self, value: Any, place: Place) -> dict[str, Any]:
        """The expression as a mapping of one operation and its modifiers."""
        if isinstance(value, str):
            value = {'column': value}
        if isinstance(value, int | float) and not isinstance(value, bool):
            value = {'constant': value}
        if not isinstance(value, dict):
            raise place.wrong(
                f'{shown(value)} is no expression; a number, a column or a mapping '
                f'with one of {", ".join(OPERATIONS)} is needed'
            )
        found = EXPRESSION.read(value, place)
        operations = [key for key in OPERATIONS if key in found]
        if len(operations) != 1:
            raise place.wrong(
                f'exactly one of {", ".join(OPERATIONS)} is needed; '
                f'there {"are" if operations else "is"} '
                f'{", ".join(operations) or "none"}'
            )
        if found.get('unit') == COUNTS and 'counts_per_rev' not in found:
            raise place.key('counts_per_rev').wrong(f'is missing; unit {COUNTS} needs it')
        return found


EXPRESSION = Mapping({
    'column': Key(Text(), default=''),
    'constant': Key(Number(), default=0.0),
    'sum': Key(ListOf(Expression(), 2), default=()),
    'product': Key(ListOf(Expression(), 2), default=()),
    'divide': Key(ListOf(Expression(), 2, 2), default=()),
    'unit': Key(Text((*UNITS, COUNTS)), default='1'),
    'counts_per_rev': Key(Number(positive=True), default=1.0),
    'gain': Key(Number(), default=1.0),
    'offset': Key(Number(), default=0.0),
}, fill=False)  # fmt: skip


def evaluate(expression: Any, table: Mapped[str, np.ndarray], where: str) -> np.ndarray:
    """Values of an expression on every row of a table.

    Args:
        expression: As read from the mapping file.
        table: Column name -> values, shape (N,).
        where: What to name in an error, such as `channels.angle`.

    Returns:
        Values, shape (N,).

    Raises:
        RecordingError: The expression is malformed, or a column is unknown or no numbers.
    """
    table = table if isinstance(table, Table) else Table(table)
    return _value(Expression().of(expression, where, RecordingError), table, where)


def _value(expression: dict[str, Any], table: Table, where: str) -> np.ndarray:
    operation = next(key for key in OPERATIONS if key in expression)
    value = _apply(operation, expression[operation], table, where)
    unit = expression.get('unit', '1')
    factor = 2.0 * np.pi / expression['counts_per_rev'] if unit == COUNTS else UNITS[unit]
    with np.errstate(over='ignore', invalid='ignore'):  # the record refuses what is not finite
        return expression.get('gain', 1.0) * (value * factor) + expression.get('offset', 0.0)


def _apply(operation: str, operand: Any, table: Table, where: str) -> np.ndarray:
    if operation == 'constant':
        return np.full(table.length, operand)
    if operation == 'column':
        return table.numbers(operand, where)
    parts = [_value(e, table, f'{where}.{operation}[{k}]') for k, e in enumerate(operand)]
    with np.errstate(over='ignore', invalid='ignore'):
        if operation == 'sum':
            return np.sum(parts, axis=0)
        if operation == 'product':
            return np.prod(parts, axis=0)
        zeros = np.flatnonzero(parts[1] == 0.0)
        if len(zeros):
            raise RecordingError(f'{where}: {table.place(zeros[0])}: division by zero')
        return parts[0] / parts[1]
