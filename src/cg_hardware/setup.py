from glob import glob
from importlib.util import find_spec
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'cg_hardware'

# Only where they can run: colcon builds in the shell's environment, where ROS 2 is, pip in one of
# its own, where rclpy is never found.
NODES = [
    'simulation_node = cg_hardware.simulation_node:main',
    'safety_gate_node = cg_hardware.safety_gate_node:main',
    'imu_node = cg_hardware.imu_node:main',
    'drive_node = cg_hardware.drive_node:main',
]


def shared(*folders):
    """The files below these folders, each to its place under share/cg_hardware."""
    files = [p for folder in folders for p in sorted(glob(f'{folder}/**', recursive=True))]
    return [(f'share/{NAME}/{Path(p).parent}', [p]) for p in files if Path(p).is_file()]


setup(
    name=NAME,
    version='0.2.0',
    description='Hardware of the compass-gait robot, real and simulated',
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
        'cg_description',
        'cg_dynamics',
        'cg_interfaces',
        'numpy',
        'PyYAML',
    ],
    extras_require={'test': ['pytest', 'pytest-timeout']},
    zip_safe=False,
    entry_points={
        'console_scripts': NODES if find_spec('rclpy') else [],
        'cg_hardware.drives': ['skeleton = cg_hardware.drive.skeleton:SkeletonDrive'],
    },
)
