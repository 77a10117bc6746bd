from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

NAME = 'cg_description'


def shared(*folders):
    """The files below these folders, each to its place under share/cg_description."""
    files = [p for folder in folders for p in sorted(glob(f'{folder}/**', recursive=True))]
    return [(f'share/{NAME}/{Path(p).parent}', [p]) for p in files if Path(p).is_file()]


setup(
    name=NAME,
    version='0.2.0',
    description='The compass-gait robot as data',
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
        'PyYAML',
    ],
    extras_require={'test': ['pytest', 'pytest-timeout']},
    zip_safe=False,
)
