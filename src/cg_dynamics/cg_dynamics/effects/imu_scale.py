"""Wrong scale of the IMU's lean angle."""

from cg_dynamics.effects.effect import SensorEffect
from cg_dynamics.parameter import Parameter


class ImuScale(SensorEffect):
    """y = (1 + error) angle."""

    name = 'imu_scale'
    kind = 'inclinometer'
    summary = 'The IMU reports too much or too little lean: y = (1 + error) angle.'
    parameters = (
        Parameter(
            'error', '1', 'relative error of the scale', -0.9, 3.0,
            neutral=0.0, starts=(0.02,), scale=0.005,
        ),
    )  # fmt: skip

    def read(self, outputs, z, p):
        """Scale the channel."""
        return {**outputs, self.site: (1 + p['error']) * outputs[self.site]}, []
