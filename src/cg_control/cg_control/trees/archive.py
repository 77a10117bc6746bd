"""Arrays and a header in one file, read with care: what trees and their checkpoints are kept in.

A file is a zip archive of plain arrays (numpy's .npz, no pickle) and one text, the header, in
JSON. Sizes are looked at before anything is unpacked: of the members before they are read, and of
the array that each of them declares before there is room made for it.
"""

import io
import json
import math
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cg_description.model_file import write_atomically
from cg_description.reading import parse_json

HEADER = 'header'


def write_archive(
    path: str | Path, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]
) -> None:
    """Write a file, whole or not at all.

    Args:
        path: The file.
        header: JSON values, among them `format`.
        arrays: By name.
    """
    text = np.frombuffer(json.dumps(header, allow_nan=False).encode(), np.uint8)
    file, members = io.BytesIO(), {**arrays, HEADER: text}
    np.savez_compressed(file, **members)  # type: ignore[arg-type]
    write_atomically(path, file.getvalue())


def read_archive(
    path: str | Path,
    names: Iterable[str],
    form: str,
    what: str,
    largest: int,
    error: type[Exception],
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Header and arrays of a file.

    Args:
        path: The file.
        names: Of the arrays; others are left alone.
        form: Expected `format`.
        what: Such as 'a tree', for messages.
        largest: Bytes that may be unpacked.
        error: Kind of the error to raise.

    Raises:
        error: It cannot be read, is none of these files, too large, or damaged.
    """
    members = _unpacked(Path(path), (HEADER, *names), what, largest, error)
    try:
        text = members.pop(HEADER).tobytes().decode()
    except UnicodeDecodeError:
        raise error(f'{HEADER} is not UTF-8') from None
    header = parse_json(text, HEADER, error)
    if not isinstance(header, dict) or header.get('format') != form:
        raise error(f'not {what}: format must be {form!r}')
    return header, members


def _unpacked(
    path: Path, names: tuple[str, ...], what: str, largest: int, error: type[Exception]
) -> dict[str, np.ndarray]:
    """The arrays of a file, each of them plain, none of them too large."""
    place = 'the archive'
    try:
        with zipfile.ZipFile(path) as archive:
            members = {info.filename: info for info in archive.infolist()}
            missing = [name for name in names if f'{name}.npy' not in members]
            if missing:
                raise error(f'not {what}: {", ".join(missing)} is missing')
            size = sum(members[f'{name}.npy'].file_size for name in names)
            if size > largest:
                raise error(f'{size} bytes unpacked; allowed are {largest}')
            found = {}
            for name in names:
                place = name
                found[name] = _array(archive.read(f'{name}.npy'))
            return found
    except OSError as problem:
        raise error(problem.strerror or 'cannot be read') from None
    except error:
        raise
    except TooLarge as problem:
        raise error(f'not {what}, or damaged: {place} is {problem}') from None
    # Whatever a damaged archive makes zipfile, zlib or numpy raise.
    except Exception:
        raise error(f'not {what}, or damaged: {place} is none that can be read') from None


class TooLarge(ValueError):
    """An array that declares more than it holds."""


def _array(content: bytes) -> np.ndarray:
    """An array in numpy's format, of the size that it declares."""
    file = io.BytesIO(content)
    version = np.lib.format.read_magic(file)
    form = np.lib.format
    read = {(1, 0): form.read_array_header_1_0, (2, 0): form.read_array_header_2_0}
    shape, _, dtype = read[version](file)
    if math.prod(shape) * dtype.itemsize > len(content):
        raise TooLarge(f'an array of shape {shape} in {len(content)} bytes')
    file.seek(0)
    return np.lib.format.read_array(file, allow_pickle=False)
