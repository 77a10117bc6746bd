"""What is installed where, and that each executable says what it is for."""

import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

rclpy = pytest.importorskip('rclpy')

from rclpy.parameter import Parameter  # noqa: E402

from cg_interfaces.domains import own_domain  # noqa: E402
from cg_interfaces.settings import Settings  # noqa: E402
from cg_sysid.cli.command import COMMANDS  # noqa: E402

SOURCES = Path(__file__).resolve().parents[2]
PACKAGES = sorted(path.parent.name for path in SOURCES.glob('*/setup.py'))
NODE_MODULES = sorted(
    f'{path.parent.name}.{path.stem}' for path in SOURCES.glob('cg_*/cg_*/*_node.py')
)
# What setup.py would install, in a Python with or without rclpy.
ENTRY_POINTS = """
import json, sys
from distutils.core import run_setup
if sys.argv[2] == 'without':
    sys.modules['rclpy'] = None
made = run_setup('setup.py', script_args=[sys.argv[1]], stop_after='init')
print(json.dumps([e.split(' = ') for e in (made.entry_points or {}).get('console_scripts', [])]))
"""

in_workspace = pytest.mark.skipif(
    not (SOURCES / 'cg_sysid' / 'setup.py').is_file(), reason='the package is not in its workspace'
)


def entry_points(package, command, rclpy):
    done = subprocess.run(
        [sys.executable, '-W', 'ignore', '-c', ENTRY_POINTS, command, rclpy],
        cwd=SOURCES / package, capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    return dict(json.loads(done.stdout.splitlines()[-1]))


@in_workspace
@pytest.mark.parametrize('rclpy', ['with', 'without'])
def test_pip_installs_one_command(rclpy):
    """`import`, `check` and `report` are names of others; pip makes a wheel."""
    offline = ('cg_description', 'cg_dynamics', 'cg_sysid')
    found = [name for p in offline for name in entry_points(p, 'bdist_wheel', rclpy)]
    assert found == ['cg']


@in_workspace
@pytest.mark.parametrize('package', PACKAGES)
def test_nodes_are_installed_only_where_they_can_run(package):
    present = set(entry_points(package, 'develop', 'with'))
    absent = set(entry_points(package, 'develop', 'without'))
    mine = {module.split('.')[1] for module in NODE_MODULES if module.split('.')[0] == package}
    assert present - absent == mine


@in_workspace
def test_ros2_run_finds_every_command():
    """colcon calls `develop`, or `install` without symlinks."""
    for command in ('develop', 'install'):
        found = entry_points('cg_sysid', command, 'with')
        assert {f'cg_sysid.{c.module}:main' for c in COMMANDS.values()} <= set(found.values())
        assert {name.replace('-', '_') for name in COMMANDS} <= set(found)


@pytest.fixture(scope='module')
def bus():
    """One context for all nodes of this file."""
    with own_domain():
        rclpy.init()
        try:
            yield
        finally:
            rclpy.try_shutdown()


def _node_class(module):
    """The class of the node that a module holds."""
    found = [c for c in vars(module).values()
             if isinstance(c, type) and issubclass(c, rclpy.node.Node)
             and c.__module__ == module.__name__]  # fmt: skip
    assert len(found) == 1
    return found[0]


@pytest.mark.parametrize('name', NODE_MODULES)
def test_help_names_every_parameter_and_topic(name, bus, tmp_path, capsys):
    module = importlib.import_module(name)
    assert module.main(['--help']) == 0
    said = capsys.readouterr().out
    overrides = [Parameter('bag', value=str(tmp_path / 'bag'))] if 'recorder' in name else []
    node = _node_class(module)(parameter_overrides=overrides)
    try:
        mine = {field for kind in vars(module).values()
                if isinstance(kind, type) and issubclass(kind, Settings)
                for field in kind.__dataclass_fields__}  # fmt: skip
        for parameter in mine & set(node._parameters):
            assert f'\n  {parameter} ' in said
        common = {'/parameter_events', '/rosout', '/clock', '/diagnostics'}
        ends = [*node.publishers, *node.subscriptions]
        topics = {end.topic_name for end in ends} - common
        if 'recorder' in name:
            topics = {'/experiment', '/recorder/progress'}
        private = f'/{node.get_name()}/'
        for topic in topics:
            assert topic.startswith(private) or topic in said, f'--help does not name {topic}'
    finally:
        getattr(node, 'close', lambda: None)()
        node.destroy_node()


@pytest.mark.parametrize('name', NODE_MODULES)
@pytest.mark.parametrize('word', ['-h', '--help'])
def test_help_starts_nothing(name, word, monkeypatch, capsys):
    def refuse(*_, **__):
        raise AssertionError('DDS was started, or the process put before others')

    monkeypatch.setattr(rclpy, 'init', refuse)
    monkeypatch.setattr(os, 'setpriority', refuse)
    main = importlib.import_module(name).main
    assert main([word]) == 0
    assert capsys.readouterr().out.startswith(f'usage: {name.split(".")[1]} [--ros-args')


def test_an_argument_that_no_node_knows_is_refused(monkeypatch, capsys):
    monkeypatch.setattr(rclpy, 'init', None)
    monkeypatch.setattr(os, 'setpriority', None)
    main = importlib.import_module('cg_sysid.recorder_node').main
    assert main(['--bag', 'x', '--ros-args', '-p', 'bag:=y']) == 2
    said = capsys.readouterr().err
    assert "unknown argument '--bag'" in said
    assert '-p NAME:=VALUE' in said
