"""Wrong scale of an encoder."""

from cg_dynamics.effects.effect import SensorEffect
from cg_dynamics.parameter import Parameter


class EncoderScale(SensorEffect):
    """y = (1 + error) angle."""

    name = 'encoder_scale'
    kind = 'encoder'
    summary = 'The encoder counts too many or too few steps per turn: y = (1 + error) angle.'
    parameters = (
        Parameter(
            'error', '1', 'relative error of the scale', -0.9, 3.0,
            neutral=0.0, starts=(0.02,), scale=0.005,
        ),
    )  # fmt: skip

    def read(self, outputs, z, p):
        """Scale the channel."""
        return {**outputs, self.site: (1 + p['error']) * outputs[self.site]}, []
