"""Position, rate and acceleration of measured joints, by local polynomials.

Torques are averaged with the weights with which such an acceleration averages the true one, so
that both sides of an equation of motion have seen the same: of a constant inertia it is exact,
however fast it moves. That is why a window may be as long as the noise of the encoders asks.
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
LONGER = 2.0  # times that at most, where encoders are coarse: motions up to some 2.5 Hz
NOISY = 0.02  # of what a joint accelerates: more noise than that asks for longer windows
MOVING_S = 0.01  # half width of the window of the motion that moves a rotor
LEAST_HALF_WIDTH = 3  # samples
DEGREE = 4  # of the polynomial
STRIDE = 2 / 3  # of half a width, from one window to the next: they share two thirds of it


@dataclass(frozen=True)
class Motion:
    """What was measured of one data set, in windows that overlap.

    Attributes:
        position: Free coordinates, shape (k, m).
        rate: Shape (k, m).
        acceleration: Shape (k, m).
        inputs: Averages, shape (k, nu).
        first: Rows with which a record begins, shape (k,).
        stride: From one row of its record to the next, s, shape (k,).
        spread: Noise of position, rate and acceleration that the encoders make, shape (k, 3 m).
        setup: The set-up.
        records: All samples, record by record.
    """

    position: np.ndarray
    rate: np.ndarray
    acceleration: np.ndarray
    inputs: np.ndarray
    first: np.ndarray
    stride: np.ndarray
    spread: np.ndarray
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
        shorter: Times the usual windows; with 1 they are as long as the noise asks.
        longest: Only so much of the record, s.
    """
    body = model.mechanism
    kinematics = body.kinematics(data_set.setup)
    basis = np.asarray(kinematics.basis)
    offset = np.broadcast_to(np.asarray(kinematics.offset).ravel(), (len(basis),))
    count = len(body.coordinates)
    seen = data_set.outputs[:, :count]
    spacing = float(np.median(np.diff(data_set.time)))
    grid = np.arange(0.0, min(data_set.duration, longest), spacing)
    half = _half(shorter * HALF_WIDTH_S, spacing)
    free = np.linalg.pinv(basis)
    angles = []
    for channel in seen.T:
        there = np.isfinite(channel)
        if min(there.sum(), len(grid)) <= 2 * half + 1:
            return None
        angles.append(np.interp(grid, data_set.time[there], channel[there]))
    s = (np.column_stack(angles) - offset) @ free.T
    sigma = np.sqrt(free**2 @ data_set.sigma[:count] ** 2)
    if shorter == 1.0:
        half = _as_noise_asks(half, s, sigma, spacing)
    weights = [_weights(half, spacing, order) for order in range(3)]
    held = _held(half, spacing)
    stride = max(1, round(STRIDE * half))
    row = np.clip(np.searchsorted(data_set.time, grid, side='right') - 1, 0, None)
    inputs = data_set.inputs_for(names)[row]

    def over(values: np.ndarray, own: np.ndarray) -> np.ndarray:
        return np.column_stack([np.correlate(c, own, 'valid')[::stride] for c in values.T])

    position, rate, acceleration = (over(s, own) for own in weights)
    k = len(position)
    spread = np.concatenate([np.linalg.norm(own) * sigma for own in weights])
    return Motion(
        position, rate, acceleration, over(inputs, held), np.arange(k) == 0,
        np.full(k, stride * spacing), np.tile(spread, (k, 1)), data_set.setup,
        (_samples(s, inputs, spacing, held, stride),),
    )  # fmt: skip


def together(motions: Sequence[Motion]) -> Motion:
    """Motions of one set-up, one after the other."""
    rows = ('position', 'rate', 'acceleration', 'inputs', 'first', 'stride', 'spread')
    joined = {name: np.concatenate([getattr(m, name) for m in motions]) for name in rows}
    records = tuple(samples for motion in motions for samples in motion.records)
    return Motion(**joined, setup=motions[0].setup, records=records)


def _half(seconds: float, spacing: float) -> int:
    return max(LEAST_HALF_WIDTH, round(seconds / spacing))


def _as_noise_asks(half: int, s: np.ndarray, sigma: np.ndarray, spacing: float) -> int:
    """Half a width, samples, with which noise is a small share of what the joints accelerate.

    The noise of an acceleration falls with the power 5/2 of the width. A joint that stands still
    does not count.

    Args:
        half: The usual one.
        s: Free coordinates of all samples, shape (samples, m).
        sigma: Noise of a sample, shape (m,).
        spacing: Of the samples, s.
    """
    own = _weights(half, spacing, 2)
    noise = np.linalg.norm(own) * sigma
    squares = np.mean([np.correlate(column, own, 'valid') ** 2 for column in s.T], axis=1)
    true = squares - noise**2
    moves = true > noise**2
    if not moves.any():
        return half
    share = float(np.max(noise[moves] / np.sqrt(true[moves])))
    longer = float(np.clip((share / NOISY) ** 0.4, 1.0, LONGER))
    most = max(half, (len(s) - 1) // 4)  # of a short record two windows are left
    return min(round(longer * half), most)


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
