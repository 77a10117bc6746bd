"""Command line: draw report.html again from the results in a directory."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from cg_sysid.cli import common as cli
from cg_sysid.report import write_report


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(
        prog='cg report',
        description='Draw the report of a diagnosis or an identification again, from '
        'diagnosis.json or identification.json and curves.npz.',
    )
    made.add_argument('directory', type=Path, metavar='DIR', help='directory of the results')
    made.add_argument('--out', type=Path, metavar='FILE', help='page to write [DIR/report.html]')
    return made


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run('cg report', work, parser().parse_args(args))


def work(options: argparse.Namespace) -> int:
    """Read and draw."""
    if not options.directory.is_dir():
        raise ValueError(f'{options.directory}: no such directory')
    print(write_report(options.directory, options.out))
    return 0


if __name__ == '__main__':
    sys.exit(main())
