"""Error of the motor's torque constant."""

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class TorqueConstant(Effect):
    """tau_motor = (1 + error) tau."""

    name = 'torque_constant'
    place = 'command'
    summary = 'The motor delivers more or less than reported: tau_motor = (1 + error) tau.'
    parameters = (
        Parameter(
            'error', '1', 'relative error of the torque constant', -0.9, 3.0,
            neutral=0.0, starts=(0.05, -0.05), scale=0.01,
        ),
    )  # fmt: skip

    def deliver(self, torque, z, p):
        """Scaled torque."""
        return (1 + p['error']) * torque, []
