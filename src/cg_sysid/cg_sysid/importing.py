"""Import of foreign logs: a mapping file says which column is which channel.

    python3 -m cg_sysid.importing sydney_pendulum DATA_DIR --out BAGS

A mapping (`cg_import/1`, docs/data.md) names the files, the time column, the expression
(expressions.py) of each channel, filters and splits of rows, and the recording note. The bags
that come out are the same as those that the robot records.
"""

import argparse
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cg_dynamics.rig import Setup
from cg_sysid import channels
from cg_sysid.bag_writer import write_bag
from cg_sysid.errors import RecordingError
from cg_sysid.expressions import column, evaluate
from cg_sysid.raw import NOTE_FORMAT
from cg_sysid.record import NS_PER_S, Record
from cg_sysid.tables import Table, read_table

FORMAT = 'cg_import/1'
ENTRIES = {
    'format', 'title', 'source', 'files', 'mechanism', 'start', 'time', 'rows', 'split',
    'channels', 'commands', 'cases', 'note', 'setup', 'nominal_rate_hz',
}
CASE_ENTRIES = {'when', 'channels', 'commands', 'note', 'setup'}


@dataclass(frozen=True)
class Imported:
    """One record made from a log, with the commanded torques that came along.

    Attributes:
        record: The record.
        commands: Torque channel -> commanded torque in N m by row, shape (N,); may be empty.
    """

    record: Record
    commands: dict[str, np.ndarray]


def mapping_folder() -> Path:
    """Folder of the mapping files that come with this package, in a source tree or installed."""
    here = Path(__file__).resolve()
    for parent in here.parents:
        for candidate in (
            parent / 'config' / 'import',
            parent / 'share' / 'cg_sysid' / 'config' / 'import',
        ):
            if candidate.is_dir():
                return candidate
    msg = f'no mapping files found above {here}; is cg_sysid installed completely?'
    raise RecordingError(msg)


def mapping_names() -> list[str]:
    """Names of the mapping files that come with this package."""
    return sorted(path.stem for path in mapping_folder().glob('*.yaml'))


def load_mapping(name: str | Path) -> dict[str, Any]:
    """Read a mapping file and check its entries.

    Args:
        name: Name of a mapping that comes with this package, or path of a YAML file.

    Returns:
        The mapping, with its name under `name`.

    Raises:
        RecordingError: No such mapping, not YAML, or an entry that is unknown or missing.
    """
    path = Path(name)
    if path.suffix not in ('.yaml', '.yml'):
        path = mapping_folder() / f'{name}.yaml'
    if not path.is_file():
        msg = f'no mapping {str(name)!r}; those that come along are {", ".join(mapping_names())}'
        raise RecordingError(msg)
    try:
        mapping = yaml.safe_load(path.read_text(encoding='utf-8'))
    except yaml.YAMLError as error:
        raise RecordingError(f'{path}: no valid YAML: {error}') from None
    if not isinstance(mapping, dict) or mapping.get('format') != FORMAT:
        raise RecordingError(f'{path}: a mapping with format: {FORMAT} is needed')
    _check_entries(mapping, ENTRIES, str(path))
    for key in ('files', 'mechanism', 'time'):
        if key not in mapping:
            raise RecordingError(f'{path}: entry {key!r} is missing')
    for index, case in enumerate(mapping.get('cases', [])):
        _check_entries(case, CASE_ENTRIES, f'{path}: cases[{index}]')
    return {**mapping, 'name': path.stem}


def _check_entries(mapping: Any, allowed: set[str], where: str) -> None:
    if not isinstance(mapping, dict):
        raise RecordingError(f'{where}: {mapping!r} is no mapping')
    unknown = sorted(set(mapping) - allowed)
    if unknown:
        msg = f'{where}: unknown entry {unknown[0]!r}; allowed are {", ".join(sorted(allowed))}'
        raise RecordingError(msg)


def import_logs(mapping: str | Path | dict[str, Any], data_dir: str | Path) -> Iterator[Imported]:
    """The records that a mapping makes of the files of a folder.

    Args:
        mapping: Name or path of a mapping, or what `load_mapping` returned.
        data_dir: Folder that the mapping's `files` are relative to.

    Yields:
        One record per file, or per part where the mapping splits files.

    Raises:
        RecordingError: A file, column or entry is missing or wrong; the message says which.
    """
    if not isinstance(mapping, dict):
        mapping = load_mapping(mapping)
    data_dir = Path(data_dir)
    patterns = mapping['files'] if isinstance(mapping['files'], list) else [mapping['files']]
    found = sorted({path for pattern in patterns for path in data_dir.glob(pattern)})
    if not found:
        raise RecordingError(f'{data_dir}: no file matches {", ".join(patterns)}')
    for path in found:
        table = read_table(path)
        for number, rows in enumerate(_parts(mapping, table, path), start=1):
            yield _record_of(mapping, path, table, rows, number)


def _parts(mapping: dict, table: Table, path: Path) -> Iterator[np.ndarray]:
    """Row indices of each part of a file."""
    length = len(next(iter(table.values())))
    keep = np.ones(length, dtype=bool)
    for rule in mapping.get('rows', []):
        keep &= _matches(rule, table, f'{path}: rows')
    rows = np.flatnonzero(keep)
    if not len(rows):
        raise RecordingError(f'{path}: no row is left after the filters in `rows`')
    split = mapping.get('split') or {}
    _check_entries(
        split, {'by', 'at', 'name', 'drop_first', 'drop_last', 'min_rows'}, f'{path}: split'
    )
    changes = np.diff(rows) != 1  # rows that were filtered out also end a part
    if not split:
        changes[:] = False
    for name in split.get('by', []):
        if name not in table:
            raise RecordingError(f'{path}: split.by: no column {name!r}; '
                                 f'the file has {", ".join(table)}')
        changes |= table[name][rows][1:] != table[name][rows][:-1]
    for border in split.get('at', []):
        values = column(table, border.get('column'), f'{path}: split.at')[rows]
        changes |= (values[:-1] < border['value']) & (values[1:] >= border['value'])
    first, last = split.get('drop_first', 0), split.get('drop_last', 0)
    for part in np.split(rows, np.flatnonzero(changes) + 1):
        kept = part[first:len(part) - last]
        if len(kept) >= max(2, split.get('min_rows', 2)):
            yield kept


def _matches(rule: Any, table: Table, where: str) -> np.ndarray:
    """Which rows fulfil `{column: NAME, equals: V}` or `{column: NAME, from: A, below: B}`."""
    _check_entries(rule, {'column', 'equals', 'from', 'below'}, where)
    if rule.get('column') not in table:
        raise RecordingError(f'{where}: no column {rule.get("column")!r}; '
                             f'the file has {", ".join(table)}')
    values = table[rule['column']]
    matches = np.ones(len(values), dtype=bool)
    if 'equals' in rule:
        matches &= values == rule['equals']
    if 'from' in rule:
        matches &= values >= rule['from']
    if 'below' in rule:
        matches &= values < rule['below']
    return matches


def _record_of(
    mapping: dict, path: Path, table: Table, rows: np.ndarray, number: int
) -> Imported:
    part = {name: values[rows] for name, values in table.items()}
    where = f'{path}: mapping {mapping["name"]}'
    entries = _with_case(mapping, part, where)
    mechanism = channels.mechanism(entries['mechanism'])
    signals = _evaluated(entries.get('channels') or {}, part, f'{where}: channels', mechanism)
    commands = _evaluated(entries.get('commands') or {}, part, f'{where}: commands', mechanism)
    stamps = _stamps(entries, path, part, len(rows))
    try:
        setup = Setup.from_dict(entries.get('setup') or {})
    except ValueError as error:
        raise RecordingError(f'{where}: {error}') from None
    source = {**(entries.get('source') or {}), 'file': path.name, 'mapping': mapping['name']}
    note = {'format': NOTE_FORMAT, **(entries.get('note') or {}), 'imported_from': source}
    rate = entries.get('nominal_rate_hz', (entries['time'] or {}).get('rate_hz'))
    if rate:
        note['nominal_rate_hz'] = float(rate)
    is_input = {*mechanism.input_names, *mechanism.extra_input_names}
    record = Record(
        name=_part_name(mapping, path, part, number),
        stamp_ns=stamps,
        inputs={c: v for c, v in signals.items() if c in is_input},
        outputs={c: v for c, v in signals.items() if c not in is_input},
        mechanism=mechanism.name,
        setup=setup,
        note={**note, 'mechanism': mechanism.name, 'setup': setup.to_dict()},
        source=str(path),
    )
    return Imported(record, commands)


def _with_case(mapping: dict, part: Table, where: str) -> dict:
    """The mapping with the entries of the one case that every row of the part fulfils."""
    cases = mapping.get('cases')
    if not cases:
        return mapping
    for case in cases:
        if np.all(_matches(case.get('when', {}), part, f'{where}: when')):
            merged = dict(mapping)
            for key in CASE_ENTRIES - {'when'}:
                merged[key] = {**(mapping.get(key) or {}), **(case.get(key) or {})}
            return merged
    raise RecordingError(f'{where}: a part of the file fulfils none of its {len(cases)} cases')


def _evaluated(
    expressions: dict, part: Table, where: str, mechanism: channels.Mechanism
) -> dict[str, np.ndarray]:
    values = {}
    for name, expression in expressions.items():
        mechanism.channel(name)
        values[name] = evaluate(expression, part, f'{where}.{name}')
    return values


def _stamps(entries: dict, path: Path, part: Table, length: int) -> np.ndarray:
    """Stamps in ns, shape (N,), from the time column or a fixed rate, after `start`."""
    start = _start(entries.get('start', '1970-01-01T00:00:00+00:00'), path)
    time = entries['time']
    _check_entries(time, {'column', 'unit', 'rate_hz', 'gain', 'offset'}, f'{path}: time')
    if 'column' in time:
        expression = {key: value for key, value in time.items() if key != 'rate_hz'}
        column(part, time['column'], f'{path}: time')
        seconds = evaluate(expression, part, f'{path}: time')
        return start + np.rint(seconds * NS_PER_S).astype(np.int64)
    if not time.get('rate_hz', 0) > 0:
        raise RecordingError(f'{path}: time: a column or a positive rate_hz is needed')
    return start + np.rint(np.arange(length) * (NS_PER_S / time['rate_hz'])).astype(np.int64)


def _start(start: Any, path: Path) -> int:
    """Stamp of time 0 in ns: ISO 8601, or `{from_name: '%Y...'}` for a file named by its time."""
    try:
        if isinstance(start, dict):
            instant = datetime.strptime(path.stem, start['from_name']).replace(tzinfo=timezone.utc)
        elif isinstance(start, datetime):
            instant = start
        else:
            instant = datetime.fromisoformat(start.replace('Z', '+00:00'))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise RecordingError(f'{path}: start {start!r} cannot be read: {error}') from None
    if instant.tzinfo is None:
        instant = instant.replace(tzinfo=timezone.utc)
    return int(instant.timestamp()) * NS_PER_S


def _part_name(mapping: dict, path: Path, part: Table, number: int) -> str:
    """Name of a part: the mapping's, the file's, its number, values that it was split by."""
    template = (mapping.get('split') or {}).get('name')
    if template is None:
        return f'{mapping["name"]}_{path.stem}'
    firsts = {name: _plain(values[0]) for name, values in part.items()}
    try:
        return template.format(name=mapping['name'], stem=path.stem, part=number, **firsts)
    except (KeyError, ValueError, IndexError) as error:
        msg = f'{path}: split.name {template!r} cannot be filled: {error}'
        raise RecordingError(msg) from None


def _plain(value: Any) -> Any:
    """A number of a table, as an int where it is whole, so that names are short."""
    if isinstance(value, np.floating):
        return int(value) if float(value).is_integer() else float(value)
    return str(value)


def import_to_bags(
    mapping: str | Path | dict[str, Any], data_dir: str | Path, out: str | Path
) -> list[Path]:
    """Write one bag for each record that a mapping makes; see `import_logs`.

    Args:
        mapping: Name or path of a mapping, or what `load_mapping` returned.
        data_dir: Folder that the mapping's `files` are relative to.
        out: Folder for the bags.

    Returns:
        The bags written.

    Raises:
        RecordingError: As in `import_logs`; also if a bag of that name exists already.
    """
    paths = []
    for imported in import_logs(mapping, data_dir):
        record = replace(imported.record, source='')
        paths.append(write_bag(Path(out) / record.name, record, imported.commands))
    return paths


def main(argv: list[str] | None = None) -> int:
    """Command line: import foreign logs to bags."""
    parser = argparse.ArgumentParser(
        prog='import', description='Import CSV, MAT or JSON logs to bags by a mapping file.'
    )
    parser.add_argument('mapping', nargs='?', help='name of a mapping, or path of its YAML file')
    parser.add_argument('data_dir', nargs='?', help="folder that the mapping's files are in")
    parser.add_argument('--out', default='bags', help='folder for the bags (default: bags)')
    parser.add_argument('--list', action='store_true', help='list the mappings that come along')
    args = parser.parse_args(argv)
    if args.list:
        for name in mapping_names():
            print(f'{name}: {load_mapping(name).get("title", "")}')
        return 0
    if args.mapping is None or args.data_dir is None:
        parser.error('a mapping and a data folder are needed (or --list)')
    try:
        for imported in import_logs(args.mapping, args.data_dir):
            path = Path(args.out) / imported.record.name
            write_bag(path, replace(imported.record, source=''), imported.commands)
            print(f'{path}: {len(imported.record)} rows, {imported.record.duration:.2f} s')
    except ValueError as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
