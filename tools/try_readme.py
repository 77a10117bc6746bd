#!/usr/bin/env python3
"""Run every block of the README, or of a tutorial, as it is printed, in order, in a fresh clone.

    tools/try_readme.py                                    clones, sets up, builds, tests: hours
    tools/try_readme.py --without 'make demo' 'make test'  clones and builds only
    tools/try_readme.py --within FOLDER ...                in a folder that is built already
    tools/try_readme.py --page docs/tutorials/pendulum.md  another page

A block of Python becomes the file that the sentence before it names. At the end of a fresh clone
the `pip install` of the README is tried in an environment of its own. Needs python3 and git only.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
FENCE = re.compile(r'^```(\w+)\n(.*?)^```$', re.MULTILINE | re.DOTALL)
FILE_NAMED_BEFORE = re.compile(r'a file `([\w.]+)`:\s*\Z')
OURS = re.compile('^from cg_', re.MULTILINE)
PIP_INSTALL = re.compile(r'`pip (install [^`]+)`')


class Block(NamedTuple):
    """A block of the README.

    Attributes:
        language: bash or python.
        text: What is printed in it.
        file: File that it is to be saved as; empty where none is named before it.
    """

    language: str
    text: str
    file: str


def blocks(readme: str) -> Iterator[Block]:
    """All blocks of a text, in order."""
    for match in FENCE.finditer(readme):
        named = FILE_NAMED_BEFORE.search(readme[: match.start()])
        yield Block(match[1], match[2], named[1] if named else '')


def without(text: str, commands: list[str]) -> str:
    """A block less the lines that are one of these commands, comments aside."""
    lines = text.splitlines(keepends=True)
    return ''.join(line for line in lines if line.split('#')[0].strip() not in commands)


def carry_out(block: Block, folder: Path) -> None:
    """Do what a reader does with a block.

    Raises:
        SystemExit: It fails, or it is not said what to do with it.
    """
    if block.file:
        (folder / block.file).write_text(block.text, encoding='utf-8')
    elif block.language != 'bash':
        sys.exit(f'try_readme: no file is named before this block:\n{block.text}')
    elif block.text.strip():
        print(f'-----\n{block.text}-----', flush=True)
        began, used = time.monotonic(), cpu_of_children()
        # As typed line after line; -e, so that no failure is passed over.
        done = subprocess.run(['bash', '-e', '-c', block.text], cwd=folder, check=False)
        spent = f'{time.monotonic() - began:.0f} s, {cpu_of_children() - used:.0f} s of CPU'
        print(f'({spent})', flush=True)
        if done.returncode:
            sys.exit(f'try_readme: exit code {done.returncode} of\n{block.text}')


def cpu_of_children() -> float:
    """CPU time of all processes that were started here and have ended, in s."""
    return sum(os.times()[2:4])


def try_pip(readme: str, folder: Path) -> None:
    """The offline half in an environment of its own: what it adds to bin, and that it starts."""
    place = folder / 'offline'
    venv.create(place, with_pip=True)
    before = {path.name for path in (place / 'bin').iterdir()}
    arguments = PIP_INSTALL.search(readme)[1].split()
    subprocess.run([place / 'bin' / 'python', '-m', 'pip', *arguments], cwd=folder, check=True)
    ours = sorted(
        path.name for path in (place / 'bin').iterdir()
        if path.name not in before and OURS.search(path.read_text('utf-8', errors='replace'))
    )  # fmt: skip
    if ours != ['cg']:
        sys.exit(f'try_readme: pip installed the commands {", ".join(ours)}; expected cg alone')
    subprocess.run([place / 'bin' / 'cg', '--help'], cwd=folder, check=True)


def main() -> None:
    """Clone and go through the README."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--without', nargs='*', default=[], metavar='COMMAND', help='leave out')
    parser.add_argument('--within', type=Path, metavar='FOLDER', help='no clone: run there')
    parser.add_argument('--page', type=Path, default='README.md', help='[%(default)s]')
    options = parser.parse_args()
    readme = (ROOT / options.page).read_text(encoding='utf-8')
    with tempfile.TemporaryDirectory(prefix='cg_readme_') as directory:
        folder = options.within or Path(directory) / 'clone'
        if options.within is None:
            subprocess.run(['git', 'clone', '--quiet', str(ROOT), str(folder)], check=True)
            if options.without:
                subprocess.run(['make', 'build'], cwd=folder, check=True)
        for block in blocks(readme):
            carry_out(block._replace(text=without(block.text, options.without)), folder)
        if options.within is None and PIP_INSTALL.search(readme):
            try_pip(readme, folder)
    print('try_readme: every block went through')


if __name__ == '__main__':
    main()
