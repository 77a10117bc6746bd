"""A drive that knows torques in steps only."""

import casadi as ca

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class TorqueQuantisation(Effect):
    """tau_motor = step round(tau/step), as of a drive whose command has few bits.

    With x = 2 pi tau/step, the missing torque is a sawtooth whose edges are r steps wide or so,

    tau_motor = tau - step/pi atan(k sin x, 1 + k cos x),   k = 1 - r                      (STEPS)

    which is the rounding itself for r = 0.
    """

    name = 'torque_quantisation'
    place = 'command'
    family = ('joint_torque', 'torque')
    ripple = True
    steps = True
    summary = (
        'The drive rounds its command: tau_motor = step round(tau/step), with edges that are '
        'round if they have roundness.'
    )
    parameters = (
        Parameter(
            'step', 'N m', 'between torques that are delivered', 1e-3, 100.0,
            neutral=0.0, starts=(0.1, 0.4, 1.0), scale=0.01, logarithmic=True, swept=True,
        ),
        Parameter(
            'roundness', '1', 'of the edges, as a share of the step; 0 is a staircase', 1e-3, 0.9,
            starts=(0.02,), scale=0.01, logarithmic=True, free=False, leeway=2.0,
        ),
    )  # fmt: skip

    @classmethod
    def repeating(cls, period, size):
        """Of that step."""
        return [{'step': period}]

    def starts_beside(self, torque):
        """From two steps within that torque to 40: half a step more leaves the edges elsewhere."""
        return [{'step': 2 * torque / n} for n in range(4, 81)]

    def deliver(self, torque, z, p):
        """(STEPS)."""
        kept, x = 1 - p['roundness'], 2 * ca.pi * torque / p['step']
        missing = ca.atan2(kept * ca.sin(x), 1 + kept * ca.cos(x)) / ca.pi
        return torque - p['step'] * missing, []
