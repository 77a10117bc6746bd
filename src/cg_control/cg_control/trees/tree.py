"""A tree and its file: nodes, the goal regions where the balance controller takes over.

A file is an archive (archive.py) of plain arrays, one a field of `Nodes`, and a header with
format, model hash and provenance. Every index and number is looked at before it is used.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cg_control.following.nodes import ARRAYS, Nodes
from cg_control.following.tracking import WALKING, TrackingSettings
from cg_control.trajectories.trajectory import TrajectoryError
from cg_control.trees.archive import read_archive, write_archive
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES

FORMAT = 'cg_tree/3'
LARGEST_FILE = 1 << 30  # bytes, unpacked
MOST_NODES = 1_000_000
MEMBERS = (*ARRAYS, 'goal', 'champions', 'speeds')
INTEGERS = ('stance', 'next', 'landing', 'branch')


class TreeError(TrajectoryError):
    """A tree that cannot be used; the message says what, where and what is allowed."""


@dataclass(frozen=True)
class Tree:
    """A tree of trajectories, and where they end: upright, or on an orbit of the nodes.

    Attributes:
        nodes: The trajectories.
        goal: Region x' F x <= 1 of each stance leg that counts as home, shape (2, nx, nx), NaN on
            a leg that is no goal: an ellipsoid inside the basin of the balance controller.
        provenance: How it was grown. JSON values.
        champions: Entries that a preview tries whatever the state, of each stance leg, those that
            bring most states home first; -1 where there are no more: shape (2, m).
        speeds: Of its orbits in m/s, in the order of `Nodes.orbit_of`, shape (orbits,).
    """

    nodes: Nodes
    goal: np.ndarray
    provenance: Mapping[str, Any] = field(default_factory=dict)
    champions: np.ndarray = field(default_factory=lambda: np.zeros((len(STANCES), 0), np.int32))
    speeds: np.ndarray = field(default_factory=lambda: np.zeros(0))

    @property
    def law(self) -> TrackingSettings:
        """How it is to be followed: as its funnels and tubes were found.

        What leads to orbits is followed by the surfaces of the orbits, upwards by the clock that
        is set at impacts.
        """
        return WALKING if len(self.speeds) else TrackingSettings()

    @property
    def legs(self) -> tuple[str, ...]:
        """Legs that are a goal."""
        return tuple(leg for leg, form in zip(STANCES, self.goal, strict=True)
                     if np.isfinite(form).all())  # fmt: skip

    def require_model(self, model: Model) -> None:
        """Refuse a model that the tree was not grown for.

        Raises:
            TreeError: naming both hashes.
        """
        if model.hash != self.nodes.model_hash:
            raise TreeError(
                f'the tree was grown for a model with hash {self.nodes.model_hash[:12]}, but '
                f'{model.name!r} has {model.hash[:12]}; grow one for this model'
            )

    def save(self, path: str | Path) -> None:
        """Write the file, whole or not at all."""
        write_archive(path, {'format': FORMAT, **self.header()}, self.arrays())

    def header(self) -> dict[str, Any]:
        """What is no array, as JSON values."""
        return {
            'model_hash': self.nodes.model_hash,
            'compensate': self.nodes.compensate,
            'provenance': dict(self.provenance),
        }

    def arrays(self) -> dict[str, np.ndarray]:
        """The arrays of the nodes and its own, by name."""
        own = {'goal': self.goal, 'champions': self.champions, 'speeds': self.speeds}
        return {name: getattr(self.nodes, name) for name in ARRAYS} | own

    @classmethod
    def load(cls, path: str | Path, model: Model | None = None) -> 'Tree':
        """Read a file.

        Args:
            path: The file.
            model: The robot it is meant for; None: any.

        Raises:
            TreeError: for a file that is none, a damaged one, or one of another model.
        """
        try:
            tree = cls.of(*read_archive(path, MEMBERS, FORMAT, 'a tree', LARGEST_FILE, TreeError))
            if model is not None:
                tree.require_model(model)
        except TreeError as error:
            raise TreeError(f'{path}: {error}') from None
        return tree

    @classmethod
    def of(cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> 'Tree':
        """The tree of what `header` and `arrays` gave, or of what somebody else wrote.

        Raises:
            TreeError: It is no tree.
        """
        _require_kinds(header, arrays)
        n, nx = len(arrays['stance']), arrays['x0'].shape[-1]
        if not 1 <= n <= MOST_NODES:
            raise TreeError(f'{n} nodes; allowed are 1 to {MOST_NODES}')
        if arrays['goal'].shape != (len(STANCES), nx, nx):
            raise TreeError(f'goal has shape {arrays["goal"].shape}, expected (2, {nx}, {nx})')
        nodes = Nodes(
            **{k: arrays[k].astype(np.int32) if k in INTEGERS else arrays[k] for k in ARRAYS},
            model_hash=header['model_hash'],
            compensate=bool(header['compensate']),
        )
        try:
            nodes.require_consistency()
        except TrajectoryError as error:
            raise TreeError(str(error)) from None
        astray = nodes.orbiting & (nodes.branch > 0)
        if astray.any():
            raise TreeError(f'node {np.argmax(astray)} leads round and round, and never home')
        _require_goal(arrays['goal'], nodes)
        homes = nodes.stance[nodes.planned < 0]
        if np.isnan(arrays['goal'][homes]).any():
            raise TreeError('a root stands on a leg that is no goal')
        _require_champions(arrays['champions'], nodes)
        orbits = int(nodes.orbit_of.max()) + 1
        if arrays['speeds'].shape != (orbits,) or not np.isfinite(arrays['speeds']).all():
            raise TreeError(f'speeds must be {orbits} finite numbers, one for each orbit')
        return cls(
            nodes, arrays['goal'], header.get('provenance') or {}, arrays['champions'],
            arrays['speeds'],
        )  # fmt: skip


def _require_kinds(header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
    """Refuse a header that lacks something, and arrays of another kind."""
    if not isinstance(header.get('model_hash'), str) or 'compensate' not in header:
        raise TreeError('header lacks model_hash or compensate')
    for name in MEMBERS:
        kind = arrays[name].dtype.kind
        allowed = 'i' if name in (*INTEGERS, 'champions') else 'b' if name == 'late' else 'f'
        if kind != allowed or arrays[name].ndim == 0:
            raise TreeError(f'{name} holds {arrays[name].dtype}, expected kind {allowed!r}')


def _require_goal(goal: np.ndarray, nodes: Nodes) -> None:
    """Refuse goal regions that are none."""
    for form in goal:
        if np.isnan(form).all():
            continue
        if not _is_positive(form):
            raise TreeError('goal must be positive definite on a leg, or NaN')
    if np.isnan(goal).all() and not nodes.orbiting.any():
        raise TreeError('goal must be positive definite on one leg at least, without an orbit')


def _is_positive(form: np.ndarray) -> bool:
    """Whether a form is positive definite; numbers near the largest ones need not be."""
    if not np.isfinite(form).all():
        return False
    half = 0.5 * form
    try:
        return bool(np.linalg.eigvalsh(half + half.T).min() > 0)
    except np.linalg.LinAlgError:
        return False


def _require_champions(champions: np.ndarray, nodes: Nodes) -> None:
    """Refuse entries that are none."""
    if champions.ndim != 2 or len(champions) != len(STANCES):
        raise TreeError(f'champions has shape {champions.shape}, expected (2, m)')
    for leg, row in zip(range(len(STANCES)), champions, strict=True):
        named = row[row >= 0]
        if (row < -1).any() or (row >= len(nodes)).any():
            raise TreeError(f'champions must be -1 to {len(nodes) - 1}')
        if (nodes.stance[named] != leg).any() or not np.isin(named, nodes.entries).all():
            raise TreeError(f'champions of the {STANCES[leg]} leg must be entries on that leg')
