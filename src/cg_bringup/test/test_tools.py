"""The scripts of the workspace: what they refuse, they refuse in one sentence and exit with 1."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from cg_sysid.cli.command import COMMANDS

ROOT = Path(__file__).resolve().parents[3]

pytestmark = pytest.mark.skipif(
    not (ROOT / 'tools' / 'setup.sh').is_file(), reason='the package is not in its workspace'
)


def run(*command, root=ROOT, **environment):
    """Run a command of the workspace with these variables set, or unset where None."""
    env = {**os.environ, **environment}
    env = {key: value for key, value in env.items() if value is not None}
    return subprocess.run(
        command, cwd=root, env=env, capture_output=True, text=True, timeout=60, check=False
    )


@pytest.fixture
def bare(tmp_path):
    """The scripts and locks alone, where nothing was set up."""
    shutil.copytree(ROOT / 'tools', tmp_path / 'tools')
    shutil.copytree(ROOT / 'requirements', tmp_path / 'requirements')
    shutil.copy(ROOT / 'cg', tmp_path)
    return tmp_path


def stand_in(folder, name, text):
    """An executable shell script in folder/bin, which then comes first on the PATH."""
    path = folder / 'bin' / name
    path.parent.mkdir(exist_ok=True)
    path.write_text(f'#!/bin/sh\n{text}\n')
    path.chmod(0o755)
    return f'{path.parent}{os.pathsep}{os.environ["PATH"]}'


def python_without(folder, word):
    """A python3 that fails at any command that has this word in it."""
    stand_in(folder, 'python3', f'case "$*" in *{word}*) exit 1; esac; exec {sys.executable} "$@"')
    return str(folder / 'bin' / 'python3')


def assert_refused(result, *words):
    assert result.returncode == 1
    assert result.stdout == ''
    assert len(result.stderr.splitlines()) == 1, result.stderr
    for word in words:
        assert word in result.stderr


def test_setup_refuses_other_ros_distributions(bare):
    assert_refused(run('tools/setup.sh', root=bare, ROS_DISTRO='humble'), 'humble', 'jazzy')


def test_setup_refuses_other_machines(bare):
    path = stand_in(bare, 'uname', '[ "$1" = -m ] && echo aarch64 || echo Linux')
    assert_refused(run('tools/setup.sh', root=bare, PATH=path, ROS_DISTRO=None), 'aarch64')


def test_setup_refuses_other_pythons(bare):
    stand_in(bare, 'python3.9', 'echo 3.9.18')
    result = run('tools/setup.sh', root=bare, PYTHON=str(bare / 'bin/python3.9'), ROS_DISTRO=None)
    assert_refused(result, '3.9.18', '3.10')


def test_setup_refuses_a_python_that_is_not_there(bare):
    assert_refused(
        run('tools/setup.sh', root=bare, PYTHON='python3.99', ROS_DISTRO=None), 'python3.99'
    )


def test_setup_refuses_a_python_without_venv(bare):
    python = python_without(bare, 'ensurepip')
    result = run('tools/setup.sh', root=bare, PYTHON=python, ROS_DISTRO=None)
    assert_refused(result, 'python3-venv')


def test_setup_refuses_jazzy_without_rclpy(bare):
    python = python_without(bare, 'rclpy')
    result = run('tools/setup.sh', root=bare, PYTHON=python, ROS_DISTRO='jazzy')
    assert_refused(result, 'rclpy', 'setup.bash')


def test_cg_names_what_there_is():
    wrong = run('./cg', 'fly')
    assert (wrong.returncode, wrong.stdout) == (2, '')
    assert wrong.stderr.splitlines() == [wrong.stderr.strip()]
    assert "no command 'fly'" in wrong.stderr
    assert 'list, run, launch, exec' in wrong.stderr
    assert "did you mean 'launch'?" in run('./cg', 'lanch').stderr
    assert_refused(run('./cg', 'run', 'cg_none', 'x'), 'cg_none', 'cg_hardware')
    assert_refused(run('./cg', 'run', 'cg_hardware', 'x'), "'x'", 'simulation_node')
    listing = run('./cg', 'list', 'cg_sysid')
    assert listing.returncode == 0
    assert 'diagnose' in listing.stdout.split()


def test_cg_passes_on_what_is_done_with_files():
    said = run('./cg', '--help').stdout
    for name in ('list', 'run', 'launch', 'exec', *COMMANDS):
        assert re.search(rf'^    (\./cg )?{name} ', said, re.MULTILINE), name
    listing = run('./cg', 'import', '--list')
    assert listing.returncode == 0
    assert 'sydney_pendulum: ' in listing.stdout
    assert run('./cg', 'report', 'none').returncode == 2


def test_cg_before_the_first_set_up(bare):
    assert './cg run PACKAGE EXECUTABLE' in run('./cg', '--help', root=bare).stdout
    assert_refused(run('./cg', 'list', root=bare), 'make setup')


def test_environment_is_the_same_however_often_it_is_sourced():
    show = 'echo "$AMENT_PREFIX_PATH $PYTHONPATH"'
    once, twice = (
        run('bash', '-c', f'{". tools/env.sh;" * times} {show}', ROS_DISTRO=None).stdout
        for times in (1, 2)
    )
    assert once == twice


def test_locks_name_no_address_and_pin_everything():
    for lock in (ROOT / 'requirements').glob('*.txt'):
        lines = lock.read_text().splitlines()
        assert not [line for line in lines if '://' in line]
        pins = [line for line in lines if line and not line.startswith((' ', '#'))]
        assert all('==' in pin for pin in pins)
        assert len([line for line in lines if '--hash=sha256:' in line]) >= len(pins)
