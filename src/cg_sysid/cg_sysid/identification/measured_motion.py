"""Position, rate and acceleration of measured joints, by local polynomials.

Torques are averaged with the weights with which such an acceleration averages the true one, so
that both sides of an equation of motion have seen the same: of a constant inertia it is exact,
however fast it moves.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.identification.along_motion import Samples
from cg_sysid.identification.data_set import DataSet

HALF_WIDTH_S = 0.06  # of the window of a local polynomial: motions up to some 5 Hz
MOVING_S = 0.01  # half width of the window of the motion that moves a rotor
LEAST_HALF_WIDTH = 3  # samples
DEGREE = 4  # of the polynomial
STRIDE_S = 0.04  # between rows: windows that share less than half of their samples


@dataclass(frozen=True)
class Motion:
    """What was measured of one data set, at rows STRIDE_S apart.

    Attributes:
        position: Free coordinates, shape (k, m).
        rate: Shape (k, m).
        acceleration: Shape (k, m).
        inputs: Averages, shape (k, nu).
        first: Rows with which a record begins, shape (k,).
        setup: The set-up.
        records: All samples, record by record.
    """

    position: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray
    inputs: np.ndarray
    first: np.ndarray
    setup: Setup
    records: tuple[Samples, ...] = ()


def motion_of(
    model: Model,
    data_set: DataSet,
    names: Sequence[str],
    shorter: float = 1.0,
    longest: float = np.inf,
) -> Motion | None:
    """The measured motion of a data set; None where it is too short or samples are missing.

    Args:
        model: Its mechanism counts.
        data_set: The record.
        names: Inputs wanted.
        shorter: Times the usual windows.
        longest: Only so much of the record, s.
    """
    body = model.mechanism
    kinematics = body.kinematics(data_set.setup)
    basis = np.asarray(kinematics.basis)
    offset = np.broadcast_to(np.asarray(kinematics.offset).ravel(), (len(basis),))
    count = len(body.coordinates)
    seen = data_set.outputs[:, :count]
    spacing = float(np.median(np.diff(data_set.time)))
    half = max(LEAST_HALF_WIDTH, round(shorter * HALF_WIDTH_S / spacing))
    grid = np.arange(0.0, min(data_set.duration, longest), spacing)
    if len(grid) <= 2 * half + 1:
        return None
    place, rate, acceleration = (_weights(half, spacing, order) for order in range(3))
    held = _held(half, spacing)
    stride = max(1, round(shorter * STRIDE_S / spacing))
    free = np.linalg.pinv(basis)
    angles = []
    for channel in seen.T:
        there = np.isfinite(channel)
        if there.sum() <= 2 * half + 1:
            return None
        angles.append(np.interp(grid, data_set.time[there], channel[there]))
    s = (np.column_stack(angles) - offset) @ free.T
    row = np.clip(np.searchsorted(data_set.time, grid, side='right') - 1, 0, None)
    inputs = data_set.inputs_for(names)[row]

    def over(values: np.ndarray, weights: np.ndarray) -> np.ndarray:
        columns = [np.correlate(column, weights, 'valid')[::stride] for column in values.T]
        return np.column_stack(columns)

    position = over(s, place)
    return Motion(
        position, over(s, rate), over(s, acceleration), over(inputs, held),
        np.arange(len(position)) == 0, data_set.setup,
        (_samples(s, inputs, spacing, held, stride),),
    )  # fmt: skip


def _samples(
    s: np.ndarray, inputs: np.ndarray, spacing: float, weights: np.ndarray, stride: int
) -> Samples:
    """All samples of a motion, smoothed as little as its rates allow."""
    half = max(LEAST_HALF_WIDTH, round(MOVING_S / spacing))

    def along(order: int) -> np.ndarray:
        own = _weights(half, spacing, order)
        columns = [np.correlate(column, own, 'valid') for column in s.T]
        return np.pad(np.column_stack(columns), ((half, half), (0, 0)), 'edge')

    return Samples(along(0), along(1), inputs, spacing, weights, stride)


@functools.cache
def _weights(half: int, spacing: float, order: int) -> np.ndarray:
    """Weights of samples that give a derivative at the middle of a local polynomial."""
    t = np.arange(-half, half + 1) * spacing
    design = np.vander(t / t[-1], DEGREE + 1, increasing=True)
    factor = (1.0, 1.0, 2.0)[order] / t[-1] ** order
    return factor * np.linalg.pinv(design)[order]


@functools.cache
def _held(half: int, spacing: float) -> np.ndarray:
    """Weights of what is held from each sample to the next, beside an acceleration of `_weights`.

    That is a sum of second differences, with other weights: those are its weights summed twice. A
    second difference of positions is an average of the acceleration over two intervals, to which
    each of them contributes one half.
    """
    summed = np.cumsum(np.cumsum(_weights(half, spacing, 2))) * spacing**2
    of_differences = np.concatenate([[0.0], summed[:-1], [0.0]])
    return (of_differences[:-1] + of_differences[1:]) / 2


def noise_gains(spacing: float) -> tuple[float, float, float]:
    """Noise of position, rate and acceleration over that of a sample, 1, 1/s and 1/s^2."""
    half = max(LEAST_HALF_WIDTH, round(HALF_WIDTH_S / spacing))
    place, rate, acceleration = (
        float(np.linalg.norm(_weights(half, spacing, order))) for order in range(3)
    )
    return place, rate, acceleration
