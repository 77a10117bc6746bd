"""Wrong zero of an encoder."""

from cg_dynamics.effects.effect import SensorEffect
from cg_dynamics.parameter import Parameter


class EncoderOffset(SensorEffect):
    """y = angle + offset."""

    name = 'encoder_offset'
    kind = 'encoder'
    summary = 'The encoder was zeroed wrongly: y = angle + offset.'
    parameters = (
        Parameter(
            'offset', 'rad', 'reported minus true angle', -1.0, 1.0,
            neutral=0.0, starts=(0.005,), scale=0.001,
        ),
    )  # fmt: skip

    def read(self, outputs, z, p):
        """Shift the channel."""
        return {**outputs, self.site: outputs[self.site] + p['offset']}, []
