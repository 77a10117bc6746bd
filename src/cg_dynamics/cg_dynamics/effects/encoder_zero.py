"""An encoder whose zero every start sets anew."""

from cg_dynamics.effects.effect import SensorEffect
from cg_dynamics.parameter import Parameter


class EncoderZero(SensorEffect):
    """y = angle + zero, with a zero of each recording's own.

    An incremental encoder calls zero where it was switched on. A leg that hangs there with dry
    friction hangs anywhere within friction / gravity of the vertical.
    """

    name = 'encoder_zero'
    kind = 'encoder'
    summary = (
        'The encoder is zeroed anew at every start, and not quite the same: y = angle + zero; '
        'the zero is found for each recording.'
    )
    contains = ('encoder_offset',)
    parameters = (
        Parameter(
            'zero', 'rad', 'reported minus true angle in a recording', -1.0, 1.0,
            neutral=0.0, starts=(0.005,), scale=0.001, each='recording',
        ),
    )  # fmt: skip

    def read(self, outputs, z, p):
        """Shift the channel."""
        return {**outputs, self.site: outputs[self.site] + p['zero']}, []
