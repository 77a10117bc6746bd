"""First-order lag of the motor's torque."""

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class ActuatorLag(Effect):
    """T dtau_motor/dt = tau - tau_motor."""

    name = 'actuator_lag'
    place = 'command'
    summary = 'The current loop is slow: T dtau_motor/dt = tau - tau_motor.'
    parameters = (
        Parameter(
            'time_constant', 's', 'T', 0.001, 0.3,
            neutral=0.0, starts=(0.01, 0.05), scale=0.001, logarithmic=True,
        ),
    )  # fmt: skip
    states = ('torque',)
    # A newton metre that errs for a millisecond turns a leg of 1 kg m^2 by a mrad/s.
    state_scales = (1000.0,)
    largest_step = 0.001

    def deliver(self, torque, z, p):
        """The filtered torque is the state."""
        return z[0], [(torque - z[0]) / p['time_constant']]

    def initial_states(self, angle, rate, torque, p):
        """Settled at the torque that is held at the start."""
        return [torque]

    def start_spreads(self, p):
        """Commands of a moment before may still be on."""
        return [self.start_torque]
