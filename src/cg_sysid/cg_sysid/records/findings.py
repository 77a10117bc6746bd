"""Findings: what a check of a recording says, as data, as JSON and as text."""

import json
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

from rich.console import Console
from rich.table import Table

SEVERITIES = ('info', 'warning', 'error')
VERDICTS = ('good', 'warnings', 'unusable')
COLOURS = {
    'info': 'cyan',
    'warning': 'yellow',
    'error': 'red',
    'good': 'green',
    'warnings': 'yellow',
    'unusable': 'red',
}

# Errors that a person may overrule, and why each makes a recording unusable. With what is not
# here there is nothing left to use, or reading itself refuses the recording.
OVERRULABLE = {
    'clock_jump': 'time is wrong by an unknown amount from there on',
    'dropped_samples': 'what drove the machine in the gap is not known, or stamps hide the gap',
    'joints_swapped': 'a fit would take one joint for another',
    'sampling_rate_change': 'the stamps do not know of it, so that time is wrong from there on',
    'sensor_clipping': 'what is recorded at the limit is not the motion',
    'sign_error': 'a fit would mirror the machine',
    'spikes': 'more than a fit of squares can take',
    'stuck': 'what is recorded there is not the motion',
    'unit': 'numbers are wrong by a factor of 57.3',
    'zero_shift': 'no one zero holds for the recording',
}  # fmt: skip


@dataclass(frozen=True)
class Finding:
    """One thing that a check has to say about a recording.

    Attributes:
        code: Standard name, such as `gap`; listed in data.md.
        severity: `info`, `warning`, or `error` (the recording is unusable).
        where: Topic or channel; empty where it is about the whole recording.
        message: One sentence for people, without the repair.
        start_s: Begin of the span concerned, in s since the first stamp; None for all of it.
        stop_s: End of that span.
        sample: Index of the first sample concerned, within its topic.
        value: What was found.
        allowed: What would have been right.
        repair: What reading does about it; empty if nothing. Part of the printed message.
        overruled: It would be an error, but for a person who said that the recording is to be
            used anyway.
    """

    code: str
    severity: str
    where: str
    message: str
    start_s: float | None = None
    stop_s: float | None = None
    sample: int | None = None
    value: Any = None
    allowed: Any = None
    repair: str = ''
    overruled: bool = False

    @property
    def text(self) -> str:
        """The message, with the repair, and that it was overruled."""
        text = f'{self.message}; repaired: {self.repair}' if self.repair else self.message
        return f'{text}; used anyway' if self.overruled else text

    @property
    def place(self) -> str:
        """The span as text, such as `12.30..12.45 s`; empty for the whole recording."""
        if self.start_s is None:
            return ''
        if self.stop_s is None or self.stop_s - self.start_s < 5e-4:
            return f'{self.start_s:.3f} s'
        return f'{self.start_s:.3f}..{self.stop_s:.3f} s'


@dataclass(frozen=True)
class CheckReport:
    """All findings about one recording.

    Attributes:
        name: Name of the recording.
        findings: Findings, the gravest first.
    """

    name: str
    findings: tuple[Finding, ...]

    @property
    def verdict(self) -> str:
        """`unusable` with an error, `warnings` with a warning, `good` otherwise."""
        severities = {finding.severity for finding in self.findings}
        if 'error' in severities:
            return 'unusable'
        return 'warnings' if 'warning' in severities else 'good'

    @property
    def overruled(self) -> tuple[Finding, ...]:
        """The findings by which it would be unusable, had nobody overruled them."""
        return tuple(finding for finding in self.findings if finding.overruled)

    def of(self, code: str) -> list[Finding]:
        """The findings of one code."""
        return [finding for finding in self.findings if finding.code == code]

    def to_dict(self) -> dict[str, Any]:
        """The report as plain data."""
        findings = [asdict(finding) for finding in self.findings]
        return {'name': self.name, 'verdict': self.verdict, 'findings': findings}

    def to_json(self) -> str:
        """The report as JSON text."""
        return json.dumps(self.to_dict(), indent=1, default=float)

    def print(self, console: Console | None = None) -> None:
        """Print the report for people."""
        console = console or Console()
        console.print(f'[bold]{self.name}[/]: [{COLOURS[self.verdict]}]{self.verdict}[/]')
        if not self.findings:
            return
        table = Table('severity', 'code', 'where', 'place', 'what', box=None, pad_edge=False)
        for f in self.findings:
            table.add_row(
                f'[{COLOURS[f.severity]}]{f.severity}[/]', f.code, f.where, f.place, f.text
            )
        console.print(table)


def overrulable(names: Iterable[str]) -> frozenset[str]:
    """Names of findings that are to be overruled.

    Raises:
        ValueError: There is no such finding, or it cannot be overruled.
    """
    wanted = frozenset(names)
    for name in sorted(wanted - set(OVERRULABLE)):
        msg = f'use anyway: {name!r} is no finding that can be overruled; those that can: '
        raise ValueError(msg + ', '.join(OVERRULABLE))
    return wanted


def overrule(findings: Iterable[Finding], names: frozenset[str]) -> Iterator[Finding]:
    """Findings, errors of those names turned into warnings that say so."""
    for finding in findings:
        if finding.severity == 'error' and finding.code in names:
            yield replace(finding, severity='warning', overruled=True)
        else:
            yield finding


def make_report(name: str, findings: Iterable[Finding]) -> CheckReport:
    """A report with the gravest findings first, in order of time within one severity."""
    ordered = sorted(
        findings, key=lambda f: (-SEVERITIES.index(f.severity), f.start_s or 0.0, f.code)
    )
    return CheckReport(name, tuple(ordered))
