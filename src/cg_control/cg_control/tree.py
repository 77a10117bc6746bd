"""A grown tree and its file: nodes, the goal regions where the balance controller takes over.

A file is a zip archive of plain arrays (numpy's .npz, no pickle), one a field of `Nodes`, and one
text with format, model hash and provenance. It is read with care: size and shape of every array
are looked at before it is unpacked, every index and number before it is used.
"""

import io
import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cg_control.nodes import ARRAYS, Nodes
from cg_control.trajectory import TrajectoryError
from cg_description.model_file import write_atomically
from cg_description.reading import parse_json
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES

FORMAT = 'cg_tree/1'
LARGEST_FILE = 1 << 30  # bytes, unpacked
MOST_NODES = 1_000_000
HEADER = 'header'
INTEGERS = ('stance', 'next', 'landing', 'branch')


class TreeError(TrajectoryError):
    """A tree that cannot be used; the message says what, where and what is allowed."""


@dataclass(frozen=True)
class Tree:
    """A tree of trajectories, and where they end.

    Attributes:
        nodes: The trajectories.
        goal: Region x' F x <= 1 of each stance leg that counts as home, shape (2, nx, nx), NaN on
            a leg that is no goal: an ellipsoid inside the basin of the balance controller.
        provenance: How it was grown. JSON values.
    """

    nodes: Nodes
    goal: np.ndarray
    provenance: Mapping[str, Any] = field(default_factory=dict)

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
        header = {
            'format': FORMAT,
            'model_hash': self.nodes.model_hash,
            'compensate': self.nodes.compensate,
            'provenance': dict(self.provenance),
        }
        text = np.frombuffer(json.dumps(header, allow_nan=False).encode(), np.uint8)
        arrays: dict[str, Any] = {name: getattr(self.nodes, name) for name in ARRAYS}
        file = io.BytesIO()
        np.savez_compressed(file, **(arrays | {HEADER: text, 'goal': self.goal}))
        write_atomically(path, file.getvalue())

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
            arrays = _unpacked(Path(path))
            tree = cls._from_arrays(arrays)
            if model is not None:
                tree.require_model(model)
        except TreeError as error:
            raise TreeError(f'{path}: {error}') from None
        return tree

    @classmethod
    def _from_arrays(cls, arrays: dict[str, np.ndarray]) -> 'Tree':
        header = _header(arrays)
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
        _require_goal(arrays['goal'])
        homes = nodes.stance[nodes.planned < 0]
        if np.isnan(arrays['goal'][homes]).any():
            raise TreeError('a root stands on a leg that is no goal')
        if np.isnan(nodes.to_go).any():
            node = int(np.flatnonzero(np.isnan(nodes.to_go))[0])
            raise TreeError(f'node {node} leads round and round, and never home')
        return cls(nodes, arrays['goal'], header.get('provenance') or {})


def _unpacked(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a file, each of them plain, none of them too large."""
    names = (HEADER, *ARRAYS, 'goal')
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename: info for info in archive.infolist()}
            missing = [name for name in names if f'{name}.npy' not in members]
            if missing:
                raise TreeError(f'not a tree: {", ".join(missing)} is missing')
            size = sum(members[f'{name}.npy'].file_size for name in names)
            if size > LARGEST_FILE:
                raise TreeError(f'{size} bytes unpacked; allowed are {LARGEST_FILE}')
            return {
                name: np.lib.format.read_array(
                    io.BytesIO(archive.read(f'{name}.npy')), allow_pickle=False
                )
                for name in names
            }
    except OSError as error:
        raise TreeError(error.strerror or str(error)) from None
    except TreeError:
        raise
    # Whatever a damaged archive makes zipfile, zlib or numpy raise.
    except Exception as error:
        raise TreeError(f'not a tree, or damaged: {error}') from None


def _header(arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    try:
        text = arrays[HEADER].tobytes().decode()
    except UnicodeDecodeError:
        raise TreeError('header is not UTF-8') from None
    header = parse_json(text, HEADER, TreeError)
    if not isinstance(header, dict) or header.get('format') != FORMAT:
        raise TreeError(f'not a tree: format must be {FORMAT!r}')
    if not isinstance(header.get('model_hash'), str) or 'compensate' not in header:
        raise TreeError('header lacks model_hash or compensate')
    for name in (*ARRAYS, 'goal'):
        kind = arrays[name].dtype.kind
        allowed = 'i' if name in INTEGERS else 'b' if name == 'late' else 'f'
        if kind != allowed or arrays[name].ndim == 0:
            raise TreeError(f'{name} holds {arrays[name].dtype}, expected kind {allowed!r}')
    return header


def _require_goal(goal: np.ndarray) -> None:
    """Refuse goal regions that are none."""
    for form in goal:
        if np.isnan(form).all():
            continue
        if not np.isfinite(form).all() or np.linalg.eigvalsh((form + form.T) / 2).min() <= 0:
            raise TreeError('goal must be positive definite on a leg, or NaN')
    if np.isnan(goal).all():
        raise TreeError('goal must be positive definite on one leg at least')
