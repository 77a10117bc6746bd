"""The launch files, where `ros2 launch` is installed: a node that dies ends them with an error."""

import importlib.util
from pathlib import Path

import pytest

pytest.importorskip('launch.actions', reason='launch is not among the ROS wheels')
pytest.importorskip('launch_ros.actions')

from launch import LaunchDescription, LaunchService
from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.launch_description_sources import PythonLaunchDescriptionSource

from cg_dynamics.domains import own_domain

pytestmark = pytest.mark.alone

FILES = sorted((Path(__file__).resolve().parents[1] / 'launch').glob('*.launch.py'))


def launch(name, **arguments):
    path = next(file for file in FILES if file.name == f'{name}.launch.py')
    service = LaunchService(noninteractive=True)
    source = PythonLaunchDescriptionSource(str(path))
    included = IncludeLaunchDescription(source, launch_arguments=arguments.items())
    service.include_launch_description(LaunchDescription([included]))
    with own_domain():
        return service.run()


@pytest.mark.parametrize('file', FILES, ids=lambda file: file.name)
def test_every_argument_is_described_and_has_a_default(file):
    spec = importlib.util.spec_from_file_location(file.name.partition('.')[0], file)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    entities = module.generate_launch_description().entities
    arguments = [e for e in entities if isinstance(e, DeclareLaunchArgument)]
    assert arguments
    assert all(a.description and a.default_value is not None for a in arguments)


def test_a_method_that_does_not_exist_ends_the_launch(capfd):
    assert launch('balance', method='nonsense') == 1
    said = ''.join(capfd.readouterr())
    assert 'observer ended with exit code 2' in said
    assert 'Traceback' not in said


def test_an_experiment_onto_an_existing_bag_ends_the_launch(tmp_path, capfd):
    assert launch('experiment', experiment='legs_tied', bag=str(tmp_path), mode='lockstep') == 1
    assert 'never overwritten' in ''.join(capfd.readouterr())


def test_an_argument_that_is_no_number_is_named(capfd):
    assert launch('rebalance', seed='x') == 1
    assert "seed is 'x'; a whole number is needed" in ''.join(capfd.readouterr())


def test_an_experiment_is_recorded(tmp_path):
    bag = tmp_path / 'bag'
    given = {'experiment': 'legs_tied', 'bag': str(bag), 'mode': 'lockstep', 'duration': '0.5'}
    assert launch('experiment', **given) == 0
    assert (bag / 'metadata.yaml').is_file()


def test_a_robot_that_falls_is_an_error(capfd):
    assert launch('balance', lean='0.3', mode='lockstep', duration='5') == 1
    assert 'fell at' in ''.join(capfd.readouterr())
