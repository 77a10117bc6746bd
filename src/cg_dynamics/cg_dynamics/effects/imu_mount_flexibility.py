"""An IMU on a part that bends when the motor pulls."""

from cg_dynamics.effects.effect import START_TORQUE, ImuEffect
from cg_dynamics.parameter import Parameter


class ImuMountFlexibility(ImuEffect):
    """y = (angle + e, rate + de/dt) with a bending e that hip torque excites.

    d2e/dt2 + 2 damping_ratio frequency de/dt + frequency^2 (e - compliance tau) = 0    (MOUNT)
    """

    name = 'imu_mount_flexibility'
    summary = (
        'The hip torque bends the part that carries the IMU by e, which adds to lean angle and '
        'rate: d2e/dt2 + 2 damping_ratio frequency de/dt + frequency^2 (e - compliance tau) = 0.'
    )
    parameters = (
        Parameter(
            'compliance', 'rad/(N m)', 'bending per torque at rest', -0.05, 0.05,
            neutral=0.0, starts=(2e-4,), scale=2e-5,
        ),
        Parameter(
            'frequency', 'rad/s', 'natural frequency of the mount', 10.0, 500.0,
            starts=(30.0, 70.0, 140.0, 280.0), scale=5.0, logarithmic=True,
        ),
        Parameter(
            'damping_ratio', '1', 'of the mount', 0.005, 2.0,
            starts=(0.05,), scale=0.02, logarithmic=True,
        ),
    )  # fmt: skip
    states = ('bend', 'bend_rate')
    # Errors stay in the reading: nothing carries them on.
    state_scales = (30.0, 30.0)
    extra_inputs = ('hip_torque',)
    largest_step = 0.001

    def read(self, outputs, z, p):
        """(MOUNT)."""
        bend, bend_rate = z
        w = p['frequency']
        acceleration = (
            w**2 * (p['compliance'] * p['hip_torque'] - bend)
            - 2 * p['damping_ratio'] * w * bend_rate
        )
        moved = {c: outputs[c] + e for c, e in zip(self.channels, z, strict=True)}
        return {**outputs, **moved}, [bend_rate, acceleration]

    def initial_readings(self, outputs, p):
        """Bent by the torque that is held at the start."""
        return [p['compliance'] * p['hip_torque'], 0]

    def start_spreads(self, p):
        """Bent by START_TORQUE more or less, and as much energy in its motion."""
        bend = START_TORQUE * p['compliance']
        return [bend, bend * p['frequency']]
