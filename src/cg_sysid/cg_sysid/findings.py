"""Findings: what a check of a recording says, as data, as JSON and as text."""

import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from typing import Any

from rich.console import Console
from rich.table import Table

SEVERITIES = ('info', 'warning', 'error')
VERDICTS = ('good', 'warnings', 'unusable')
COLOURS = {
    'info': 'cyan', 'warning': 'yellow', 'error': 'red',
    'good': 'green', 'warnings': 'yellow', 'unusable': 'red',
}


@dataclass(frozen=True)
class Finding:
    """One thing that a check has to say about a recording.

    Attributes:
        code: Standard name, such as `gap`; listed in docs/data.md.
        severity: `info`, `warning`, or `error` (the recording is unusable).
        where: Topic or channel; empty where it is about the whole recording.
        message: One sentence for people, without the repair.
        start_s: Begin of the span concerned, in s since the first stamp; None for all of it.
        stop_s: End of that span.
        sample: Index of the first sample concerned, within its topic.
        value: What was found.
        allowed: What would have been right.
        repair: What reading does about it; empty if nothing. Part of the printed message.
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

    @property
    def text(self) -> str:
        """The message, with the repair."""
        return f'{self.message}; repaired: {self.repair}' if self.repair else self.message

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


def make_report(name: str, findings: Iterable[Finding]) -> CheckReport:
    """A report with the gravest findings first, in order of time within one severity."""
    ordered = sorted(
        findings, key=lambda f: (-SEVERITIES.index(f.severity), f.start_s or 0.0, f.code)
    )
    return CheckReport(name, tuple(ordered))
