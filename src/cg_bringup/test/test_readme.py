"""Every block of the README runs as it is printed, in order, and says what the text says."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from cg_dynamics.model import Model
from cg_interfaces.domains import own_domain

pytest.importorskip('rclpy')

ROOT = Path(__file__).resolve().parents[3]
SCRIPT = ROOT / 'tools' / 'try_readme.py'
# They set up, build and take minutes or more; tools/try_readme.py runs them too.
LEFT_OUT = ('make demo', 'make test')

pytestmark = pytest.mark.skipif(
    not SCRIPT.is_file() or not (ROOT / 'install').is_dir(), reason='no built workspace around'
)


@pytest.mark.slow
def test_every_block_runs_in_order_and_finds_what_the_text_says(tmp_path):
    # It looks like a clone that was built, and gets what the blocks write.
    for name in ('cg', 'src'):
        (tmp_path / name).symlink_to(ROOT / name)
    with own_domain() as domain:
        done = subprocess.run(
            [sys.executable, SCRIPT, '--within', tmp_path, '--without', *LEFT_OUT],
            env={**os.environ, 'ROS_DOMAIN_ID': str(domain)}, stdin=subprocess.DEVNULL,
            capture_output=True, text=True, timeout=550, check=False,
        )  # fmt: skip
    said = ' '.join(done.stdout.split())
    assert done.returncode == 0, f'{done.stdout}\n{done.stderr}'
    assert said.count('simulated robot robot: swing_inner_fixed, 5 s') == 2
    told = re.findall(r'The simulation lacks sensor_delay \(delay = (\S+) \u00b1 (\S+) ms\)', said)
    assert len(told) == 2
    assert all(abs(float(delay) - 12.0) < 4 * float(sigma) + 0.06 for delay, sigma in told)
    for name in LEFT_OUT:
        assert name not in said
    labels = [effect.label for effect in Model.load(tmp_path / 'extended.yaml').effects]
    assert 'sensor_delay' in labels
    for name in ('report.html', 'diagnosis.json', 'model.yaml'):
        assert (tmp_path / 'answer' / name).is_file()


def test_a_block_that_fails_is_named(tmp_path):
    (tmp_path / 'cg').write_text('#!/bin/sh\nexit 3\n')
    (tmp_path / 'cg').chmod(0o755)
    done = subprocess.run(
        [sys.executable, SCRIPT, '--within', tmp_path, '--without', *LEFT_OUT],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert 'exit code 3 of\n./cg exec python' in done.stderr
