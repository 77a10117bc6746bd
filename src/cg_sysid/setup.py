import sys
from glob import glob
from importlib.util import find_spec
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'cg_sysid'

# colcon calls `setup.py develop` or `setup.py install`, in the shell's environment, and setup.cfg
# sends executables to lib/cg_sysid, where only `ros2 run` looks and a name such as `import` is
# nobody else's. pip makes a wheel, whose executables go to bin, for all to see, and does so in an
# environment of its own, in which rclpy is never found, whatever the shell has sourced.
TO_OWN_FOLDER = not {'develop', 'install'}.isdisjoint(sys.argv)
PROGRAMS = [
    'recover = cg_sysid.records.recover:main',
    'import = cg_sysid.records.importing:main',
    'check = cg_sysid.checks.recordings:main',
    'identify = cg_sysid.cli.identify:main',
    'torques = cg_sysid.cli.torques:main',
    'diagnose = cg_sysid.cli.diagnose:main',
    'report = cg_sysid.cli.report:main',
    'rehearse = cg_sysid.cli.rehearse:main',
    'new_model = cg_sysid.cli.new_model:main',
    'new_robot = cg_sysid.cli.new_robot:main',
    'write_urdf = cg_sysid.cli.write_urdf:main',
    'frequency_response = cg_sysid.identification.frequency_response:main',
]
NODES = [
    'excitation_node = cg_sysid.excitation_node:main',
    'recorder_node = cg_sysid.recorder_node:main',
]


def shared(*folders):
    """The files below these folders, each to its place under share/cg_sysid."""
    files = [p for folder in folders for p in sorted(glob(f'{folder}/**', recursive=True))]
    return [(f'share/{NAME}/{Path(p).parent}', [p]) for p in files if Path(p).is_file()]


setup(
    name=NAME,
    version='0.2.0',
    description='System identification and diagnosis of the compass-gait robot',
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
        *shared('config', 'launch', 'models', 'rviz', 'layouts', 'urdf'),
    ],
    python_requires='>=3.10',
    install_requires=[
        'casadi',
        'cg_description',
        'cg_dynamics',
        'cg_interfaces',
        'lz4',
        'matplotlib',
        'mcap',
        'numpy',
        'PyYAML',
        'rich',
        'rosbags',
        'scipy',
        'zstandard',
    ],
    extras_require={'cluster': ['distributed'], 'test': ['pytest', 'pytest-timeout']},
    zip_safe=False,
    entry_points={
        'console_scripts': [
            'cg = cg_sysid.cli.command:main',
            *(PROGRAMS if TO_OWN_FOLDER else []),
            *(NODES if TO_OWN_FOLDER and find_spec('rclpy') else []),
        ],
    },
)
