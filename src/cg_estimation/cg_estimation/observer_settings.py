"""Which estimator runs, with which numbers: the parameters of the observer node, without ROS."""

from dataclasses import dataclass

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_estimation.derivative import Derivative
from cg_estimation.estimator import StampedEstimator
from cg_estimation.high_gain import FORMS, HighGainObserver
from cg_estimation.kalman import ExtendedKalmanFilter, SteadyKalmanFilter
from cg_interfaces.settings import Settings, setting

METHODS = (
    'high_gain',
    'extended_kalman',
    'steady_kalman',
    'derivative',
    'first_order',
    'chebyshev',
)


@dataclass(frozen=True)
class ObserverSettings(Settings):
    """Parameters of an estimator."""

    model_file: str = setting(
        '', 'model to observe with, a file or a name; empty for the nominal compass gait'
    )
    method: str = setting('high_gain', 'what estimates the state', choices=METHODS)
    epsilon: float = setting(
        0.2,
        'high_gain: time constant; small trusts the sensors, large the model',
        unit='s',
        minimum=0.001,
        maximum=10.0,
        live=True,
    )
    gain_form: str = setting(
        'symmetric',
        "high_gain: Khalil's gain, or as Eq. 4.17 is printed",
        choices=FORMS,
        live=True,
    )
    use_gyro: bool = setting(False, 'use the rate of the IMU, not its angle alone', live=True)
    disturbance: float = setting(
        20.0, 'Kalman filters: unknown acceleration', unit='rad/s^2', minimum=0.001, maximum=1e5
    )
    cutoff_hz: float = setting(
        10.0, 'first_order, chebyshev: cutoff', unit='Hz', minimum=0.01, maximum=249.0
    )
    sample_rate_hz: float = setting(
        500.0, 'nominal rate of the measurements', unit='Hz', minimum=10.0, maximum=2000.0
    )
    longest_gap: float = setting(
        0.1, 'gap after which the estimate starts anew', unit='s', minimum=0.001, maximum=10.0
    )
    longest_blind: float = setting(
        0.01,
        'time without one of the positions after which nothing is published',
        unit='s',
        minimum=0.0,
        maximum=10.0,
        live=True,
    )


def make_estimator(settings: ObserverSettings, model: Model, setup: Setup) -> StampedEstimator:
    """The estimator that the settings describe."""
    s = settings
    sample_time, gap = 1.0 / s.sample_rate_hz, s.longest_gap
    if s.method == 'high_gain':
        return HighGainObserver(model, setup, s.epsilon, s.gain_form, s.use_gyro, gap)
    if s.method == 'extended_kalman':
        return ExtendedKalmanFilter(model, setup, sample_time, s.disturbance, s.use_gyro, gap)
    if s.method == 'steady_kalman':
        return SteadyKalmanFilter(model, setup, sample_time, s.disturbance, s.use_gyro, gap)
    kind = 'none' if s.method == 'derivative' else s.method
    return Derivative(model, setup, sample_time, kind, s.cutoff_hz, s.use_gyro, gap)


def tune(estimator: StampedEstimator, settings: ObserverSettings) -> None:
    """Give a running estimator the live settings."""
    if isinstance(estimator, HighGainObserver):
        estimator.epsilon, estimator.form = settings.epsilon, settings.gain_form
        estimator.use_gyro = settings.use_gyro
    elif isinstance(estimator, Derivative):
        estimator.use_gyro = settings.use_gyro
