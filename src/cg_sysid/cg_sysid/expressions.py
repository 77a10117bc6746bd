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

from typing import Any

import numpy as np

from cg_sysid.errors import RecordingError
from cg_sysid.tables import Table

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
MODIFIERS = ('unit', 'counts_per_rev', 'gain', 'offset')


def evaluate(expression: Any, table: Table, where: str) -> np.ndarray:
    """Values of an expression on every row of a table.

    Args:
        expression: As read from the mapping file.
        table: Column name -> values, shape (N,).
        where: What to name in an error, such as `channels.angle`.

    Returns:
        Values, shape (N,).

    Raises:
        RecordingError: The expression is malformed, or a column or unit is unknown.
    """
    if isinstance(expression, str):
        expression = {'column': expression}
    if isinstance(expression, int | float) and not isinstance(expression, bool):
        expression = {'constant': expression}
    if not isinstance(expression, dict):
        msg = f'{where}: {expression!r} is no expression; a number, a column or a mapping is'
        raise RecordingError(msg)
    operations = [key for key in expression if key in OPERATIONS]
    unknown = [key for key in expression if key not in OPERATIONS + MODIFIERS]
    if len(operations) != 1 or unknown:
        msg = (f'{where}: exactly one of {", ".join(OPERATIONS)} and optionally '
               f'{", ".join(MODIFIERS)} are allowed; got {", ".join(map(str, expression))}')
        raise RecordingError(msg)
    operation = operations[0]
    value = _apply(operation, expression[operation], table, where)
    value = value * _unit_factor(expression, where)
    gain = _number(expression.get('gain', 1.0), f'{where}.gain')
    offset = _number(expression.get('offset', 0.0), f'{where}.offset')
    return gain * value + offset


def _apply(operation: str, operand: Any, table: Table, where: str) -> np.ndarray:
    rows = len(next(iter(table.values())))
    if operation == 'constant':
        return np.full(rows, _number(operand, where))
    if operation == 'column':
        return column(table, operand, where)
    if not isinstance(operand, list) or len(operand) < 2:
        raise RecordingError(f'{where}: {operation} needs a list of two or more expressions')
    parts = [evaluate(e, table, f'{where}.{operation}[{k}]') for k, e in enumerate(operand)]
    if operation == 'sum':
        return np.sum(parts, axis=0)
    if operation == 'product':
        return np.prod(parts, axis=0)
    if len(parts) != 2:
        raise RecordingError(f'{where}: divide needs exactly two expressions, got {len(parts)}')
    zeros = np.flatnonzero(parts[1] == 0.0)
    if len(zeros):
        raise RecordingError(f'{where}: division by zero in row {int(zeros[0])}')
    return parts[0] / parts[1]


def column(table: Table, name: Any, where: str) -> np.ndarray:
    """A column of numbers.

    Raises:
        RecordingError: No such column, or it holds text.
    """
    if name not in table:
        raise RecordingError(f'{where}: no column {name!r}; the file has {", ".join(table)}')
    values = table[name]
    if values.dtype.kind not in 'fiub':
        raise RecordingError(f'{where}: column {name!r} holds text such as {str(values[0])!r}')
    return values


def _unit_factor(expression: dict, where: str) -> float:
    unit = expression.get('unit', '1')
    if unit == COUNTS:
        per_rev = _number(expression.get('counts_per_rev'), f'{where}.counts_per_rev')
        if per_rev <= 0:
            raise RecordingError(f'{where}.counts_per_rev is {per_rev}; it must be positive')
        return 2.0 * np.pi / per_rev
    if unit not in UNITS:
        msg = f'{where}: unit {unit!r} is not one of {", ".join([*UNITS, COUNTS])}'
        raise RecordingError(msg)
    return UNITS[unit]


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise RecordingError(f'{where} is {value!r}; a finite number is needed')
    return float(value)
