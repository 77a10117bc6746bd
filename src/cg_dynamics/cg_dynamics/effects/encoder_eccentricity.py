"""An encoder disc that is mounted off centre."""

import casadi as ca

from cg_dynamics.effects.effect import SensorEffect
from cg_dynamics.parameter import Parameter


class EncoderEccentricity(SensorEffect):
    """y = angle + amplitude sin(angle + phase)."""

    name = 'encoder_eccentricity'
    family = ('angle_error', 'angle')
    kind = 'encoder'
    summary = (
        'The disc of the encoder is off centre, an error that repeats once per revolution: '
        'y = angle + amplitude sin(angle + phase).'
    )
    wave = ('amplitude', 'phase')
    parameters = (
        Parameter(
            'amplitude', 'rad', 'of the error', -0.5, 0.5,
            neutral=0.0, starts=(0.005,), scale=0.001,
        ),
        Parameter(
            'phase', 'rad', 'of the error at angle 0', -9.5, 9.5, starts=(0.0, 1.5), scale=0.1
        ),
    )  # fmt: skip

    @classmethod
    def sites(cls, mechanism):
        """Encoders with a disc: those of angles."""
        return tuple(c for c in super().sites(mechanism) if mechanism.output_unit(c) == 'rad')

    def read(self, outputs, z, p):
        """Add the error of that angle."""
        angle = outputs[self.site]
        return {**outputs, self.site: angle + p['amplitude'] * ca.sin(angle + p['phase'])}, []
