"""Go through the checklist of a real robot that is running (`ros2 run cg_bringup robot`).

    ros2 run cg_bringup checklist                     # one step after the other, with a person
    ros2 run cg_bringup checklist --yes --go-on       # nobody is asked: emulated robots, tests

Each step says what you have to do, measures, and says passed, failed or skipped, and why. After
each, and at Ctrl-C, torque is zero. What came of it is kept in a file, which recordings name.
"""

import argparse

import yaml

from cg_bringup.operating import TaskSettings
from cg_bringup.runs import enclave_arguments
from cg_hardware.checklist.steps import NAMES, STEPS


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_bringup checklist`."""
    default = TaskSettings()
    parser = argparse.ArgumentParser(
        prog='checklist', description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        '--model', default='', help='what the robot is believed to be: a file or a name [nominal]'
    )
    parser.add_argument(
        '--setup', default=default.setup,
        help=f'what holds the robot, YAML text or a file [{default.setup}]',
    )  # fmt: skip
    parser.add_argument(
        '--torque', type=float, default=default.torque,
        help=f'the small torque in N m; it must overcome the friction [{default.torque:g}]',
    )  # fmt: skip
    parser.add_argument(
        '--steps', nargs='+', choices=NAMES, default=[], metavar='STEP',
        help='these only: ' + ', '.join(f'{step.name} ({step.title})' for step in STEPS),
    )  # fmt: skip
    parser.add_argument(
        '--without-torque', action='store_true', help='leave out what torques the hip'
    )
    parser.add_argument('--go-on', action='store_true', help='go on after a step that failed')
    parser.add_argument('--yes', action='store_true', help='ask nobody')
    parser.add_argument(
        '--out', default=default.checklists, help=f'folder of the records [{default.checklists}]'
    )
    options = parser.parse_args(args)
    from cg_bringup import experimenter_node  # ROS, which --help does without

    given = {
        'task': 'checklist', 'model_file': options.model, 'setup': options.setup,
        'torque': options.torque, 'steps': options.steps, 'yes': options.yes,
        'without_torque': options.without_torque, 'go_on': options.go_on,
        'checklists': options.out,
    }  # fmt: skip
    words = ['--ros-args', *enclave_arguments('experimenter')]
    for name, value in given.items():
        if value not in ('', []):
            words += ['-p', f'{name}:={yaml.safe_dump(value, default_flow_style=True).strip()}']
    return experimenter_node.main(words)


if __name__ == '__main__':
    raise SystemExit(main())
