"""Count what colcon's tests reported: python tools/count_tests.py [PACKAGE...].

colcon exits with 0 when a package ran no test at all, so that is looked for here. The last line is
'N passed, N failed, N skipped'; the exit code is 0 when tests ran and none failed.
"""

import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


def counts(report: Path) -> tuple[int, int, int]:
    """Numbers of (passed, failed, skipped) tests in a JUnit report."""
    suites = list(ElementTree.parse(report).iter('testsuite'))
    total, errors, failures, skipped = (
        sum(int(suite.get(key, 0)) for suite in suites)
        for key in ('tests', 'errors', 'failures', 'skipped')
    )
    return total - errors - failures - skipped, errors + failures, skipped


def main(packages: list[str]) -> int:
    """Print one line per package without tests, then the sum of all."""
    names = packages or sorted(p.parent.name for p in ROOT.glob('src/*/package.xml'))
    results = []
    for name in names:
        report = ROOT / 'build' / name / 'pytest.xml'
        results.append(counts(report) if report.is_file() else (0, 0, 0))
        if not sum(results[-1]):
            print(f'{name}: no test ran')
    passed, failed, skipped = (sum(column) for column in zip(*results, strict=True))
    print(f'{passed} passed, {failed} failed, {skipped} skipped')
    return 0 if passed and not failed and all(map(sum, results)) else 1


if __name__ == '__main__':
    sys.exit(main(sys.argv[1:]))
