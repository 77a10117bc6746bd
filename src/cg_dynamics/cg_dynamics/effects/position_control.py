"""A drive that follows positions by a loop of its own."""

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class PositionControl(Effect):
    """tau = ff + stiffness (q_c - q) + damping (v_c - v).

    The loop closes in the model as it does in the drive: what is simulated is fed back, so that a
    simulated robot follows its commands as the real one does. The law is that of a drive whose
    loop is much faster than the motion and reads the joint. q_c, v_c and ff are what it was told
    (interfaces.md, "Commanded positions"); the latter two are 0 where nobody told them.
    """

    name = 'position_control'
    place = 'command'
    summary = 'The drive follows positions: tau = ff + stiffness (q_c - q) + damping (v_c - v).'
    parameters = (
        Parameter(
            'stiffness', 'N m/rad', 'torque per error of the position', 0.0, 1e6,
            neutral=0.0, starts=(100.0,), scale=1.0,
        ),
        Parameter(
            'damping', 'N m s/rad', 'torque per error of the rate', 0.0, 1e5,
            starts=(1.0,), scale=0.01,
        ),
    )  # fmt: skip

    def __init__(self, mechanism, at=None):
        super().__init__(mechanism, at)
        self.extra_inputs = mechanism.told(self.site)  # type: ignore[misc]

    @classmethod
    def sites(cls, mechanism):
        """Driven joints of a robot whose recordings can say what drives were told."""
        return tuple(joint for joint in mechanism.joints if mechanism.told(joint))

    @classmethod
    def applies(cls, setups):
        """A drive follows positions or it does not: nobody has to seek that."""
        return False

    def command(self, torque, angle, rate, p):
        """The loop."""
        position, velocity = (p[name] for name in self.extra_inputs)
        return torque + p['stiffness'] * (position - angle) + p['damping'] * (velocity - rate)
