"""Growth that takes seconds: a small box, small rounds, in this process or one of its own."""

import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

from cg_control import grow_tree
from cg_control.following.nodes import ARRAYS
from cg_control.trees.tree import Tree

BOX = (0.25, 0.5, 0.8, 2.0)  # rad and rad/s, in the roles of the legs
ROUND = 64

PROGRAM = f"""
import sys
from dataclasses import replace
from cg_control import grow_tree

if __name__ == '__main__':
    grow_tree.BOX, grow_tree.WRITTEN, grow_tree.EVERY = {BOX}, 0.0, 0.2
    grow_tree.GROWTH = replace(grow_tree.GROWTH, round_size={ROUND})
    sys.exit(grow_tree.main())
"""


def make_small(monkeypatch) -> None:
    """In this process."""
    monkeypatch.setattr(grow_tree, 'BOX', BOX)
    monkeypatch.setattr(grow_tree, 'GROWTH', replace(grow_tree.GROWTH, round_size=ROUND))


def started(folder: Path, *words: str) -> subprocess.Popen:
    """The command `grow_tree` with these words, in a process and a group of its own."""
    script = folder / 'small_grow_tree.py'
    script.write_text(PROGRAM)
    return subprocess.Popen(
        [sys.executable, str(script), *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, env={**os.environ, 'PYTHONPATH': os.pathsep.join(sys.path)},
        start_new_session=True,
        # Jobs in the background of a shell ignore SIGINT, and all that they start.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip


def assert_same(a: Tree, b: Tree) -> None:
    """To the bit."""
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(a.nodes, name), getattr(b.nodes, name), name)
    np.testing.assert_array_equal(a.goal, b.goal)
    assert a.provenance == b.provenance
