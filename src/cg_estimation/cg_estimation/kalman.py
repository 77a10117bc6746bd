"""Rivals with gains from noise levels: a steady Kalman filter and an extended one.

    x- = F x + ...,   P- = F P F' + W,   K = P- C' (C P- C' + V)^-1,   x = x- + K (y - C x-)   (KF)

V is what the model file says of each sensor: noise and resolution^2/12. W is an angular
acceleration of every leg that nobody knows, of standard deviation `disturbance`, held over a
sample; it is the one number to tune. The steady filter is (KF) of the model linearised upright,
without dry friction, run to its limit: a Luenberger observer whose gain is optimal for that noise.
The extended one predicts with the nonlinear model and takes F along the way.
"""

import functools

import casadi as ca
import numpy as np
from scipy.linalg import expm, solve_discrete_are

from cg_dynamics.linearise import jacobians, linearise, without_dry_friction, without_extra_states
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.compiled import CompiledModel
from cg_dynamics.walking.impact import impact_function
from cg_estimation.estimator import ModelEstimator, StampedEstimator

# A sensor of which the model file says nothing: rad or rad/s.
UNKNOWN_NOISE = 1e-3


def sensor_variances(model: Model, channels: tuple[str, ...]) -> np.ndarray:
    """Variance of each channel's reading, shape (ny,)."""
    variances = []
    for channel in channels:
        sensor = {name: q.value for name, q in model.sensors.get(channel, {}).items()}
        variance = sensor.get('noise', 0.0) ** 2 + sensor.get('resolution', 0.0) ** 2 / 12
        variances.append(variance or UNKNOWN_NOISE**2)
    return np.array(variances)


def disturbance_covariance(nx: int, disturbance: float, sample_time: float) -> np.ndarray:
    """W of (KF) over one sample, shape (nx, nx)."""
    covariance = np.zeros((nx, nx))
    for leg in (0, 1):
        reach = np.zeros(nx)
        reach[leg], reach[2 + leg] = sample_time**2 / 2, sample_time
        covariance += disturbance**2 * np.outer(reach, reach)
    return covariance


class SteadyKalmanFilter(StampedEstimator):
    """(KF) at its limit for the model linearised upright.

    Args:
        model: Linearised without dry friction, states of effects and delays.
        setup: The set-up.
        sample_time: Nominal time between measurements in s, for which the gain is made.
        disturbance: Unknown acceleration in rad/s^2.
        use_gyro: Whether the rate of the IMU is read.
        longest_gap: Gap in s after which the estimate starts anew.
    """

    def __init__(
        self,
        model: Model,
        setup: Setup | None = None,
        sample_time: float = 0.002,
        disturbance: float = 20.0,
        use_gyro: bool = False,
        longest_gap: float = 0.1,
    ):
        model = without_dry_friction(without_extra_states(model))
        super().__init__(model, setup, longest_gap)
        self.sample_time, self.use_gyro = sample_time, use_gyro
        self._linear = {
            stance: linearise(self.model, _standing(self.setup, stance), np.zeros(4), np.zeros(1))
            for stance in STANCES
        }
        V = np.diag(sensor_variances(model, self.channels))
        self._read = [c != 'imu_rate' or use_gyro for c in self.channels]
        V = V[np.ix_(self._read, self._read)]
        W = disturbance_covariance(4, disturbance, sample_time)
        self._gains = {}
        for stance, linear in self._linear.items():
            F, C = expm(linear.A * sample_time), linear.C[self._read]
            P = solve_discrete_are(F.T, C.T, W, V)
            self._gains[stance] = P @ C.T @ np.linalg.inv(C @ P @ C.T + V)
        # Nearly all intervals are equal; the few others are made when they come.
        self._flow = functools.lru_cache(maxsize=64)(self._make_flow)

    def _make_flow(
        self, stance: str, nanoseconds: int
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        linear = self._linear[stance]
        block = np.zeros((6, 6))
        block[:4] = np.column_stack([linear.A, linear.B, linear.rates])
        held = expm(block * nanoseconds * 1e-9)
        return held[:4, :4], held[:4, 4], held[:4, 5]

    def _begin(self, motion: np.ndarray, torque: float) -> None:
        self._x = motion

    def _predict(self, duration: float, torque: float) -> None:
        F, G, c = self._flow(self.stance, round(duration * 1e9))
        self._x = F @ self._x + G * torque + c

    def _correct(self, y: np.ndarray, duration: float) -> None:
        linear = self._linear[self.stance]
        error = (y - linear.outputs - linear.C @ self._x)[self._read]
        self._x = self._x + self._gains[self.stance] @ np.nan_to_num(error, nan=0.0)


class ExtendedKalmanFilter(ModelEstimator):
    """(KF) along the nonlinear model.

    Args:
        model: Model that predicts.
        setup: The set-up.
        sample_time: Time over which the unknown acceleration is held, s.
        disturbance: Unknown acceleration in rad/s^2. May be changed between steps.
        use_gyro: Whether the rate of the IMU is read.
        longest_gap: Gap in s after which the estimate starts anew.
    """

    def __init__(
        self,
        model: Model,
        setup: Setup | None = None,
        sample_time: float = 0.002,
        disturbance: float = 20.0,
        use_gyro: bool = False,
        longest_gap: float = 0.1,
    ):
        super().__init__(model, setup, longest_gap)
        self.sample_time, self.disturbance, self.use_gyro = sample_time, disturbance, use_gyro
        self._V = sensor_variances(model, self.channels)
        self._slopes = {s: _slopes(self.phases[s].compiled) for s in STANCES}
        self._landing = {s: _landing(model, s) for s in STANCES}

    def _begin(self, motion: np.ndarray, torque: float) -> None:
        super()._begin(motion, torque)
        nx = len(self._x)
        self._P = np.zeros((nx, nx))
        # The angles are known as well as they are measured, the rates hardly.
        self._P[[0, 1, 2, 3], [0, 1, 2, 3]] = [1e-6, 1e-6, 1.0, 1.0]

    def _flow(self, u: np.ndarray, duration: float) -> None:
        phase = self.phase
        n = max(1, round(duration / self.sample_time))
        for _ in range(n):
            part = duration / n
            A = np.asarray(self._slopes[self.stance](self._x, u, phase.p)[0])
            F = expm(A * part)
            phase.advance(self._x, u, part)
            W = disturbance_covariance(len(self._x), self.disturbance, self.sample_time)
            self._P = F @ self._P @ F.T + W * (part / self.sample_time)

    def _correct(self, y: np.ndarray, duration: float) -> None:
        phase = self.phase
        C = np.asarray(
            self._slopes[self.stance](self._x, phase.inputs(self._latched, self._now), phase.p)[1]
        )
        error = y - self._readings()
        read = [
            not np.isnan(e) and (c != 'imu_rate' or self.use_gyro)
            for e, c in zip(error, self.channels, strict=True)
        ]
        if any(read):
            C, V = C[read], np.diag(self._V[read])
            K = np.linalg.solve(C @ self._P @ C.T + V, C @ self._P).T
            self._x += K @ error[read]
            # Joseph's form: stays symmetric and positive under rounding.
            rest = np.eye(len(self._x)) - K @ C
            self._P = rest @ self._P @ rest.T + K @ V @ K.T
        self._remember()

    def _land(self, stance: str) -> None:
        before = self._x.copy()
        p = self.phase.p[: len(self.model.declarations)]
        F = np.eye(len(before))
        F[2:4, :4] = np.asarray(self._landing[self.stance](before[:2], before[2:4], p))
        super()._land(stance)
        self._P = F @ self._P @ F.T


def _standing(setup: Setup, stance: str) -> Setup:
    return Setup(stance=stance, springs=setup.springs, on_blocks=setup.on_blocks)


def _slopes(compiled: CompiledModel) -> ca.Function:
    """x, u, p -> A, C."""
    full = jacobians(compiled)
    e = compiled.equations
    A, _, C, *_ = full(e.x, e.u, e.p)
    return ca.Function('slopes', [e.x, e.u, e.p], [ca.densify(A), ca.densify(C)])


def _landing(model: Model, stance: str) -> ca.Function:
    """q, v, p -> d(v_plus)/d(q, v), shape (2, 4)."""
    function = impact_function(model, stance)
    q, v = ca.SX.sym('q', 2), ca.SX.sym('v', 2)
    p = ca.SX.sym('p', function.size1_in(2))
    v_plus = function(q, v, p)[0]
    return ca.Function('landing', [q, v, p], [ca.densify(ca.jacobian(v_plus, ca.vertcat(q, v)))])
