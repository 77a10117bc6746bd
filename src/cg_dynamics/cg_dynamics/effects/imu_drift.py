"""An IMU whose lean angle wanders off."""

from cg_dynamics.effects.effect import TIME, SensorEffect
from cg_dynamics.parameter import Parameter


class ImuDrift(SensorEffect):
    """y = angle + rate time, time from the start of the record."""

    name = 'imu_drift'
    family = ('angle_error', 'time')
    kind = 'inclinometer'
    summary = (
        'The lean angle of the IMU drifts with the time of the record: y = angle + rate time.'
    )
    parameters = (
        Parameter(
            'rate', 'rad/s', 'of the drift', -0.1, 0.1, neutral=0.0, starts=(0.001,), scale=2e-4
        ),
    )  # fmt: skip
    extra_inputs = (TIME,)

    def read(self, outputs, z, p):
        """Shift the channel more and more."""
        return {**outputs, self.site: outputs[self.site] + p['rate'] * p[TIME]}, []
