"""What a host that does not keep time is excused from, and what not (conftest.py)."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CONFTEST = Path(__file__).parents[3] / 'conftest.py'
TESTS = """
import pytest

@pytest.mark.alone
@pytest.mark.parametrize('k', range(4))
def test_in_time(k):
    if k < {excused}:
        pytest.skip('the host held the emulation up by 1 s')

@pytest.mark.parametrize('k', range(20))
def test_of_something_else(k):
    pass
"""


@pytest.mark.parametrize(('excused', 'code'), [
    pytest.param(0, 0, marks=pytest.mark.evidence), (1, 0), (3, 1),
])  # fmt: skip
def test_a_run_that_excuses_most_tests_with_deadlines_fails(tmp_path, excused, code):
    shutil.copy(CONFTEST, tmp_path)
    (tmp_path / 'pyproject.toml').write_text(
        "[tool.pytest.ini_options]\nmarkers = ['alone: .', 'slow: .']\n"
    )
    (tmp_path / 'test_deadlines.py').write_text(TESTS.format(excused=excused))
    # A host that is busy in fact must not excuse more of them.
    found = subprocess.run(
        [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', str(tmp_path)],
        cwd=tmp_path, env=os.environ | {'CG_NO_EXCUSE': '1'}, capture_output=True, text=True,
        timeout=60, check=False,
    )  # fmt: skip
    assert found.returncode == code, found.stdout
    assert ('too few' in found.stdout) == (code != 0)
    assert (f'{excused} tests with deadlines' in found.stdout) == (excused > 0)
