from setuptools import find_packages, setup

NAME = 'cg_interfaces'


setup(
    name=NAME,
    version='0.2.0',
    description='Topics, messages, settings and ROS helpers of the compass-gait robot',
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
    package_data={'': ['*.xml']},
    data_files=[
        ('share/ament_index/resource_index/packages', [f'resource/{NAME}']),
        (f'share/{NAME}', ['package.xml']),
    ],
    python_requires='>=3.10',
    install_requires=['cg_description', 'cg_dynamics', 'numpy', 'PyYAML'],
    extras_require={'test': ['pytest', 'pytest-timeout']},
    zip_safe=False,
)
