"""What the steps of the checklist measure, from what was heard. Pure numbers; no ROS."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup
from cg_interfaces.stamps import NS_PER_S

FEWEST = 40  # samples that tell anything
SOME = 10  # periods over which one is taken: a few that come late and are caught up do not matter
ROUGH = 0.05  # rad/s over which dry friction turns round in the fit of an inertia
LEAST_TRAVEL = 0.01  # rad below which friction has held a joint
CLEAR = 5.0  # standard errors that an inertia is from none
SLOPE_S = 0.02  # s over which a rate is taken from the encoder
ZERO = 1e-9  # N m below which a torque is none
# Shares of a small torque, and for how many s each. No net push, and long and short pulses, so
# that inertia, gravity and friction can be told from each other. Then the same the other way.
PULSES = ((1, 0.25), (-1, 0.5), (1, 0.25), (0, 0.3), (1, 0.12), (-1, 0.24), (1, 0.12), (0, 0.3))


@dataclass(frozen=True)
class Series:
    """What came of one channel in a while.

    Attributes:
        stamp_ns: Header stamps in ns, shape (M,).
        received_ns: When each was received, on the host's clock in ns, shape (M,).
        values: In the channel's unit, shape (M,).
    """

    stamp_ns: np.ndarray
    received_ns: np.ndarray
    values: np.ndarray

    def __len__(self) -> int:
        return len(self.stamp_ns)

    @property
    def time(self) -> np.ndarray:
        """Of the stamps, in s since the first of them."""
        return (self.stamp_ns - self.stamp_ns[0]) / NS_PER_S if len(self) else np.empty(0)

    @property
    def span(self) -> float:
        """Time from the first sample to the last, in s."""
        return float(self.stamp_ns[-1] - self.stamp_ns[0]) / NS_PER_S if len(self) else 0.0

    def last(self, seconds: float) -> np.ndarray:
        """Values of the last so many s."""
        if not len(self):
            return self.values
        since = self.stamp_ns[-1] - round(seconds * NS_PER_S)
        return self.values[np.searchsorted(self.stamp_ns, since) :]


class Track:
    """A series that grows: written by one thread, looked at by another."""

    def __init__(self) -> None:
        self._ns = np.empty((1024, 2), np.int64)
        self._values = np.empty(1024)
        self._count = 0

    def add(self, stamp_ns: int, received_ns: int, value: float) -> None:
        """One sample more."""
        at = self._count
        if at == len(self._values):
            self._ns = np.concatenate((self._ns, np.empty_like(self._ns)))
            self._values = np.concatenate((self._values, np.empty_like(self._values)))
        self._ns[at], self._values[at] = (stamp_ns, received_ns), value
        self._count = at + 1

    def series(self) -> Series:
        """What there is by now."""
        count = self._count
        ns = self._ns[:count]
        return Series(ns[:, 0], ns[:, 1], self._values[:count])


Heard = Mapping[str, Series]


def rate_of(series: Series) -> dict[str, float]:
    """Rate in Hz, spread of the periods in ms, share of samples that are missing, age in ms.

    The age is from stamp to receipt, in the median; below zero, stamps are of another clock.
    """
    if len(series) < FEWEST:
        return {'rate_hz': 0.0, 'jitter_ms': math.nan, 'missing': 1.0, 'age_ms': math.nan}
    stamps = np.asarray(series.stamp_ns)
    period = float(np.median(stamps[SOME:] - stamps[:-SOME])) / SOME
    if period <= 0:
        return {'rate_hz': math.inf, 'jitter_ms': math.nan, 'missing': 1.0, 'age_ms': math.nan}
    periods = np.diff(stamps) / period
    return {
        'rate_hz': NS_PER_S / period,
        # Periods that are lost are missing and not uneven.
        'jitter_ms': float(np.std(periods - np.maximum(1.0, np.rint(periods)))) * period / 1e6,
        # What comes late and is caught up is uneven and not missing.
        'missing': max(0.0, 1.0 - len(periods) / float(np.sum(periods))),
        'age_ms': float(np.median(series.received_ns - series.stamp_ns)) / 1e6,
    }


def moved(series: Series) -> float:
    """How far a signal has gone from its beginning, where it was farthest; with its sign."""
    if not len(series):
        return 0.0
    way = series.values - np.median(series.values[: max(1, len(series) // 20)])
    return float(way[np.argmax(np.abs(way))])


def integral(series: Series) -> float:
    """Of a rate, over the time that was heard, less its mean while the legs stood: the drift."""
    if len(series) < FEWEST:
        return 0.0
    still = float(np.median(series.values[: len(series) // 20]))
    way = np.concatenate(([0.0], np.cumsum((series.values[:-1] - still) * np.diff(series.time))))
    return float(way[np.argmax(np.abs(way))])


def until_zero_ms(applied: Series, since_ns: int) -> float:
    """Time in ms from an instant to the torque that was zero and stayed so; infinite if none."""
    acting = np.flatnonzero(np.abs(applied.values) > ZERO)
    if not len(acting):
        return 0.0
    if acting[-1] + 1 >= len(applied):
        return math.inf
    return max(0.0, float(applied.stamp_ns[acting[-1] + 1] - since_ns) / 1e6)


def pulses(torque: float, time: float) -> float:
    """The torque in N m at a time in s of PULSES, there and back; zero before and after."""
    for sign in (1, -1):
        for share, length in PULSES:
            if 0.0 <= time < length:
                return sign * share * torque
            time -= length
    return 0.0


LENGTH = 2 * sum(length for _, length in PULSES)  # s


@dataclass(frozen=True)
class Response:
    """How a joint answers its torque.

    Attributes:
        inverse_inertia: Acceleration in rad/s^2 per N m, with its sign.
        spread: Standard error of it.
        travel: How far the joint went, in rad.
    """

    inverse_inertia: float
    spread: float
    travel: float

    @property
    def clear(self) -> bool:
        """Whether the joint moved, and answered the torque and nothing else."""
        return self.travel > LEAST_TRAVEL and abs(self.inverse_inertia) > CLEAR * self.spread


def response_of(time: np.ndarray, angle: np.ndarray, torque: np.ndarray) -> Response:
    """The joint's acceleration per torque, by least squares.

    I a = u - c sgn(v) - d v - k (q - q0), integrated twice, so that no angle is differentiated:

        q = q1 + v1 t + g t^2 + 1/I (twice the integral of u) - d/I (the integral of q)
            - k/I (twice that of q) - c/I (twice that of sgn v)

    Args:
        time: In s, shape (N,), evenly spaced.
        angle: Of the joint in rad, shape (N,).
        torque: In N m, shape (N,), held from sample to sample.
    """
    step = float(np.median(np.diff(time)))
    q = angle - angle[0]
    reach = max(1, round(0.5 * SLOPE_S / step))
    before, after = np.roll(q, reach), np.roll(q, -reach)
    before[:reach], after[-reach:] = q[0], q[-1]
    sign = np.tanh((after - before) / (2 * reach * step) / ROUGH)
    t = time - time[0]

    def once(x: np.ndarray) -> np.ndarray:
        return np.concatenate(([0.0], np.cumsum(x[:-1]) * step))

    columns = np.column_stack([
        once(once(torque)), np.ones_like(t), t, t**2, once(q), once(once(q)), once(once(sign)),
    ])  # fmt: skip
    scale = np.maximum(np.abs(columns).max(axis=0), 1e-12)
    found, _, rank, _ = np.linalg.lstsq(columns / scale, q, rcond=1e-10)
    rest = q - columns / scale @ found
    covariance = np.linalg.pinv((columns / scale).T @ (columns / scale))
    # Neighbouring residuals are alike: as many count as there are of SLOPE_S.
    count = max(1.0, len(t) * step / SLOPE_S - columns.shape[1])
    spread = math.sqrt(float(rest @ rest) / count * max(covariance[0, 0], 0.0)) / scale[0]
    travel = float(np.ptp(q))
    if rank < columns.shape[1]:
        return Response(0.0, math.inf, travel)
    return Response(float(found[0]) / scale[0], spread, travel)


def expected_response(
    model: Model, setup: Setup, torques: Sequence[float], step: float
) -> Response:
    """The same of the model's hip, moved from rest by the same torques.

    Args:
        model: What the robot is believed to be.
        setup: What is done to it.
        torques: N m at the hip, held for `step` each.
        step: In s.
    """
    plant = Plant(model, setup, sample_time=step)
    angles = np.empty(len(torques))
    for k, torque in enumerate(torques):
        plant.latch(np.array([torque]))
        angles[k] = plant.measure().outputs['hip_angle']
        plant.advance()
    return response_of(step * np.arange(len(torques)), angles, np.asarray(torques, float))
