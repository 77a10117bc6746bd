"""A motor or drive that cannot deliver what is asked of it."""

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter

CLIPPED = 0.9, 0.5, 0.2, 0.07, 0.02  # of the largest torque: where a limit is sought
CORNER = 1e-8  # of the limit, within which even a clip is round


class TorqueSaturation(Effect):
    """tau_motor = tau within -limit and limit, as a drive that limits its current.

    A motor whose iron saturates does not clip but gives way: with x = tau/limit and r the
    roundness, of slope 1 at rest and level for large torques,

    tau_motor = limit (d(a x + 1) - d(a x - 1))/2,   d(y)^2 = y^2 + r,   a^2 = 1 + r         (KNEE)

    which clips for r = 0 and is nearly a tanh for r = 1.5.
    """

    name = 'torque_saturation'
    place = 'command'
    family = ('joint_torque', 'torque')
    summary = (
        'The motor delivers no more than its limit: tau_motor = tau, cut off at +-limit, with a '
        'round knee if it has roundness.'
    )
    parameters = (
        Parameter(
            'limit', 'N m', 'largest torque delivered', 1e-3, 1e3,
            neutral=float('inf'), starts=(0.1, 0.5, 2.0, 5.0, 10.0), scale=0.5, logarithmic=True,
        ),
        Parameter(
            'roundness', '1', 'of the knee; 0 clips', 0.0, 10.0,
            starts=(0.0,), scale=0.1, free=False, leeway=3.0,
        ),
    )  # fmt: skip

    def torque_limit(self, values):
        """The limit; a round knee comes near it for large torques only."""
        return values['limit']

    def starts_beside(self, torque):
        """Limits below that torque: a higher one shows in nothing."""
        return [{'limit': share * torque} for share in CLIPPED]

    def deliver(self, torque, z, p):
        """(KNEE), with the difference of the roots written as a sum."""
        r = p['roundness']
        turn = ca.sqrt(1 + r)
        x = turn * torque / p['limit']

        def distance(y):
            """From a corner of the clip. Of r and not its root, or no fit could leave r = 0."""
            return ca.sqrt(y**2 + r + CORNER**2)

        return 2 * turn * torque / (distance(x + 1) + distance(x - 1)), []
