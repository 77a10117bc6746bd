"""Import of foreign logs: a mapping file says which column is which channel.

    cg import sydney_pendulum DATA_DIR --out BAGS

A mapping (`cg_import/1`, data.md) names the files, the time column, the expression
(expressions.py) of each channel, filters and splits of rows, and the recording note. The bags
that come out are the same as those that the robot records.
"""

import argparse
import re
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from string import Formatter
from typing import Any

import numpy as np

from cg_description.reading import parse_yaml, path_of, read_text, shown
from cg_description.schema import (
    NAME,
    Key,
    Kind,
    ListOf,
    MapOf,
    Mapping,
    Number,
    Place,
    Text,
    Whole,
)
from cg_dynamics import rig
from cg_dynamics.rig import Setup
from cg_interfaces import channels
from cg_interfaces.stamps import NS_PER_S
from cg_sysid.errors import RecordingError
from cg_sysid.progress import Bars
from cg_sysid.records.bag_writer import write_bag
from cg_sysid.records.expressions import UNITS, Expression, evaluate
from cg_sysid.records.raw import NOTE, NOTE_FORMAT
from cg_sysid.records.record import Record
from cg_sysid.records.tables import Table, read_table

FORMAT = 'cg_import/1'
LAST_STAMP_S = 2**31  # a ROS stamp counts seconds in 32 bits


class NumberOrText(Kind):
    """What a cell of a table may hold."""

    words = 'a number or text'

    def read(self, value: Any, place: Place) -> float | str:
        """The number or text."""
        if isinstance(value, str):
            return Text().read(value, place)
        return Number().read(value, place)


class Patterns(Kind):
    """One pattern of file names below a folder, or a list of them."""

    words = "a pattern of file names such as '**/*.csv', or a list of them"

    def read(self, value: Any, place: Place) -> list[str]:
        """The patterns."""
        patterns = ListOf(NAME, 1).read(value if isinstance(value, list) else [value], place)
        for pattern in patterns:
            # What pathlib takes, and nothing outside of the folder.
            parts = pattern.split('/')
            if (
                not all(parts)
                or {'..', '.'} & set(parts)
                or parts.count('**') > 1
                or any('**' in part and part != '**' for part in parts)
            ):
                raise place.wrong(f'{shown(pattern)} is no pattern; {self.words} is needed')
        return patterns


class Start(Kind):
    """The stamp of time 0: ISO 8601, or `{from_name: '%Y...'}` for a file named by its time."""

    words = "an ISO 8601 time such as '2024-05-01T09:00:00Z', or {from_name: '%Y%m%d-%H%M%S'}"

    def read(self, value: Any, place: Place) -> str | dict[str, str]:
        """The time, or how to read the name."""
        if isinstance(value, dict):
            return Mapping({'from_name': Key(NAME)}).read(value, place)
        text = Text().read(value, place)
        try:
            instant(text)
        except ValueError:
            raise place.wrong(f'{shown(value)} is no time; {self.words} is needed') from None
        return text


def instant(text: str) -> datetime:
    """The time in ISO 8601, in UTC unless it says otherwise.

    Raises:
        ValueError: It is none.
    """
    found = datetime.fromisoformat(text.strip().replace('Z', '+00:00'))
    return found if found.tzinfo else found.replace(tzinfo=timezone.utc)


RULE = Mapping({
    'column': Key(Text()),
    'equals': Key(NumberOrText(), default=None),
    'from': Key(Number(), default=None),
    'below': Key(Number(), default=None),
}, fill=False)  # fmt: skip
SET_UP = replace(rig.SCHEMA, fill=False)
CHANNELS = MapOf(Expression())
CASE = {
    'channels': Key(CHANNELS, default={}),
    'commands': Key(CHANNELS, default={}),
    'note': Key(NOTE, default={}),
    'setup': Key(SET_UP, default={}),
}
SCHEMA = Mapping({
    'format': Key(Text((FORMAT,))),
    'title': Key(Text(), default=''),
    'source': Key(Mapping({}, further=True), default={}),
    'files': Key(Patterns()),
    'mechanism': Key(Text()),
    'start': Key(Start(), default='1970-01-01T00:00:00+00:00'),
    'time': Key(Mapping({
        'column': Key(Text(), default=''),
        'unit': Key(Text(tuple(UNITS)), default='1'),
        'rate_hz': Key(Number(positive=True), default=None, unit='Hz'),
        'gain': Key(Number(), default=1.0),
        'offset': Key(Number(), default=0.0, unit='s'),
    }, fill=False)),
    'rows': Key(ListOf(RULE), default=()),
    'split': Key(Mapping({
        'by': Key(ListOf(Text()), default=()),
        'at': Key(ListOf(Mapping({'column': Key(Text()), 'value': Key(Number())})), default=()),
        'name': Key(Text(longest=200), default='{name}_{stem}'),
        'recording': Key(Text(longest=200), default=''),
        'drop_first': Key(Whole(0), default=0),
        'drop_last': Key(Whole(0), default=0),
        'min_rows': Key(Whole(2), default=2),
    }), default=None),
    **CASE,
    'cases': Key(ListOf(Mapping({'when': Key(RULE), **CASE})), default=()),
    'nominal_rate_hz': Key(Number(positive=True), default=None, unit='Hz'),
})  # fmt: skip


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
        The mapping with all defaults (`SCHEMA`), and its name under `name`.

    Raises:
        RecordingError: No such mapping, not YAML, or an entry that is unknown, missing or wrong.
    """
    path = path_of(name, RecordingError)
    if path.name == str(name) and path.suffix not in ('.yaml', '.yml'):
        path = mapping_folder() / f'{name}.yaml'
    if not path.is_file():
        msg = f'no mapping {str(name)!r}; those that come along are {", ".join(mapping_names())}'
        raise RecordingError(msg)
    where = str(path)
    tree = parse_yaml(read_text(path, RecordingError), where, RecordingError)
    mapping = SCHEMA.of(tree, where, RecordingError)
    if not {'column', 'rate_hz'} & set(mapping['time']):
        raise RecordingError(f'{where}: time: a column or rate_hz is needed')
    try:
        known = channels.mechanism(mapping['mechanism'])
    except ValueError as error:
        raise RecordingError(f'{where}: mechanism: {error}') from None
    cases = [(f'cases[{k}].', case) for k, case in enumerate(mapping['cases'])]
    for at, part in [('', mapping), *cases]:
        for key in ('channels', 'commands'):
            for channel in part[key]:
                try:
                    known.channel(channel)
                except ValueError as error:
                    raise RecordingError(f'{where}: {at}{key}: {error}') from None
    return {**mapping, 'name': path.stem}


def import_logs(
    mapping: str | Path | dict[str, Any],
    data_dir: str | Path,
    progress: Callable[[str, int, int], None] = lambda what, done, total: None,
) -> Iterator[Imported]:
    """The records that a mapping makes of the files of a folder.

    Args:
        mapping: Name or path of a mapping, or what `load_mapping` returned.
        data_dir: Folder that the mapping's `files` are relative to.
        progress: Called with (what, done, total).

    Yields:
        One record per file, or per part where the mapping splits files.

    Raises:
        RecordingError: A file, column or entry is missing or wrong; the message says which.
    """
    if not isinstance(mapping, dict):
        mapping = load_mapping(mapping)
    data_dir = Path(data_dir)
    patterns = mapping['files']
    found = sorted({path for pattern in patterns for path in data_dir.glob(pattern)})
    if not found:
        raise RecordingError(f'{data_dir}: no file matches {", ".join(map(shown, patterns))}')
    for done, path in enumerate(found):
        progress('reading logs and writing recordings', done, len(found))
        table = read_table(path)
        for number, rows in enumerate(_parts(mapping, table, path), start=1):
            yield _record_of(mapping, path, table, rows, number)


def _parts(mapping: dict, table: Table, path: Path) -> Iterator[np.ndarray]:
    """Row indices of each part of a file."""
    keep = np.ones(table.length, dtype=bool)
    for number, rule in enumerate(mapping['rows']):
        keep &= _matches(rule, table, f'{path}: rows[{number}]')
    rows = np.flatnonzero(keep)
    if not len(rows):
        raise RecordingError(f'{path}: no row is left after the filters in `rows`')
    split = mapping.get('split')
    if split is None:
        yield rows
        return
    changes = np.diff(rows) != 1  # rows that were filtered out also end a part
    for name in split['by']:
        values = table.values_of(name, f'{path}: split.by')[rows]
        changes |= values[1:] != values[:-1]
    for border in split['at']:
        values = table.take(rows).numbers(border['column'], f'{path}: split.at')
        changes |= (values[:-1] < border['value']) & (values[1:] >= border['value'])
    for part in np.split(rows, np.flatnonzero(changes) + 1):
        kept = part[split['drop_first'] : max(0, len(part) - split['drop_last'])]
        if len(kept) >= split['min_rows']:
            yield kept


def _matches(rule: dict[str, Any], table: Table, where: str) -> np.ndarray:
    """Which rows fulfil `{column: NAME, equals: V}` or `{column: NAME, from: A, below: B}`."""
    matches = np.ones(table.length, dtype=bool)
    if 'equals' in rule:
        matches &= table.values_of(rule['column'], where) == rule['equals']
    elif not {'from', 'below'} & set(rule):
        raise RecordingError(f'{where}: nothing to compare with; allowed: equals, from, below')
    if 'from' in rule:
        matches &= table.numbers(rule['column'], where) >= rule['from']
    if 'below' in rule:
        matches &= table.numbers(rule['column'], where) < rule['below']
    return matches


def _record_of(mapping: dict, path: Path, table: Table, rows: np.ndarray, number: int) -> Imported:
    part = table.take(rows)
    where = f'{path}: mapping {mapping["name"]}'
    entries = _with_case(mapping, part, where)
    mechanism = channels.mechanism(entries['mechanism'])
    signals = _evaluated(entries['channels'], part, f'{where}: channels')
    commands = _evaluated(entries['commands'], part, f'{where}: commands')
    stamps = _stamps(entries, path, part)
    try:
        setup = Setup.from_dict(entries['setup'])
    except ValueError as error:
        raise RecordingError(f'{where}: {error}') from None
    source = {**entries['source'], 'file': path.name, 'mapping': mapping['name']}
    note = {'format': NOTE_FORMAT, **entries['note'], 'imported_from': source}
    rate = entries['nominal_rate_hz'] or entries['time'].get('rate_hz')
    if rate:
        note['nominal_rate_hz'] = rate
    split = mapping.get('split') or {}
    template = split.get('name', '{name}_{stem}')
    if split.get('recording'):
        note['recording'] = _part_name(mapping, path, part, number, split['recording'])
    is_input = {*mechanism.input_names, *mechanism.extra_input_names}
    record = Record(
        name=_part_name(mapping, path, part, number, template),
        stamp_ns=stamps,
        inputs={c: v for c, v in signals.items() if c in is_input},
        outputs={c: v for c, v in signals.items() if c not in is_input},
        mechanism=mechanism,
        setup=setup,
        note={**note, 'mechanism': mechanism.name, 'setup': setup.to_dict()},
        source=note.get('recording') or str(path),
    )
    return Imported(record, commands)


def _with_case(mapping: dict, part: Table, where: str) -> dict:
    """The mapping with the entries of the one case that every row of the part fulfils."""
    cases = mapping['cases']
    if not cases:
        return mapping
    for number, case in enumerate(cases):
        if np.all(_matches(case['when'], part, f'{where}: cases[{number}].when')):
            return {**mapping, **{key: {**mapping[key], **case[key]} for key in CASE}}
    raise RecordingError(f'{where}: a part of the file fulfils none of its {len(cases)} cases')


def _evaluated(expressions: dict, part: Table, where: str) -> dict[str, np.ndarray]:
    return {
        name: evaluate(expression, part, f'{where}.{name}')
        for name, expression in expressions.items()
    }


def _stamps(entries: dict, path: Path, part: Table) -> np.ndarray:
    """Stamps in ns, shape (N,), from the time column or a fixed rate, after `start`."""
    time = entries['time']
    if 'column' in time:
        expression = {key: value for key, value in time.items() if key != 'rate_hz'}
        seconds = evaluate(expression, part, f'{path}: time')
    else:
        seconds = np.arange(part.length) / time['rate_hz']
    start_ns = _start_ns(entries['start'], path)
    stamp = seconds + start_ns / NS_PER_S
    wrong = np.flatnonzero(~((stamp >= 0) & (stamp < LAST_STAMP_S)))  # NaN is wrong too
    if len(wrong):
        raise RecordingError(
            f'{path}: time: {part.place(wrong[0])}: {seconds[wrong[0]]:g} s after the start is no '
            'stamp; years 1970 to 2037 are allowed'
        )
    if 'column' in time:
        return start_ns + np.rint(seconds * NS_PER_S).astype(np.int64)
    counts = np.arange(part.length)
    return start_ns + np.rint(counts * (NS_PER_S / time['rate_hz'])).astype(np.int64)


def _start_ns(start: str | dict[str, str], path: Path) -> int:
    """Time 0 in ns since 1970."""
    if isinstance(start, str):
        begin = instant(start)
    else:
        form = start['from_name']
        try:
            begin = datetime.strptime(path.stem, form).replace(tzinfo=timezone.utc)
        except (ValueError, re.error):
            raise RecordingError(
                f'{path}: start.from_name: the name of the file cannot be read '
                f'as a time of the form {shown(form)}'
            ) from None
    since = begin - datetime(1970, 1, 1, tzinfo=timezone.utc)
    return since // timedelta(microseconds=1) * 1000


def _part_name(mapping: dict, path: Path, part: Table, number: int, template: str) -> str:
    """Name of a part: the mapping's, the file's, its number, values that it was split by."""
    known = {name: _plain(values[0]) for name, values in part.items()}
    known |= {'name': mapping['name'], 'stem': path.stem, 'part': number}
    where = f'{path}: split.name {shown(template)}'
    name = ''
    try:
        # Not str.format: that follows attributes, and fills any width.
        for literal, key, form, conversion in Formatter().parse(template):
            name += literal
            if key is None:
                continue
            if key not in known:
                raise RecordingError(
                    f'{where}: cannot be filled: there is no {shown(key)}; '
                    f'allowed are {", ".join(known)}'
                )
            if conversion or not re.fullmatch('(0?[1-9])?d?', form or ''):
                raise RecordingError(
                    f'{where}: only {{name}} and forms such as {{name:02d}} are allowed'
                )
            value = known[key]
            name += f'{value:{form}}' if isinstance(value, int) else str(value)
    except ValueError as error:
        if isinstance(error, RecordingError):
            raise
        raise RecordingError(f'{where}: the braces do not match') from None
    if not re.fullmatch(r'[^/\\\x00-\x1f.][^/\\\x00-\x1f]{0,199}', name):
        raise RecordingError(f'{where}: {shown(name)} is no name of a directory')
    return name


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
        prog='cg import', description='Import CSV, MAT or JSON logs to bags by a mapping file.'
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
        with Bars('cg import') as bars:
            for imported in import_logs(args.mapping, args.data_dir, bars):
                path = Path(args.out) / imported.record.name
                write_bag(path, replace(imported.record, source=''), imported.commands)
                print(f'{path}: {len(imported.record)} rows, {imported.record.duration:.2f} s')
    except ValueError as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    return 0


if __name__ == '__main__':
    sys.exit(main())
