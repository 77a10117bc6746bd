"""Curves: measured and simulated signals record by record, as the report draws them.

They lie beside the result as curves.npz, so that the report can be drawn again without bags,
models or fits.
"""

import io
import os
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rollout.compiled import compile_model
from cg_sysid.checks.faults import FaultSignal, as_arrays, from_arrays
from cg_sysid.identification.data_set import DataSet, sensor_matrix
from cg_sysid.identification.identify import in_data_set

FILE_NAME = 'curves.npz'
FORMAT = 'cg_curves/1'
LARGEST = 1 << 28  # bytes, unpacked


class CurvesError(ValueError):
    """A file of curves that cannot be used."""


@dataclass(frozen=True)
class Curve:
    """One record, measured and simulated.

    Attributes:
        name: Name of the record.
        role: `train`, `held`, or `all` where nothing was held out.
        time: In s from the first row, shape (n,).
        inputs: Held inputs in N m, shape (n, nu).
        measured: Outputs, NaN where there is no sample, shape (n, ny).
        before: Simulated by the model before, shape (n, ny).
        after: Simulated by the model after, shape (n, ny).
        position: Angle that belongs to each output in rad, as simulated after, shape (n, ny).
        rate: Its rate in rad/s, shape (n, ny).
    """

    name: str
    role: str
    time: np.ndarray
    inputs: np.ndarray = field(repr=False)
    measured: np.ndarray = field(repr=False)
    before: np.ndarray = field(repr=False)
    after: np.ndarray = field(repr=False)
    position: np.ndarray = field(repr=False)
    rate: np.ndarray = field(repr=False)


SIGNALS = ('time', 'inputs', 'measured', 'before', 'after', 'position', 'rate')


def make_curve(
    data_set: DataSet,
    role: str,
    before: Model,
    before_motion: np.ndarray,
    after: Model,
    after_motion: np.ndarray,
) -> Curve:
    """Simulate a data set with two models, each from its own fitted initial motion.

    Args:
        data_set: The record.
        role: `train`, `held` or `all`.
        before: The model before.
        before_motion: What the data set has of its own there (Fit.motions).
        after: The model after.
        after_motion: The same for the model after.
    """
    outputs, _ = _simulated(before, data_set, before_motion)
    better, states = _simulated(after, data_set, after_motion)
    matrix = sensor_matrix(after.mechanism, data_set.setup)
    m = matrix.shape[1] // 2
    angle = np.array([row[:m] if np.any(row[:m]) else row[m:] for row in matrix])
    return Curve(
        name=data_set.name,
        role=role,
        time=data_set.time,
        inputs=data_set.inputs,
        measured=data_set.outputs,
        before=outputs,
        after=better,
        position=states[:, :m] @ angle.T,
        rate=states[:, m : 2 * m] @ angle.T,
    )


def _simulated(
    model: Model, data_set: DataSet, motion: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    model, motion = in_data_set(model, motion)
    compiled = compile_model(model, data_set.setup)
    p = parameter_vector(model, data_set.setup)
    u = data_set.inputs_for(compiled.input_names)
    states = compiled.simulate(data_set.time, u, compiled.initial_state(motion, u[0], p), p)
    return compiled.outputs(data_set.time, u, states, p), states


def save(
    curves: Sequence[Curve], directory: str | Path, faults: Sequence[FaultSignal] = ()
) -> Path:
    """Write curves.npz, whole or not at all; plain arrays only."""
    arrays: dict[str, Any] = {
        'format': np.array(FORMAT),
        'names': np.array([c.name for c in curves], dtype=np.str_),
        'roles': np.array([c.role for c in curves], dtype=np.str_),
        **as_arrays(faults),
    }
    for k, curve in enumerate(curves):
        for signal in SIGNALS:
            # Times keep all digits; the rest is for the eye.
            kind = np.float64 if signal == 'time' else np.float32
            arrays[f'{k}/{signal}'] = getattr(curve, signal).astype(kind)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)
    path = Path(directory) / FILE_NAME
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f'.{path.name}.')
    try:
        with os.fdopen(handle, 'wb') as file:
            file.write(buffer.getvalue())
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(temporary, 0o666 & ~umask)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise
    return path


def load(directory: str | Path) -> tuple[list[Curve], list[FaultSignal]]:
    """Read curves.npz; empty lists where there is none.

    Raises:
        CurvesError: The file is not of this format, damaged or too large.
    """
    path = Path(directory) / FILE_NAME
    if not path.is_file():
        return [], []
    try:
        with np.load(path, allow_pickle=False) as arrays:
            _require_size(path, arrays)
            if arrays['format'].tolist() != FORMAT:
                raise CurvesError(f'{path}: not a file of curves: format must be {FORMAT}')
            names, roles = (arrays[key].tolist() for key in ('names', 'roles'))
            found = [
                Curve(str(name), str(role), *(arrays[f'{k}/{signal}'] for signal in SIGNALS))
                for k, (name, role) in enumerate(zip(names, roles, strict=True))
            ]
            faults = from_arrays(arrays)
    except CurvesError:
        raise
    except Exception:  # zipfile, zlib and numpy have their own kinds
        raise CurvesError(f'{path}: not a file of curves, or damaged') from None
    for curve in found:
        _require_rows(path, curve)
    return found, faults


def _require_size(path: Path, arrays: Any) -> None:
    unpacked = sum(member.file_size for member in arrays.zip.infolist())
    if unpacked > LARGEST:
        raise CurvesError(f'{path}: unpacks to {unpacked} bytes; allowed are {LARGEST}')


def _require_rows(path: Path, curve: Curve) -> None:
    """A curve that can be drawn."""
    for signal in SIGNALS:
        array, dimensions = getattr(curve, signal), 1 if signal == 'time' else 2
        if not isinstance(array, np.ndarray):
            raise CurvesError(f'{path}: {curve.name!r}: {signal} is no array')
        if array.dtype.kind != 'f' or array.ndim != dimensions or len(array) != len(curve.time):
            raise CurvesError(
                f'{path}: {curve.name!r}: {signal} must hold numbers, {dimensions}-dimensional, '
                'one row for each time'
            )
