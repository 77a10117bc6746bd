"""Where fits came to, kept in a folder: what was fitted before is not fitted again.

    with kept_in(Path('results/fits')):
        fit(model, data sets)  # a second time it takes no longer than its uncertainty

A file is named by all that decides a fit: model, data sets, options, and this source.
What was broken off, or killed at any instant, goes on from the fits that were finished.
"""

import contextlib
import functools
import hashlib
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

import cg_description
import cg_dynamics
import cg_sysid
from cg_description.model_file import write_atomically
from cg_description.reading import JSON, DocumentError, parse_json, read_text
from cg_dynamics.cluster import source_hash
from cg_dynamics.model import Model
from cg_sysid.identification.data_set import DataSet

_folder: ContextVar[Path | None] = ContextVar('folder of fits', default=None)


@contextlib.contextmanager
def kept_in(folder: Path | None) -> Iterator[None]:
    """Keep the fits of this thread in a folder, and know those that are there; None for none."""
    token = _folder.set(folder)
    try:
        yield
    finally:
        _folder.reset(token)


def keeping(folder: Path | None, function: Callable[..., Any], *arguments: Any) -> Any:
    """function(*arguments), its fits kept in a folder: for other processes."""
    with kept_in(folder):
        return function(*arguments)


def place_of(model: Model, data_sets: Sequence[DataSet], **options: Any) -> Path | None:
    """The file of a fit; None where none is kept.

    Args:
        model: The model to fit.
        data_sets: What to.
        options: Whatever else decides where the fit comes to.
    """
    folder = _folder.get()
    if folder is None:
        return None
    digest = hashlib.sha256(_software().encode())
    digest.update(model.text().encode())
    for data_set in data_sets:
        for field in fields(data_set):
            _add(digest, getattr(data_set, field.name))
    _add(digest, options)
    return folder / f'{digest.hexdigest()[:32]}.json'


@dataclass(frozen=True)
class End:
    """Where a fit came to, before anybody asks how sure that is; as numbers it can be kept.

    Attributes:
        theta: Coordinates of the unknowns, shape (k,).
        motions: What each data set has of its own.
        cost: Final cost.
        sse: Squared error over noise variance of each data set and output, shape (data sets, ny).
        count: Samples behind it.
        weight: Of the residual in the cost.
        converged: Whether it is a minimum.
    """

    theta: np.ndarray
    motions: list[np.ndarray]
    cost: float
    sse: np.ndarray
    count: np.ndarray
    weight: float
    converged: bool

    def numbers(self) -> dict[str, Any]:
        """All of it as lists."""
        return {
            'theta': self.theta.tolist(), 'motions': [m.tolist() for m in self.motions],
            'cost': self.cost, 'sse': self.sse.tolist(), 'count': self.count.tolist(),
            'weight': self.weight, 'converged': self.converged,
        }  # fmt: skip

    @classmethod
    def of(cls, numbers: Mapping[str, Any] | None) -> 'End | None':
        """What `numbers` wrote; None of nothing, or of something else."""
        try:
            return None if numbers is None else cls(
                np.array(numbers['theta'], float),
                [np.array(m, float) for m in numbers['motions']],
                float(numbers['cost']), np.array(numbers['sse'], float),
                np.array(numbers['count'], float), float(numbers['weight']),
                bool(numbers['converged']),
            )  # fmt: skip
        except (KeyError, TypeError, ValueError):
            return None


def recall(place: Path | None) -> End | None:
    """Where a fit came to; None where it is not known, or its file is damaged."""
    if place is None:
        return None
    try:
        end = parse_json(read_text(place, limits=JSON), str(place))
    except DocumentError:
        return None
    return End.of(end) if isinstance(end, dict) else None


def keep(place: Path | None, end: End) -> None:
    """Keep where a fit came to.

    A folder that cannot be written to costs the next run its time, and this one nothing.
    """
    if place is not None:
        with contextlib.suppress(OSError):
            write_atomically(place, json.dumps(end.numbers()))


@functools.cache
def _software() -> str:
    return source_hash(cg_description, cg_dynamics, cg_sysid)


def _add(digest: Any, value: Any) -> None:
    """Put a value into a digest, whatever it is made of."""
    if isinstance(value, np.ndarray):
        digest.update(f'{value.shape} {value.dtype}'.encode())
        digest.update(np.ascontiguousarray(value).data)
    elif isinstance(value, Mapping):
        for key in sorted(value):
            digest.update(f'{key!r}:'.encode())
            _add(digest, value[key])
    elif isinstance(value, list | tuple):
        digest.update(f'{len(value)} of'.encode())
        for item in value:
            _add(digest, item)
    else:
        # Numbers, texts, and set-ups, whose text says all of them.
        digest.update(f'{value!r};'.encode())
