"""The launch files, where `ros2 launch` is installed: a node that dies ends them with an error."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip('launch.actions', reason='launch is not among the ROS wheels')
pytest.importorskip('launch_ros.actions', reason='launch is not among the ROS wheels')

from launch.actions import DeclareLaunchArgument

from cg_interfaces.domains import own_domain

pytestmark = pytest.mark.alone

FILES = sorted((Path(__file__).resolve().parents[1] / 'launch').glob('*.launch.py'))


# What `ros2 launch` does with a file and its arguments.
LAUNCH = """
import sys
from ros2launch.api import launch_a_launch_file
sys.exit(launch_a_launch_file(launch_file_path=sys.argv[1], launch_file_arguments=sys.argv[2:],
                              noninteractive=True))
"""


def launch(name, *arguments):
    """Exit code of a launch file, and what was said."""
    path = next(file for file in FILES if file.name == f'{name}.launch.py')
    with own_domain():
        done = subprocess.run(
            [sys.executable, '-c', LAUNCH, str(path), *arguments],
            stdin=subprocess.DEVNULL, capture_output=True, text=True, check=False,
        )  # fmt: skip
    return done.returncode, done.stdout + done.stderr


@pytest.mark.parametrize('file', FILES, ids=lambda file: file.name)
def test_every_argument_is_described_and_has_a_default(file):
    spec = importlib.util.spec_from_file_location(file.name.partition('.')[0], file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    entities = module.generate_launch_description().entities
    arguments = [e for e in entities if isinstance(e, DeclareLaunchArgument)]
    assert arguments
    assert all(a.description and a.default_value is not None for a in arguments)


def test_a_method_that_does_not_exist_ends_the_launch():
    status, said = launch('balance', 'method:=nonsense')
    assert 'observer ended with exit code 2' in said
    assert 'Traceback' not in said
    assert status == 1


def test_an_experiment_onto_an_existing_bag_ends_the_launch(tmp_path):
    status, said = launch('experiment', 'experiment:=legs_tied', f'bag:={tmp_path}')
    assert 'never overwritten' in said
    assert 'Traceback' not in said
    assert status == 1


def test_an_argument_that_is_no_number_is_named():
    status, said = launch('rebalance', 'seed:=x')
    assert "seed is 'x'; a whole number is needed" in said
    assert status == 1


def test_an_experiment_is_recorded(tmp_path):
    bag = tmp_path / 'bag'
    given = ('experiment:=legs_tied', f'bag:={bag}', 'mode:=lockstep', 'duration:=0.5')
    assert launch('experiment', *given)[0] == 0
    assert (bag / 'metadata.yaml').is_file()


def test_a_robot_that_falls_is_an_error():
    status, said = launch('balance', 'lean:=0.3', 'mode:=lockstep', 'duration:=5')
    assert 'fell at' in said
    assert status == 1


def test_a_tree_of_another_robot_ends_the_launch():
    status, said = launch('tree', 'model:=compass_gait_flexible')
    assert 'grown for a model with hash' in said
    assert status == 1


def test_a_robot_that_comes_home_is_no_error():
    status, said = launch('tree', 'start:=upright', 'mode:=lockstep', 'duration:=1.5')
    assert 'upright at the end' in said
    assert status == 0
