"""The rival without a model: filter the readings, take differences.

    v[k] = (y[k] - y[k-1]) / T                                                        (DIFF)

where y are the lean and the hip angle, as they are or low-passed: by a first-order filter, whose
pole exp(-2 pi f T) is exact for any interval, or by a Chebyshev filter of the first kind and fifth
order. The latter knows one rate only, so gaps are filled by straight lines. With the gyro only the
hip angle is differentiated, as on a robot whose IMU tells the rate of one leg.
"""

import math

import numpy as np
import scipy

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_estimation.estimator import StampedEstimator

FILTERS = ('none', 'first_order', 'chebyshev')
ORDER = 5
RIPPLE_DB = 0.5


class FirstOrder:
    """y += (1 - exp(-2 pi f T)) (x - y)."""

    def __init__(self, cutoff_hz: float, value: np.ndarray):
        self.cutoff_hz, self.value = cutoff_hz, np.array(value, float)

    def step(self, value: np.ndarray, duration: float) -> np.ndarray:
        """Filtered value, shape as the value, `duration` s after the last one."""
        weight = 1.0 - math.exp(-2.0 * math.pi * self.cutoff_hz * duration)
        self.value = self.value + weight * (value - self.value)
        return self.value


class Chebyshev:
    """Chebyshev I of fifth order, settled at the first value."""

    def __init__(self, cutoff_hz: float, value: np.ndarray, sample_time: float):
        self.sample_time = sample_time
        self.sections = scipy.signal.cheby1(
            ORDER, RIPPLE_DB, cutoff_hz, fs=1.0 / sample_time, output='sos'
        )
        self.last = np.array(value, float)
        self.states = np.zeros((len(self.sections), 2, len(self.last)))
        level = self.last
        for section, state in zip(self.sections, self.states, strict=True):
            b0, b1, b2, _, a1, a2 = section
            after = level * (b0 + b1 + b2) / (1.0 + a1 + a2)
            state[1] = b2 * level - a2 * after
            state[0] = after - b0 * level
            level = after

    def step(self, value: np.ndarray, duration: float) -> np.ndarray:
        """Filtered value, shape as the value; gaps are filled by straight lines."""
        n = max(1, round(duration / self.sample_time))
        for i in range(1, n + 1):
            filtered = self._one(self.last + (value - self.last) * i / n)
        self.last = np.array(value, float)
        return filtered

    def _one(self, value: np.ndarray) -> np.ndarray:
        # Direct form II transposed, section by section.
        for section, state in zip(self.sections, self.states, strict=True):
            b0, b1, b2, _, a1, a2 = section
            after = b0 * value + state[0]
            state[0] = b1 * value - a1 * after + state[1]
            state[1] = b2 * value - a2 * after
            value = after
        return value


class Derivative(StampedEstimator):
    """(DIFF).

    Args:
        model: Only names the channels.
        setup: The set-up.
        sample_time: Nominal time between measurements in s.
        kind: Filter of the readings: 'none', 'first_order' or 'chebyshev'.
        cutoff_hz: Its cutoff: -3 dB of the first-order one, end of the ripple of the Chebyshev.
        use_gyro: Whether the rate of the inner legs is that of the IMU, filtered alike.
        longest_gap: Gap in s after which the estimate starts anew.
    """

    def __init__(
        self,
        model: Model,
        setup: Setup | None = None,
        sample_time: float = 0.002,
        kind: str = 'none',
        cutoff_hz: float = 20.0,
        use_gyro: bool = False,
        longest_gap: float = 0.1,
    ):
        if kind not in FILTERS:
            raise ValueError(f'kind is {kind!r}; allowed are {", ".join(FILTERS)}')
        if kind == 'chebyshev' and not 0 < cutoff_hz < 0.5 / sample_time:
            raise ValueError(
                f'cutoff_hz is {cutoff_hz}; allowed is below half the rate, {0.5 / sample_time} Hz'
            )
        super().__init__(model, setup, longest_gap)
        self.state_names = self.state_names[:4]
        self.sample_time, self.kind = sample_time, kind
        self.cutoff_hz, self.use_gyro = cutoff_hz, use_gyro

    def _begin(self, motion: np.ndarray, torque: float) -> None:
        self._x = motion
        reading = {'imu_angle': motion[0], 'hip_angle': motion[0] - motion[1]}
        self._raw = np.array([reading.get(c, motion[2]) for c in self.channels])
        self._smooth = self._raw
        self._filter: FirstOrder | Chebyshev | None = None
        if self.kind == 'first_order':
            self._filter = FirstOrder(self.cutoff_hz, self._raw)
        elif self.kind == 'chebyshev':
            self._filter = Chebyshev(self.cutoff_hz, self._raw, self.sample_time)

    def _predict(self, duration: float, torque: float) -> None:
        """There is no model."""

    def _correct(self, y: np.ndarray, duration: float) -> None:
        last = self._raw
        raw = np.where(np.isnan(y), last, y)
        smooth = raw if self._filter is None else self._filter.step(raw, duration)
        slopes = (smooth - self._smooth) / duration
        self._raw, self._smooth = raw, smooth
        lean, rate, hip = (self.channels.index(c) for c in ('imu_angle', 'imu_rate', 'hip_angle'))
        inner = smooth[rate] if self.use_gyro else slopes[lean]
        self._x = np.array([smooth[lean], smooth[lean] - smooth[hip], inner, inner - slopes[hip]])

    def _land(self, stance: str) -> None:
        # The angles do not jump, and the differences see the new rates by themselves.
        self.stance = stance
