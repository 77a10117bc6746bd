"""Wrong scale of a rate gyro."""

from cg_dynamics.effects.effect import SensorEffect
from cg_dynamics.parameter import Parameter


class GyroScale(SensorEffect):
    """y = (1 + error) rate."""

    name = 'gyro_scale'
    kind = 'gyro'
    summary = 'The gyro reports too much or too little rate: y = (1 + error) rate.'
    parameters = (
        Parameter(
            'error', '1', 'relative error of the scale', -0.9, 3.0,
            neutral=0.0, starts=(0.02,), scale=0.005,
        ),
    )  # fmt: skip

    def read(self, outputs, z, p):
        """Scale the channel."""
        return {**outputs, self.site: (1 + p['error']) * outputs[self.site]}, []
