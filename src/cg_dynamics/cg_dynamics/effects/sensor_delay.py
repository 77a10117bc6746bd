"""Sensors that report late."""

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class SensorDelay(Effect):
    """y(t) = h(x(t - delay)), on all channels or on one device."""

    name = 'sensor_delay'
    place = 'timing'
    summary = 'Sensors report late: y(t) = h(x(t - delay)), all of them or one kind.'
    parameters = (
        Parameter(
            'delay', 's', 'time by which the report is late', 0.0, 0.1,
            neutral=0.0, starts=(0.004, 0.02), scale=0.001,
        ),
    )  # fmt: skip

    @classmethod
    def sites(cls, mechanism):
        """All sensors, or the IMU alone or the encoders alone where there are both."""
        kinds = set(mechanism.sensor_kinds.values())
        both = 'encoder' in kinds and len(kinds) > 1
        return ('all', 'imu', 'encoder') if both else ('all',)

    def __init__(self, mechanism, at=None):
        super().__init__(mechanism, at)
        self.channels = frozenset(
            channel
            for channel, kind in mechanism.sensor_kinds.items()
            if self.site == 'all' or (self.site == 'encoder') == (kind == 'encoder')
        )

    def output_delay(self, channel, p):
        """The same delay on every channel of the site."""
        return p['delay'] if channel in self.channels else None
