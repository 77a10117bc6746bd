"""A motor or drive that cannot deliver what is asked of it."""

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class TorqueSaturation(Effect):
    """tau_motor = tau / (1 + (tau/limit)^8)^(1/8): 8 % less at the limit, 1 % at 0.75 of it."""

    name = 'torque_saturation'
    place = 'command'
    summary = (
        'The motor delivers no more than its limit, with a smooth corner: '
        'tau_motor = tau / (1 + (tau/limit)^8)^(1/8).'
    )
    parameters = (
        Parameter(
            'limit', 'N m', 'largest torque delivered', 1e-3, 1e3,
            neutral=float('inf'), starts=(0.1, 0.5, 2.0, 5.0, 10.0), scale=0.5, logarithmic=True,
        ),
    )  # fmt: skip

    def deliver(self, torque, z, p):
        """Torque with its peaks cut off."""
        return torque / (1 + (torque / p['limit']) ** 8) ** 0.125, []
