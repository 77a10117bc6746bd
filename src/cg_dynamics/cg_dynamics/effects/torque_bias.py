"""Constant torque that nobody commanded."""

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class TorqueBias(Effect):
    """tau_motor = tau + bias."""

    name = 'torque_bias'
    place = 'command'
    summary = 'A constant torque adds to the reported one: tau_motor = tau + bias.'
    parameters = (
        Parameter(
            'bias', 'N m', 'torque at zero command', -20.0, 20.0,
            neutral=0.0, starts=(0.01,), scale=0.01,
        ),
    )  # fmt: skip

    def deliver(self, torque, z, p):
        """Shifted torque."""
        return torque + p['bias'], []
