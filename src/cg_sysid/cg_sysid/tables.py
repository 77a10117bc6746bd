"""Tables: columns of numbers read from CSV, MATLAB and JSON logs."""

import csv
import json
from pathlib import Path

import numpy as np
import scipy.io
from scipy.io.matlab import MatReadError

from cg_sysid.errors import RecordingError

Table = dict[str, np.ndarray]


def read_table(path: Path) -> Table:
    """Read a log to columns of equal length.

    A `.csv` has a header line. A `.mat` (up to version 7.2) holds vectors, also inside structs,
    whose columns are then named `struct.field`; scalars and matrices are left out. A `.json`
    holds a mapping of lists, or a list of mappings, or either of them under one key
    `entries`.

    Args:
        path: File to read; the suffix says how.

    Returns:
        Column name -> values, shape (N,).

    Raises:
        RecordingError: No such file, an unknown suffix, an empty or malformed table.
    """
    if not path.is_file():
        raise RecordingError(f'{path}: no such file')
    readers = {'.csv': _read_csv, '.mat': _read_mat, '.json': _read_json}
    if path.suffix not in readers:
        msg = f'{path}: suffix {path.suffix!r} is not one of {", ".join(readers)}'
        raise RecordingError(msg)
    table = readers[path.suffix](path)
    if not table or not len(next(iter(table.values()))):
        raise RecordingError(f'{path}: empty; no row of numbers')
    return table


def _read_csv(path: Path) -> Table:
    with path.open(newline='', encoding='utf-8-sig') as stream:
        rows = list(csv.reader(stream))
    if not rows:
        return {}
    header = [name.strip() for name in rows[0]]
    body = [row for row in rows[1:] if row]
    for number, row in enumerate(body, start=2):
        if len(row) != len(header):
            msg = f'{path}: line {number} has {len(row)} fields, the header {len(header)}'
            raise RecordingError(msg)
    columns = {}
    for index, name in enumerate(header):
        try:
            columns[name] = np.array([row[index] for row in body], dtype=float)
        except ValueError:
            columns[name] = np.array([row[index] for row in body])  # text, as a name of a trial
    return columns


def _read_mat(path: Path) -> Table:
    try:
        content = scipy.io.loadmat(path, squeeze_me=True, struct_as_record=False)
    except (ValueError, NotImplementedError, TypeError, MatReadError) as error:
        raise RecordingError(f'{path}: not a readable MAT file: {error}') from None
    columns: Table = {}
    for name, value in content.items():
        if not name.startswith('__'):
            _collect(name, value, columns)
    return _same_length(path, columns)


def _collect(name: str, value: object, columns: Table) -> None:
    """Take the vectors out of a MATLAB variable, into structs as deep as they go."""
    if hasattr(value, '_fieldnames'):
        for field in value._fieldnames:
            _collect(f'{name}.{field}', getattr(value, field), columns)
    elif isinstance(value, np.ndarray) and value.ndim == 1 and value.dtype.kind in 'biuf':
        columns[name] = value.astype(float)


def _read_json(path: Path) -> Table:
    try:
        content = json.loads(path.read_text(encoding='utf-8'))
    except ValueError as error:
        raise RecordingError(f'{path}: no valid JSON: {error}') from None
    if isinstance(content, dict) and 'entries' in content:
        content = content['entries']
    try:
        if isinstance(content, list):
            content = {name: [row[name] for row in content] for name in (content or [{}])[0]}
        lists = {name: value for name, value in content.items() if isinstance(value, list)}
        columns = {name: np.array(value, dtype=float) for name, value in lists.items()}
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        msg = f'{path}: a mapping of lists of numbers, or a list of mappings, is needed: {error}'
        raise RecordingError(msg) from None
    return _same_length(path, columns)


def _same_length(path: Path, columns: Table) -> Table:
    lengths = {name: len(values) for name, values in columns.items()}
    if len(set(lengths.values())) > 1:
        # A log of N rows may come with short vectors of parameters: the longest are the log.
        longest = max(lengths.values())
        return {name: v for name, v in columns.items() if len(v) == longest}
    return columns
