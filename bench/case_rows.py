"""Cases that are run once for each version of the sources, a line of JSON each.

A bench that is broken off goes on from there; a table is of one version.
"""

import json
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from typing import Any

Row = dict[str, Any]


def known_rows(raw: Path, version: str | None) -> dict[str, Row]:
    """Rows of a version by case; by default those of the last version there.

    Args:
        raw: Lines of JSON with `case` and `version`; it need not be there yet.
        version: Hash of the sources.
    """
    if not raw.exists():
        return {}
    rows = [json.loads(line) for line in raw.read_text().splitlines()]
    version = version or rows[-1]['version']
    return {row['case']: row for row in rows if row['version'] == version}


def with_missing(
    rows: dict[str, Row],
    cases: Sequence[Any],
    run: Callable[[Any, str, float], Row],
    version: str,
    raw: Path,
    workers: int,
    limit: float,
    told: Callable[[Row], str],
) -> dict[str, Row]:
    """Rows of all cases: those that are missing are run, each in a process of its own.

    Args:
        rows: Those that are known.
        cases: With a `name`.
        run: (case, version, limit) -> row.
        version: Hash of the sources.
        raw: Where a line is added for each.
        workers: Cases side by side.
        limit: Of a case, as `run` takes it.
        told: A row in words, for the screen.
    """
    missing = [case for case in cases if case.name not in rows]
    raw.parent.mkdir(parents=True, exist_ok=True)
    found = dict(rows)
    with ProcessPoolExecutor(workers, max_tasks_per_child=1) as pool:
        futures = [pool.submit(run, case, version, limit) for case in missing]
        for done, future in enumerate(as_completed(futures), 1):
            row = future.result()
            found[row['case']] = row
            with raw.open('a') as file:
                file.write(json.dumps(row) + '\n')
            print(f'{done}/{len(missing)}', told(row), flush=True)
    return found
