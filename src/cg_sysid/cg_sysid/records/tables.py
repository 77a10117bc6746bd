"""Tables: columns of numbers read from CSV, MATLAB and JSON logs."""

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cg_description.reading import JSON_LOG, parse_json, read_text, shown
from cg_description.schema import ListOf, Number, meant
from cg_sysid.errors import RecordingError
from cg_sysid.records.mat_file import MOST, MatError, vectors


class Table(dict[str, np.ndarray]):
    """Column name -> values, shape (N,), numbers or texts.

    Args:
        columns: The columns.
        rows: Number of each row in the file from 1, shape (N,); by default they are all there.
        lines: Line of each row in a file of text, shape (N,).
    """

    def __init__(
        self,
        columns: Mapping[str, np.ndarray],
        rows: np.ndarray | None = None,
        lines: np.ndarray | None = None,
    ):
        super().__init__(columns)
        self.length = len(next(iter(columns.values()), ()))
        self.rows = np.arange(1, self.length + 1) if rows is None else rows
        self.lines = lines

    def take(self, chosen: np.ndarray) -> 'Table':
        """The table of some rows, by index."""
        columns = {name: values[chosen] for name, values in self.items()}
        lines = None if self.lines is None else self.lines[chosen]
        return Table(columns, self.rows[chosen], lines)

    def place(self, index: int) -> str:
        """Where a row stands in the file, such as `row 100 (line 101)`."""
        line = '' if self.lines is None else f' (line {self.lines[index]})'
        return f'row {self.rows[index]}{line}'

    def values_of(self, name: Any, where: str) -> np.ndarray:
        """A column, of numbers or texts.

        Raises:
            RecordingError: There is none of that name; those there are are listed.
        """
        if name not in self:
            raise RecordingError(
                f'{where}: no column {shown(name)}; the file has '
                f'{", ".join(self)}{meant(name, self)}'
            )
        return self[name]

    def numbers(self, name: Any, where: str) -> np.ndarray:
        """A column of numbers.

        Raises:
            RecordingError: No such column, or a cell that is none; row, column and cell are named.
        """
        values = self.values_of(name, where)
        if values.dtype.kind in 'fiub':
            return values
        numbers = np.empty(len(values))
        for k, cell in enumerate(values):
            try:
                numbers[k] = float(cell)
            except ValueError:
                what = f'the cell {shown(str(cell))}' if cell else 'an empty cell'
                raise RecordingError(
                    f'{where}: {self.place(k)}, column {shown(name)}: {what} is no number'
                ) from None
        return numbers


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
    if not table.length:
        raise RecordingError(f'{path}: empty; no row of numbers')
    return table


def _read_csv(path: Path) -> Table:
    text = read_text(path, RecordingError, JSON_LOG)
    reader = csv.reader(io.StringIO(text, newline=''))
    body: list[list[str]] = []
    lines: list[int] = []
    try:
        header = [name.strip() for name in next(reader, [])]
        for row in reader:
            if not row:
                continue
            if len(row) != len(header):
                msg = (
                    f'{path}: line {reader.line_num} has {len(row)} fields, '
                    f'the header {len(header)}'
                )
                raise RecordingError(msg)
            body.append(row)
            lines.append(reader.line_num)
    except csv.Error as error:
        raise RecordingError(f'{path}: line {reader.line_num}: no CSV: {error}') from None
    columns: dict[str, np.ndarray] = {}
    for index, name in enumerate(header):
        if name and name in columns:
            raise RecordingError(f'{path}: the header has two columns {shown(name)}')
        cells = [row[index] for row in body]
        try:
            columns[name] = np.array(cells, dtype=float)
        except ValueError:
            columns[name] = np.array(cells, dtype=object)  # text, as a name of a data set
    return Table(columns, lines=np.array(lines, dtype=int))


def _read_mat(path: Path) -> Table:
    try:
        with path.open('rb') as file:
            return _same_length(vectors(file.read(MOST + 1)))
    except OSError as error:
        raise RecordingError(f'{path}: cannot be read: {error.strerror}') from None
    except MatError as error:
        raise RecordingError(f'{path}: not a readable MAT file: {error}') from None


def _read_json(path: Path) -> Table:
    text = read_text(path, RecordingError, JSON_LOG)
    content = parse_json(text, str(path), RecordingError, JSON_LOG)
    inside = 'entries' if isinstance(content, dict) and 'entries' in content else ''
    if inside:
        content = content['entries']
    if isinstance(content, list):
        names = content[0].keys() if content and isinstance(content[0], dict) else set()
        for k, row in enumerate(content):
            if not isinstance(row, dict):
                msg = f'{path}: {inside}[{k}]: {shown(row)} is no mapping from names to numbers'
                raise RecordingError(msg)
            if row.keys() != names:
                other = min(row.keys() ^ names)
                msg = f'{path}: {inside}[{k}]: {shown(other)} stands in some of the rows only'
                raise RecordingError(msg)
        content = {name: [row[name] for row in content] for name in names}
    elif not isinstance(content, dict):
        msg = f'{path}: a mapping of lists of numbers, or a list of mappings, is needed'
        raise RecordingError(msg)
    samples = ListOf(Number(infinite=True, nan=True))
    lists = {name: value for name, value in content.items() if isinstance(value, list)}
    return _same_length(
        {
            name: np.array(
                samples.of(
                    [float('nan') if v is None else v for v in value],
                    str(path),
                    RecordingError,
                    name,
                )
            )
            for name, value in lists.items()
        }
    )


def _same_length(columns: dict[str, np.ndarray]) -> Table:
    # A log of N rows may come with short vectors of parameters: the longest are the log.
    longest = max(map(len, columns.values()), default=0)
    return Table({name: v for name, v in columns.items() if len(v) == longest})
