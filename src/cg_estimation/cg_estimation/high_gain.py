"""Discrete full-order high-gain observer with the nonlinear model, Eq. 4.14 to 4.17.

The model with its friction predicts, the angles of both legs correct:

    x- = x[k-1] + int f(x, u) dt,   e = y[k] - C x-,   x[k] = x- + L(T) e              (OBS)

Eq. 4.16 is the same recursion with one Euler step for the integral and T L for L(T). Khalil's
gain, L = (2/eps, 1/eps^2) for each leg, puts both poles of its error at -1/eps; as printed, Eq.
4.17 has 2/eps^2 in its last row, which puts those of the stance leg at (-1 +- i)/eps. L(T) puts
the sampled poles where these go in the time T since the last sample, z = exp(pole T):

    l1 = 1 - |z|^2,   l2 = |1 - z|^2 / T                                               (GAIN)

so for T << eps it is T L, and it stays stable for every T and eps, across gaps too. With the gyro
the rate of the inner leg is corrected by (1 - exp(-T/eps)) times its error as well.

At the start nothing is known but the first readings, so eps grows to its value as a third of the
time since then: the error then dies out as t^-2.5, about as in a fit of a line to all readings so
far, where a fixed large eps would need several eps.
"""

import cmath
import math

import numpy as np

from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_estimation.estimator import ModelEstimator

FORMS = ('symmetric', 'printed')
START = 0.005  # s, smallest eps at the start
MEMORY = 3.0  # time since the start over eps while it grows


def sampled_gain(pole: complex, epsilon: float, duration: float) -> tuple[float, float]:
    """(GAIN): weights of an angle error on angle (1) and rate (1/s).

    Args:
        pole: Pole of the continuous error times epsilon; its conjugate is the other one.
        epsilon: Time constant in s.
        duration: T in s.
    """
    z = cmath.exp(pole * duration / epsilon)
    return 1.0 - abs(z) ** 2, abs(1.0 - z) ** 2 / duration


class HighGainObserver(ModelEstimator):
    """(OBS).

    Args:
        model: Model that predicts; extra states of effects run along uncorrected.
        setup: The set-up.
        epsilon: Time constant in s: small trusts the sensors, large the model. May be changed
            between steps.
        form: 'symmetric' for Khalil's gain, 'printed' for that of Eq. 4.17.
        use_gyro: Whether the rate of the IMU corrects too.
        longest_gap: Gap in s after which the estimate starts anew.
    """

    def __init__(
        self,
        model: Model,
        setup: Setup | None = None,
        epsilon: float = 0.02,
        form: str = 'symmetric',
        use_gyro: bool = False,
        longest_gap: float = 0.1,
    ):
        if form not in FORMS:
            raise ValueError(f'form is {form!r}; allowed are {", ".join(FORMS)}')
        super().__init__(model, setup, longest_gap)
        self.epsilon, self.form, self.use_gyro = epsilon, form, use_gyro
        self._column = {channel: i for i, channel in enumerate(self.channels)}
        self._late: dict[str, float] = {}

    def _begin(self, motion: np.ndarray, torque: float) -> None:
        super()._begin(motion, torque)
        self._late = dict.fromkeys(self.channels, 0.0)

    def _correct(self, y: np.ndarray, duration: float) -> None:
        epsilon = min(self.epsilon, max(START, self._now / MEMORY))
        error = y - self._readings()
        lean, rate, hip = (
            float(error[self._column[c]]) for c in ('imu_angle', 'imu_rate', 'hip_angle')
        )
        # A channel that was silent is weighed for all the time since it last spoke.
        since = {channel: late + duration for channel, late in self._late.items()}
        spoke = {c: not math.isnan(error[i]) for c, i in self._column.items()}
        # An absent reading is taken to be as expected: the other one still tells about its leg.
        legs = (
            (0, lean if spoke['imu_angle'] else 0.0, since['imu_angle'], spoke['imu_angle']),
            (
                1,
                (lean if spoke['imu_angle'] else 0.0) - (hip if spoke['hip_angle'] else 0.0),
                since['hip_angle'] if spoke['hip_angle'] else since['imu_angle'],
                spoke['imu_angle'] or spoke['hip_angle'],
            ),
        )
        for leg, angle_error, time, told in legs:
            if told:
                l1, l2 = sampled_gain(self._pole(leg), epsilon, time)
                self._x[leg] += l1 * angle_error
                self._x[2 + leg] += l2 * angle_error
        if self.use_gyro and spoke['imu_rate']:
            # The position's correction has moved the rate; what is left of its error counts.
            moved = self._x[2] - self._rate_before
            weight = 1.0 - math.exp(-since['imu_rate'] / epsilon)
            self._x[2] += weight * (rate - moved)
        self._late = {c: 0.0 if spoke[c] else since[c] for c in since}
        self._remember()

    def _readings(self) -> np.ndarray:
        self._rate_before = self._x[2]
        return super()._readings()

    def _pole(self, leg: int) -> complex:
        printed = self.form == 'printed' and STANCES[leg] == self.stance
        return -1.0 + 1.0j if printed else -1.0 + 0.0j
