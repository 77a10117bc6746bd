"""The one command `cg`: all that is done with files, robot or no robot, ROS or no ROS.

    cg COMMAND [ARGS...]          cg COMMAND --help

Each command is a module of this package with a `main`, imported only when it is called.
"""

import difflib
import importlib
import os
import sys
from collections.abc import Sequence
from typing import NamedTuple

BAD_COMMAND = 2
LAUNCHER = 'CG_LAUNCHER'  # commands that the workspace's launcher ./cg has besides


class Command(NamedTuple):
    """One of them.

    Attributes:
        module: Module of this package whose `main` it is.
        summary: What it does, for the list.
    """

    module: str
    summary: str


COMMANDS = {
    'new-model': Command('cli.new_model', 'write a commented model file to start from'),
    'new-robot': Command('cli.new_robot', 'write a model file from a URDF and recordings'),
    'write-urdf': Command('cli.write_urdf', 'put what was identified into a URDF'),
    'import': Command(
        'records.importing', 'make recordings of logs from elsewhere: CSV, MAT, JSON'
    ),
    'rehearse': Command('cli.rehearse', 'record an experiment on a simulated robot, without ROS'),
    'check': Command(
        'checks.recordings', 'say what is wrong with recordings before anything is fitted'
    ),
    'identify': Command('cli.identify', 'find the numbers of a model from recordings'),
    'torques': Command('cli.torques', 'say which laws the torques of a robot lack, in a minute'),
    'diagnose': Command('cli.diagnose', 'say what a model gets wrong about recordings, and why'),
    'report': Command('cli.report', 'draw the report of a result again'),
    'frequency-response': Command(
        'identification.frequency_response', 'find resonances in a recording'
    ),
    'recover': Command('records.recover', 'make an ordinary recording of one that was cut off'),
}


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code of the command."""
    name, *rest = list(sys.argv[1:] if args is None else args) or ['--help']
    if name in ('-h', '--help', 'help'):
        print(usage())
        return 0
    command = COMMANDS.get(name.replace('_', '-'))
    if command is None:
        print(f'cg: error: {unknown(name)}', file=sys.stderr)
        return BAD_COMMAND
    # Whoever reads a pipe shall see each line when it is written.
    for stream in (sys.stdout, sys.stderr):
        getattr(stream, 'reconfigure', lambda **_: None)(line_buffering=True)
    return importlib.import_module(f'cg_sysid.{command.module}').main(rest)


def usage() -> str:
    """What `cg --help` says."""
    width = max(map(len, COMMANDS))
    lines = [f'    {name:{width}}  {command.summary}' for name, command in COMMANDS.items()]
    return '\n'.join(['usage: cg COMMAND [ARGS...]', '', *lines, '',
                      'cg COMMAND --help says more about each.'])  # fmt: skip


def unknown(name: str) -> str:
    """That there is no such command; the nearest, or else all there are."""
    known = [*COMMANDS, *os.environ.get(LAUNCHER, '').split()]
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f'did you mean {near[0]!r}?' if near else f'there are: {", ".join(known)}'
    return f'there is no command {name!r}; {hint}'


if __name__ == '__main__':
    sys.exit(main())
