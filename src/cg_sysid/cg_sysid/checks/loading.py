"""From bags on the command line to records that may be analysed, and what became of each bag."""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from cg_dynamics.model import Model
from cg_interfaces import topics
from cg_interfaces.channels import Mechanism, interface
from cg_sysid.checks.faults import FaultSignal, fault_signals
from cg_sysid.checks.recordings import check_recording
from cg_sysid.errors import RecordingError
from cg_sysid.identification.data_set import require_same_robot
from cg_sysid.identification.windows import (
    NOT_CUT,
    SHORTEST_WINDOW,
    Followed,
    Windows,
    followed,
    windows_of,
)
from cg_sysid.records.bags import no_bag, read_raw, to_record
from cg_sysid.records.findings import CheckReport, Finding, make_report, overrulable
from cg_sysid.records.record import Record
from cg_sysid.stances.phases import Landing, cut_steps

TORQUE_TOPICS = {'applied': topics.APPLIED_TORQUE, 'command': topics.TORQUE_COMMAND}

Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Source:
    """One bag and what became of it.

    Attributes:
        name: Name of the bag.
        path: As it was given.
        sha256: Hash over its storage files; empty where there is none to read.
        check: What the check says.
        reason: Why it was left out; empty if it is used.
        signals: Signals around its faults.
    """

    name: str
    path: str
    sha256: str
    check: CheckReport
    reason: str = ''
    signals: tuple[FaultSignal, ...] = ()

    @property
    def faults(self) -> tuple[Finding, ...]:
        """The findings that make it unusable."""
        return tuple(f for f in self.check.findings if f.severity == 'error')


@dataclass(frozen=True)
class Loaded:
    """What a set of bags gave.

    Attributes:
        records: Records (or windows of them, or stance phases) to be analysed.
        sources: Every bag, used or not.
        origin: Name of a record -> name of the bag that it is from.
        landings: What lies between the phases of walking records (phases.py).
        windows: How far each record is followed, and whether a person chose the windows.
        wholes: Records that a person had cut though they can be followed whole.
    """

    records: tuple[Record, ...]
    sources: tuple[Source, ...]
    origin: Mapping[str, str]
    landings: tuple[Landing, ...] = ()
    windows: Windows = NOT_CUT
    wholes: tuple[Record, ...] = ()

    @property
    def left_out(self) -> tuple[Source, ...]:
        """The bags that are not used."""
        return tuple(source for source in self.sources if source.reason)

    @property
    def overruled(self) -> tuple[tuple[Source, Finding], ...]:
        """What the check refuses in bags that are used all the same, because a person says so."""
        return tuple(
            (source, finding) for source in self.sources if not source.reason
            for finding in source.check.overruled
        )  # fmt: skip

    @property
    def steps(self) -> dict[str, int]:
        """Name of a bag of a walking robot -> steps in it."""
        return dict(Counter(self.origin[landing.record.name] for landing in self.landings))

    @property
    def phases(self) -> int:
        """Number of stance phases that those bags were cut into."""
        return sum(self.origin[record.name] in self.steps for record in self.records)


def load_bags(
    bags: Sequence[str | Path],
    model_file: str | Path | None = None,
    note: Mapping[str, Any] | None = None,
    torque: str | None = None,
    window: float | None = None,
    progress: Progress = lambda what, done, total: None,
    use_anyway: Iterable[str] = (),
    whole: bool = False,
) -> Loaded:
    """Read and check bags; broken ones are left out, with the reason.

    Args:
        bags: Paths of bags.
        model_file: Model file that they will be used with; with it walking records are cut at
            their touchdowns, and others where they cannot be followed whole (following.py).
        note: Recording note for bags that carry none; what names no robot is of the model's.
        torque: `applied` or `command`; by default the applied torque where there is one.
        window: Cut records into windows of this length in s instead.
        progress: Called with (what, done, total).
        use_anyway: Names of findings by which no bag is left out, as in `check_recording`.
        whole: Leave records whole that nobody has asked to cut, as for what simulates nothing.

    Raises:
        ValueError: `use_anyway` names what cannot be overruled.
        ValueError: A record is of another robot than the model.
        RecordingError: A path is no bag at all, is given twice, or a window is too short.
    """
    if window is not None and not window >= SHORTEST_WINDOW:
        raise RecordingError(f'window is {window:g} s; at least {SHORTEST_WINDOW:g} s are needed')
    anyway = overrulable(use_anyway)
    paths = _distinct(bags)
    model = Model.load(model_file) if model_file else None
    mechanism = interface(model.mechanism) if model else None
    sources: list[Source] = []
    records: list[Record] = []
    origin: dict[str, str] = {}
    for done, (name, path) in enumerate(paths.items()):
        progress('reading and checking bags', done, len(paths))
        source, record = _take(name, path, model_file, note, torque, anyway, mechanism)
        sources.append(source)
        if record is None:
            continue
        records.append(record)
        origin[record.name] = name
    progress('reading and checking bags', len(paths), len(paths))
    if model is not None:
        require_same_robot(model, records)
    cut = cut_steps(records, model)
    windows = _followed(None if whole else model, cut.records, window)
    pieces: list[Record] = []
    wholes: list[Record] = []
    for record, found in zip(cut.records, windows.records, strict=True):
        parts = [record]
        if window is not None and record.duration > window:
            parts = record.segments(window)
            wholes += [record] if found.whole else []
        elif window is None:
            parts = windows_of(record, found)
        pieces += parts
        origin |= {p.name: origin[cut.origin[record.name]] for p in (record, *parts)}
    return Loaded(tuple(pieces), tuple(sources), origin, cut.landings, windows, tuple(wholes))


def _followed(model: Model | None, records: Sequence[Record], window: float | None) -> Windows:
    if model is None:
        return Windows(tuple(Followed(r.name, 1.0) for r in records), window)
    return Windows(followed(model, records), window)


def _distinct(bags: Sequence[str | Path]) -> dict[str, Path]:
    """Short name -> path; a name that two bags share gets its directory in front."""
    paths = [Path(bag) for bag in bags]
    for path in paths:
        if not path.exists():
            raise RecordingError(f'{path}: no such bag')
        if not _storage(path):
            raise no_bag(path)
    resolved = [path.resolve() for path in paths]
    for path, place in zip(paths, resolved, strict=True):
        if resolved.count(place) > 1:
            raise RecordingError(f'{path}: given twice')
    names = [place.name for place in resolved]
    return {
        name if names.count(name) == 1 else f'{place.parent.name}/{name}': path
        for name, place, path in zip(names, resolved, paths, strict=True)
    }


def _storage(path: Path) -> list[Path]:
    files = sorted(path.iterdir()) if path.is_dir() else [path]
    # A recorder that was killed leaves .mcap.active; the check says how to recover it.
    return [f for f in files if f.is_file() and {'.mcap', '.db3'} & set(f.suffixes)]


def _take(
    name: str,
    path: Path,
    model_file: str | Path | None,
    note: Mapping[str, Any] | None,
    torque: str | None,
    anyway: frozenset[str],
    mechanism: Mechanism | None,
) -> tuple[Source, Record | None]:
    digest = bag_hash(path)
    try:
        raw = read_raw(path, note, mechanism)
        report = check_recording(raw, model_file, use_anyway=anyway)
        record = None
        if report.verdict != 'unusable':
            record = to_record(raw, TORQUE_TOPICS[torque] if torque else None)
    except RecordingError as error:
        finding = Finding('unreadable', 'error', '', _without_path(str(error), path))
        return Source(name, str(path), digest, make_report(name, [finding]), finding.message), None
    if record is None:
        signals = fault_signals(raw, report)
        return Source(name, str(path), digest, report, _reason(report), signals), None
    return Source(name, str(path), digest, report), _named(record, name)


def _without_path(message: str, path: Path) -> str:
    return message.removeprefix(f'{path}: ')


def _named(record: Record, name: str) -> Record:
    return record if record.name == name else replace(record, name=name)


def _reason(report: CheckReport) -> str:
    """The gravest fault in one line."""
    fault = report.findings[0]
    more = sum(f.severity == 'error' for f in report.findings) - 1
    where = ' '.join(part for part in (fault.where, fault.place) if part)
    text = f'{where}: {fault.text}' if where else fault.text
    return f'{text} (and {more} more)' if more else text


def bag_hash(path: str | Path) -> str:
    """SHA-256 over the storage files of a bag, in the order of their names."""
    digest = hashlib.sha256()
    for file in _storage(Path(path)):
        with file.open('rb') as stream:
            while block := stream.read(1 << 20):
                digest.update(block)
    return digest.hexdigest()
