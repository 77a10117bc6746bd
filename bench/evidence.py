"""The tests that are marked `evidence`: long ones, and more cases of what the suite shows.

    ./cg exec python bench/evidence.py [--write]

Runs them with all their assertions, one process a core, and prints a table; `--write` stores it
as bench/results/evidence.md. `make test` leaves them out.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

from cg_description.model_file import write_atomically

ROOT = Path(__file__).resolve().parents[1]
TARGET = ROOT / 'bench/results/evidence.md'


def outcomes(report: Path) -> list[tuple[str, str, float]]:
    """(test, outcome, seconds) of each case in a JUnit report."""
    rows = []
    for case in ET.parse(report).getroot().iter('testcase'):
        kinds = {child.tag for child in case}
        failed, skipped = kinds & {'failure', 'error'}, 'skipped' in kinds
        outcome = 'failed' if failed else 'skipped' if skipped else 'passed'
        name = f'{case.get("classname", "").rsplit(".", 1)[-1]}::{case.get("name")}'
        rows.append((name, outcome, float(case.get('time', 0.0))))
    return sorted(rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--write', action='store_true', help='store the table')
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / 'report.xml'
        status = subprocess.call(
            [
                *(sys.executable, '-m', 'pytest', '-q', '-n', 'logical'),
                *('--dist', 'load', '--maxschedchunk', '1'),
                *('-m', 'evidence', f'--junitxml={report}'),
                *(str(ROOT / 'src' / p) for p in ('cg_control', 'cg_sysid', 'cg_bringup')),
            ],
            cwd=ROOT,
        )
        rows = outcomes(report)
    passed = sum(outcome == 'passed' for _, outcome, _ in rows)
    text = '\n'.join([
        '# More cases of what the suite shows',
        '',
        f'`python bench/evidence.py`: {passed} of {len(rows)} pass, with all their assertions, on '
        f'{os.cpu_count()} cores.',
        '',
        '| test | outcome | wall time, s |',
        '|---|---|---:|',
        *(f'| `{name}` | {outcome} | {seconds:.0f} |' for name, outcome, seconds in rows),
        '',
    ])  # fmt: skip
    print(text)
    if options.write:
        write_atomically(TARGET, text)
    return status


if __name__ == '__main__':
    sys.exit(main())
