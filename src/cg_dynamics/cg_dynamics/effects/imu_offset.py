"""Wrong zero of the IMU's lean angle."""

from cg_dynamics.effects.effect import SensorEffect
from cg_dynamics.parameter import Parameter


class ImuOffset(SensorEffect):
    """y = angle + offset."""

    name = 'imu_offset'
    kind = 'inclinometer'
    summary = 'The IMU is mounted or zeroed askew: y = angle + offset.'
    parameters = (
        Parameter(
            'offset', 'rad', 'reported minus true angle', -0.5, 0.5,
            neutral=0.0, starts=(0.005,), scale=0.001,
        ),
    )  # fmt: skip

    def read(self, outputs, z, p):
        """Shift the channel."""
        return {**outputs, self.site: outputs[self.site] + p['offset']}, []
