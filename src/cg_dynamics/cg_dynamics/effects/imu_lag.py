"""First-order lag of the IMU."""

from cg_dynamics.effects.effect import ImuEffect
from cg_dynamics.parameter import Parameter

LIVELY = 10.0  # rad/s^2; of a leg of half a metre to a metre that gravity turns


class ImuLag(ImuEffect):
    """T dy/dt = value - y, for lean angle and rate alike."""

    name = 'imu_lag'
    summary = 'The IMU filters its signals: T dy/dt = value - y, for lean angle and rate alike.'
    parameters = (
        Parameter(
            'time_constant', 's', 'T', 0.001, 0.3,
            neutral=0.0, starts=(0.005, 0.03), scale=0.001, logarithmic=True,
        ),
    )  # fmt: skip
    states = ('angle', 'rate')
    # Errors stay in the reading: nothing carries them on.
    state_scales = (30.0, 30.0)
    largest_step = 0.001

    def read(self, outputs, z, p):
        """The filtered signals are the states."""
        filtered = dict(zip(self.channels, z, strict=True))
        rates = [(outputs[c] - y) / p['time_constant'] for c, y in filtered.items()]
        return {**outputs, **filtered}, rates

    def initial_readings(self, outputs, p):
        """Behind by T times the rate, as after a while at that rate."""
        angle, rate = (outputs[channel] for channel in self.channels)
        return [angle - p['time_constant'] * rate, rate]

    def start_spreads(self, p):
        """Behind by what an acceleration of LIVELY makes of rate and angle."""
        return [LIVELY * p['time_constant'] ** 2, LIVELY * p['time_constant']]
