from glob import glob
from importlib.util import find_spec
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'cg_bringup'

# Only where it can run: pip builds in an environment without rclpy.
NODES = ['experimenter_node = cg_bringup.experimenter_node:main']


def shared(*folders):
    """The files below these folders, each to its place under share/cg_bringup."""
    files = [p for folder in folders for p in sorted(glob(f'{folder}/**', recursive=True))]
    return [(f'share/{NAME}/{Path(p).parent}', [p]) for p in files if Path(p).is_file()]


setup(
    name=NAME,
    version='0.2.0',
    description='Configurations, experiments and demonstration of the compass-gait robot',
    maintainer='Compass-gait maintainers',
    maintainer_email='maintainers@compass-gait.dev',
    license='Apache-2.0',
    keywords=['ROS 2', 'legged robots', 'system identification', 'underactuated robotics'],
    classifiers=[
        'Development Status :: 4 - Beta',
        'Intended Audience :: Science/Research',
        'Operating System :: POSIX :: Linux',
        'Programming Language :: Python :: 3',
        'Topic :: Scientific/Engineering',
    ],
    packages=find_packages(exclude=['test', 'test.*']),
    package_data={'': ['*.c', '*.h', '*.css', '*.html', '*.js', '*.yaml']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
        *shared('config', 'launch', 'models', 'rviz', 'layouts', 'security', 'urdf'),
    ],
    python_requires='>=3.10',
    install_requires=[
        'cg_control',
        'cg_description',
        'cg_dynamics',
        'cg_interfaces',
        'cg_estimation',
        'cg_hardware',
        'cg_sysid',
        'PyYAML',
        'rich',
    ],
    extras_require={'test': ['pytest', 'pytest-timeout']},
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'balance = cg_bringup.balance_run:main',
            'checklist = cg_bringup.checklist_run:main',
            'rebalance = cg_bringup.rebalance_run:main',
            'recover_balance = cg_bringup.recover_run:main',
            'robot = cg_bringup.robot_run:main',
            'walk = cg_bringup.walk_run:main',
            'demo = cg_bringup.demo:main',
            'experiment = cg_bringup.experiment:main',
            'replay = cg_bringup.replay:main',
            *(NODES if find_spec('rclpy') else []),
        ],
    },
)
