"""Constant error of a rate gyro."""

from cg_dynamics.effects.effect import SensorEffect
from cg_dynamics.parameter import Parameter


class GyroBias(SensorEffect):
    """y = rate + bias."""

    name = 'gyro_bias'
    kind = 'gyro'
    summary = 'The gyro does not read zero at rest: y = rate + bias.'
    parameters = (
        Parameter(
            'bias', 'rad/s', 'reported minus true rate', -1.0, 1.0,
            neutral=0.0, starts=(0.01,), scale=0.002,
        ),
    )  # fmt: skip

    def read(self, outputs, z, p):
        """Shift the channel."""
        return {**outputs, self.site: outputs[self.site] + p['bias']}, []
