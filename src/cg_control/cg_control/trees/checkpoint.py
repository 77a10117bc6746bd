"""What a tree that is not grown yet needs to grow on: trees.md, "Interrupted growth".

A round depends on the tree before it, on the seed and on its number, and on nothing else. So the
tree, what came by its nodes, the counts and the number of rounds after a whole round are enough:
who goes on from there grows the same tree, to the bit, as who was never interrupted.

The file is an archive like that of a tree (archive.py), with the levels besides. It says as well
what decides the result, so that nobody goes on with other options unawares.
"""

import time
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from cg_control.trees.archive import read_archive, write_archive
from cg_control.trees.growth import Counts, Grower
from cg_control.trees.levels import BINS, Levels
from cg_control.trees.tree import LARGEST_FILE, MEMBERS, Tree, TreeError
from cg_dynamics.model import Model
from cg_dynamics.stop_request import StopRequest

FORMAT = 'cg_growth/1'
SHARE = 0.05  # of the time that may be spent with writing
LEVELS = ('home', 'failed')
MOST_STATES = 1 << 53  # states or rounds


@dataclass(frozen=True)
class Checkpoint:
    """A tree between two rounds.

    Attributes:
        tree: So far, with arrays of its own.
        levels: What came by its nodes, likewise.
        counts: So far.
        rounds: Finished.
        decided: What decides the result, by name, as text (`told`).
    """

    tree: Tree
    levels: Levels
    counts: Counts
    rounds: int
    decided: Mapping[str, str]

    @classmethod
    def of(cls, grower: Grower, **more: Any) -> 'Checkpoint':
        """Where a grower is, between two rounds.

        Args:
            grower: It may grow on afterwards.
            more: What decides the result besides its options, such as the goal.
        """
        return cls(
            _own(grower.tree),
            _own_levels(grower.levels),
            replace(grower.counts),
            grower.rounds,
            told(
                region=grower.region, growth=grower.options, law=grower.settings,
                simulation=grower.simulation, **more,
            ),
        )  # fmt: skip

    def resumed(self, grower: Grower) -> Grower:
        """A grower as this one, which goes on from here."""
        grower = replace(
            grower, tree=_own(self.tree), counts=replace(self.counts), rounds=self.rounds
        )
        grower.levels = _own_levels(self.levels)
        return grower

    def require(self, decided: Mapping[str, str]) -> None:
        """Refuse to go on where something else decides the result.

        Raises:
            TreeError: With the name of what differs, and both values.
        """
        for name in sorted({*decided, *self.decided}):
            here, there = decided.get(name, 'nothing'), self.decided.get(name, 'nothing')
            if here != there:
                raise TreeError(
                    f'begun with {name} {there}, now it is {here}; go on as it was begun, or '
                    'delete the file and begin anew'
                )

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        header = {
            'format': FORMAT,
            **self.tree.header(),
            'tolerated': self.levels.tolerated,
            'counts': vars(self.counts),
            'rounds': self.rounds,
            'decided': dict(self.decided),
        }
        levels = {name: getattr(self.levels, name) for name in LEVELS}
        write_archive(path, header, {**self.tree.arrays(), **levels})

    @classmethod
    def load(cls, path: str | Path, model: Model) -> 'Checkpoint':
        """Read a file.

        Args:
            path: The file.
            model: The robot that the tree is grown for.

        Raises:
            TreeError: for a file that is none, a damaged one, or one of another model.
        """
        try:
            header, arrays = read_archive(
                path, (*MEMBERS, *LEVELS), FORMAT, 'a tree that grows', 2 * LARGEST_FILE, TreeError
            )
            tree = Tree.of(header, arrays)
            tree.require_model(model)
            return cls(tree, _levels(header, arrays), *_numbers(header))
        except TreeError as error:
            raise TreeError(f'{path}: {error}') from None


class Keeper:
    """Keeps the last checkpoint, and writes one every few seconds.

    Args:
        path: The file.
        every: Time in s between two writings; longer where writing takes long.
    """

    def __init__(self, path: str | Path, every: float):
        self.path, self._every = Path(path), every
        self._latest: Checkpoint | None = None
        self._next = time.monotonic() + every

    def keep(self, checkpoint: Checkpoint) -> None:
        """Remember it, and write it if it is time."""
        self._latest = checkpoint
        if time.monotonic() >= self._next:
            self.write()

    def write(self) -> None:
        """Write the last checkpoint, unless it is written.

        Raises:
            Stopped: A signal came meanwhile.
        """
        if self._latest is None:
            return
        began, stop = time.monotonic(), StopRequest()
        try:
            self._latest.save(self.path)
            self._latest = None
        finally:
            stop.restore()
        spent = time.monotonic() - began
        self._next = began + spent + max(self._every, spent / SHARE)
        stop.check()


def _own(tree: Tree) -> Tree:
    """The same with levels of funnels that nobody else writes."""
    return replace(tree, nodes=replace(tree.nodes, rho=tree.nodes.rho.copy()))


def _own_levels(levels: Levels) -> Levels:
    return replace(levels, home=levels.home.copy(), failed=levels.failed.copy())


def told(**named: Any) -> dict[str, str]:
    """Values by name as text, those of structures by their names; floats to the bit."""
    found: dict[str, str] = {}
    for name, value in named.items():
        if is_dataclass(value):
            inner = told(**{f.name: getattr(value, f.name) for f in fields(value)})
            found |= {f'{name}.{key}': text for key, text in inner.items()}
        else:
            found[name] = repr(value.tolist() if isinstance(value, np.ndarray) else value)
    return found


def _levels(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Levels:
    tolerated = header.get('tolerated')
    if not isinstance(tolerated, float) or not 0 <= tolerated <= 1:
        raise TreeError('tolerated must be a number from 0 to 1')
    shape = (len(arrays['stance']), BINS + 1)
    for name in LEVELS:
        array = arrays[name]
        if array.dtype != np.int32 or array.shape != shape or (array < 0).any():
            raise TreeError(f'{name} must hold counts (int32), shape {shape}')
    return Levels(tolerated, *(arrays[name] for name in LEVELS))


def _numbers(header: Mapping[str, Any]) -> tuple[Counts, int, dict[str, str]]:
    counts, rounds, decided = (header.get(name) for name in ('counts', 'rounds', 'decided'))
    names = {f.name for f in fields(Counts)}
    if not isinstance(counts, dict) or set(counts) != names:
        raise TreeError(f'counts must be {", ".join(sorted(names))}')
    for name, value in (*counts.items(), ('rounds', rounds)):
        if type(value) is not int or not 0 <= value < MOST_STATES:
            raise TreeError(f'{name} must be a whole number, not negative')
    assert isinstance(rounds, int)
    if not isinstance(decided, dict) or not all(isinstance(v, str) for v in decided.values()):
        raise TreeError('decided must be texts by name')
    return Counts(**counts), rounds, decided
