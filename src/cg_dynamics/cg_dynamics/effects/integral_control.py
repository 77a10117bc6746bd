"""The integral part of a drive that follows positions."""

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter

HOLDING = 4.0  # start torques that it may hold as a record begins: most of them hold a weight


class IntegralControl(Effect):
    """tau + held, d held/dt = gain (q_c - q), with tau of position_control.

    What the drive holds as a record begins nobody wrote down: it is each record's own. Limits of
    the sum (anti-windup) are not part of the law.
    """

    name = 'integral_control'
    place = 'command'
    summary = (
        'A drive that follows positions adds up their errors too: held comes on top of the torque '
        'of position_control, d held/dt = gain (q_c - q).'
    )
    parameters = (
        Parameter(
            'gain', 'N m/(rad s)', 'torque per error of the position and second', 0.0, 1e7,
            neutral=0.0, starts=(200.0, 5000.0), scale=1.0,
        ),
    )  # fmt: skip
    states = ('held',)
    # A torque that stays moves a stiff loop by its own share of the stiffness.
    state_scales = (100.0,)

    def __init__(self, mechanism, at=None):
        super().__init__(mechanism, at)
        self.extra_inputs = mechanism.told(self.site)[:1]  # type: ignore[misc]

    @classmethod
    def sites(cls, mechanism):
        """Driven joints of a robot whose recordings can say what drives were told."""
        return tuple(joint for joint in mechanism.joints if mechanism.told(joint))

    def transmit(self, torque, angle, rate, z, p):
        """What is held comes on top."""
        (told,) = self.extra_inputs
        return torque + z[0], [p['gain'] * (p[told] - angle)]

    def start_spreads(self, p):
        """It may hold a weight."""
        return [HOLDING * self.start_torque]
