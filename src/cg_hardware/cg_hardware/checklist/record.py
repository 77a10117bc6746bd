"""The record of a checklist, which recordings name: interfaces.md, "The checklist"."""

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import yaml

from cg_description.model_file import write_atomically
from cg_description.reading import DocumentError, parse_yaml, read_text
from cg_description.schema import Anything, Flag, Key, ListOf, MapOf, Text
from cg_description.schema import Mapping as Form
from cg_hardware.checklist.walk import FAILED, PASSED, SKIPPED, Result
from cg_hardware.simulation import SOFTWARE

FORMAT = 'cg_checklist/1'
STEP = Form({
    'name': Key(Text()),
    'title': Key(Text()),
    'verdict': Key(Text((PASSED, FAILED, SKIPPED))),
    'reason': Key(Text(), default=''),
    'measured': Key(MapOf(Anything()), default={}),
})  # fmt: skip
SCHEMA = Form({
    'format': Key(Text((FORMAT,))),
    'date': Key(Text(), 'when it began, ISO 8601'),
    'software': Key(Text()),
    'emulated': Key(Flag(), 'whether the devices were emulated ones'),
    'devices': Key(MapOf(Text()), 'device -> what it says of itself'),
    'settings': Key(MapOf(Anything()), 'signs, scales and limits that were set', default={}),
    'model_file': Key(Text()),
    'model_sha256': Key(Text()),
    'setup': Key(Form({}, further=True)),
    'complete': Key(Flag(), 'whether every step was come to'),
    'steps': Key(ListOf(STEP)),
})  # fmt: skip


@dataclass(frozen=True)
class Record:
    """A checklist that somebody went through.

    Attributes:
        date: When it began, ISO 8601.
        emulated: Whether the devices were emulated.
        devices: Device -> model and serial number.
        settings: Signs, scales and limits that were set.
        model_file: Name of the model file, without its folder.
        model_sha256: Hash of it.
        setup: What held the robot, as in a recording note.
        complete: Whether every step was come to.
        steps: What came of each.
    """

    date: str
    emulated: bool
    devices: Mapping[str, str]
    settings: Mapping[str, Any]
    model_file: str
    model_sha256: str
    setup: Mapping[str, Any]
    complete: bool
    steps: Sequence[Result]

    @property
    def line(self) -> str:
        """In one line."""
        counts = [f'{len(self.of(v))} {v}' for v in (PASSED, FAILED, SKIPPED) if self.of(v)]
        return ', '.join(counts) or 'no step was carried out'

    def of(self, verdict: str) -> list[str]:
        """Titles of the steps with that verdict."""
        return [step.title for step in self.steps if step.verdict == verdict]

    def save(self, path: Path) -> None:
        """Write it, whole or not at all."""
        tree = {'format': FORMAT, 'software': SOFTWARE, **asdict(self)}
        tree['steps'] = [asdict(step) for step in self.steps]
        write_atomically(path, yaml.safe_dump(_plain(tree), sort_keys=False, allow_unicode=True))


def _plain(value: Any) -> Any:
    """Without numpy's numbers, and with words for what is no number."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if isinstance(value, float):
        return float(value) if math.isfinite(value) else None
    return value


def load(path: Path) -> Record:
    """The record in a file.

    Raises:
        DocumentError: naming file and entry.
    """
    tree = SCHEMA.of(parse_yaml(read_text(path), str(path)), str(path))
    steps = tuple(Result(**step) for step in tree.pop('steps'))
    del tree['format'], tree['software']
    return Record(**tree, steps=steps)


def path_in(folder: Path, date: str) -> Path:
    """Where the record of that date belongs."""
    return folder / f'checklist_{date.replace("-", "").replace(":", "")}.yaml'


def reference(path: Path, record: Record) -> dict[str, Any]:
    """What a recording note says of a checklist: no path, a hash, and what came of it."""
    return {
        'file': path.name,
        'sha256': hashlib.sha256(path.read_bytes()).hexdigest(),
        'date': record.date,
        'passed': len(record.of(PASSED)),
        'of': len(record.steps),
        'failed': record.of(FAILED),
        'not_checked': record.of(SKIPPED),
    }


def latest_reference(folder: Path, devices: Mapping[str, str], emulated: bool) -> dict[str, Any]:
    """The reference to the latest checklist of these devices in a folder; empty if there is none.

    A file that cannot be read is none.
    """
    found = []
    for path in sorted(folder.glob('checklist_*.yaml')):
        try:
            record = load(path)
        except DocumentError:
            continue
        if dict(record.devices) == dict(devices) and record.emulated == emulated:
            found.append((record.date, path, record))
    if not found:
        return {}
    _, path, record = max(found, key=lambda entry: entry[0])
    return reference(path, record)
