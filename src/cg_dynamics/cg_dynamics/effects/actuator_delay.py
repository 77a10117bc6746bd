"""Transport delay of the torque path."""

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class ActuatorDelay(Effect):
    """tau_motor(t) = tau(t - delay)."""

    name = 'actuator_delay'
    place = 'timing'
    summary = 'The motor torque follows the reported torque late: tau_motor(t) = tau(t - delay).'
    parameters = (
        Parameter(
            'delay', 's', 'time by which the torque acts late', 0.0, 0.1,
            neutral=0.0, starts=(0.004, 0.02), scale=0.001,
        ),
    )  # fmt: skip

    def input_delay(self, p):
        """The delay itself."""
        return p['delay']
