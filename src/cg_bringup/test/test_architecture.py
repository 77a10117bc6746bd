"""The rooms of the house: who may import whom, where ROS may be, what the executables point to."""

import ast
import importlib
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from importlib.metadata import entry_points, version
from pathlib import Path

import pytest

SRC = Path(__file__).resolve().parents[2]

# architecture.md.
MAY_IMPORT = {
    'cg_description': set(),
    'cg_dynamics': {'cg_description'},
    'cg_interfaces': {'cg_description', 'cg_dynamics'},
    'cg_estimation': {'cg_description', 'cg_dynamics', 'cg_interfaces'},
    'cg_control': {'cg_description', 'cg_dynamics', 'cg_interfaces'},
    'cg_hardware': {'cg_description', 'cg_dynamics', 'cg_interfaces'},
    'cg_sysid': {'cg_description', 'cg_dynamics', 'cg_interfaces'},
    'cg_bringup': {
        'cg_control', 'cg_description', 'cg_dynamics', 'cg_estimation', 'cg_hardware',
        'cg_interfaces', 'cg_sysid',
    },
}  # fmt: skip
# Rooms of a package, by floor: a module imports from its own room and from floors below. Modules
# beside the rooms are on the ground floor, if they are not named.
FLOORS = {
    'cg_sysid': (
        ('records',),
        ('experiments', 'identification'),
        ('stances',),
        ('checks', 'search'),
        ('learned', 'landings'),
        ('diagnosis',),
        ('report',),
        ('cli',),
    ),
    'cg_control': (
        ('balancing',),
        ('trajectories',),
        ('following',),
        ('orbits', 'trees'),
        ('walking',),
    ),
    'cg_dynamics': (
        ('mechanisms',),
        ('effects',),
        ('model',),
        ('assemble',),
        ('rollout',),
        ('walking',),
        ('plant', 'linearise', 'cluster'),
    ),
}
GROUND = {
    'cg_control': {
        '__init__', 'balance_node', 'cost_tuning', 'state_feedback', 'grow_tree', 'plan_walk',
        'trajectory_server_node', 'tree_controller_node', 'tree_server_node', 'tvlqr_node',
    },
    'cg_sysid': {'__init__', '__main__', 'excitation_node', 'recorder_node'},
}  # these reach up: they are the way in  # fmt: skip
ROS = {
    'diagnostic_msgs', 'geometry_msgs', 'lifecycle_msgs', 'rcl_interfaces', 'rclpy', 'sensor_msgs',
    'std_msgs', 'std_srvs', 'trajectory_msgs', 'visualization_msgs',
}  # fmt: skip
ROS_HELPERS = {'ros', 'drive_publishers', 'sensor_publishers', 'state_feedback'}


def imports(path):
    """Top-level names of all packages that a file imports, at any depth."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            names |= {alias.name.split('.')[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module.split('.')[0])
    return names


def modules(package):
    return sorted((SRC / package / package).rglob('*.py'))


@pytest.mark.parametrize('package', MAY_IMPORT)
def test_imports_point_one_way(package):
    allowed = MAY_IMPORT[package] | {package}
    for path in modules(package):
        foreign = {name for name in imports(path) if name.startswith('cg_')} - allowed
        assert not foreign, f'{path.relative_to(SRC)} imports {foreign}'


def own_imports(path, package):
    """Modules of its own package that a file imports, as tuples of names below it."""
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.ImportFrom) and node.module:
            first, *below = node.module.split('.')
            if first == package:
                yield tuple(below)


@pytest.mark.parametrize('package', FLOORS)
def test_rooms_import_from_floors_below(package):
    floor_of = {room: i for i, rooms in enumerate(FLOORS[package], 1) for room in rooms}
    folders = {p.parent.name for p in (SRC / package / package).glob('*/__init__.py')}
    assert folders <= set(floor_of)
    for path in modules(package):
        room = path.relative_to(SRC / package / package).parts[0].removesuffix('.py')
        if room in GROUND.get(package, ()):
            continue
        for below in own_imports(path, package):
            other = below[0] if below and below[0] in floor_of else ''
            if other == room:
                continue
            here, there = floor_of.get(room, 0), floor_of.get(other, 0)
            assert there < here or there == 0, f'{path.relative_to(SRC)} imports {other}'


@pytest.mark.parametrize('package', MAY_IMPORT)
def test_manifest_names_the_packages_that_are_imported(package):
    manifest = ElementTree.parse(SRC / package / 'package.xml')
    declared = {element.text for element in manifest.iter('exec_depend')}
    used = set().union(*(imports(path) for path in modules(package))) & (ROS | set(MAY_IMPORT))
    assert used - {package} <= declared


@pytest.mark.parametrize('package', [name for name in MAY_IMPORT if name != 'cg_bringup'])
def test_only_nodes_and_the_ros_helpers_import_ros(package):
    for path in modules(package):
        if not path.stem.endswith('_node') and path.stem not in ROS_HELPERS:
            assert not imports(path) & ROS, path.relative_to(SRC)


# The one reader; what one process of ours leaves to another is no file of others.
READERS = {
    'cg_description/reading.py', 'balancing/basin_sampler.py', 'cg_hardware/standing.py',
}  # fmt: skip


@pytest.mark.parametrize('package', MAY_IMPORT)
def test_yaml_and_json_are_read_by_the_one_reader(package):
    for path in [*modules(package), *(SRC / package).glob('launch/*.py')]:
        if '/'.join(path.parts[-2:]) in READERS:
            continue
        calls = {
            f'{node.value.id}.{node.attr}'
            for node in ast.walk(ast.parse(path.read_text(encoding='utf-8')))
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name)
        }
        foreign = {'yaml.load', 'yaml.safe_load', 'json.load', 'json.loads'}
        assert not calls & foreign, path.relative_to(SRC)


@pytest.mark.parametrize('package', MAY_IMPORT)
def test_built_version_is_the_one_of_package_xml(package):
    manifest = ElementTree.parse(SRC / package / 'package.xml')
    assert version(package) == manifest.findtext('version')


@pytest.mark.parametrize(
    'entry',
    [e for e in entry_points(group='console_scripts') if e.value.split('.')[0] in MAY_IMPORT],
    ids=lambda entry: f'{entry.value.split(".")[0]}-{entry.name}',
)
def test_executables_point_to_functions(entry):
    module, _, function = entry.value.partition(':')
    assert callable(getattr(importlib.import_module(module), function))


@pytest.mark.parametrize(
    'module',
    [
        'cg_control.tvlqr_node', 'cg_estimation.observer_node', 'cg_hardware.simulation_node',
        'cg_sysid.diagnosis.diagnose', 'cg_sysid.recorder_node',
    ],
)  # fmt: skip
def test_parts_of_scipy_are_loaded_when_they_are_used(module):
    """scipy.signal alone takes three quarters of a second, in every node and worker."""
    if module.endswith('_node'):
        pytest.importorskip('rclpy')
    text = f'import sys, {module}; print(*sys.modules)'
    done = subprocess.run([sys.executable, '-c', text], capture_output=True, text=True, check=True)
    late = {f'scipy.{part}' for part in ('interpolate', 'optimize', 'signal', 'stats')}
    assert not late & set(done.stdout.split())
