"""The nodes of a robot whose IMU and drive hang on wires: the same above them as in simulation.

robot.launch.py starts them. With the devices of cg_hardware.emulators on the other ends of the
wires the whole of it runs at a desk.
"""

from dataclasses import dataclass

from cg_bringup.runs import NodeOf
from cg_interfaces import topics

RATE_HZ = 500.0
STALE = 0.015  # s: with a cycle of the drive, torque is zero 20 ms after the last command
MISSING = 0.1  # s without requests after which a person must look; a node that comes up takes 30
BLIND = 0.02  # s without the encoder
FALLEN = 0.6  # rad of the stance leg


@dataclass(frozen=True)
class RobotOptions:
    """What the launch file is told.

    Attributes:
        imu: Serial line of the IMU.
        baud: Of it, bit/s.
        axis: Angle of the IMU that is the lean: roll, pitch or yaw.
        imu_sign: 1.0, or -1.0 where it counts a forward lean negative.
        zero_file: Keeps the IMU's zero; empty for none.
        interface: python-can's name of the CAN adapter.
        channel: Of the adapter.
        drive: Number of the drive on the bus.
        drive_sign: 1.0, or -1.0 where its torque turns the joint backward.
        gear: Torque at the joint per torque of the motor.
        counts_per_turn: Of the encoder, per turn of the joint.
        torque_limit: In N m.
        model: Model file of observer and controller; empty for the nominal one.
        epsilon: Of the observer, s.
    """

    imu: str = '/dev/ttyACM0'
    baud: int = 921_600
    axis: str = 'pitch'
    imu_sign: float = 1.0
    zero_file: str = ''
    interface: str = 'socketcan'
    channel: str = 'can0'
    drive: int = 1
    drive_sign: float = 1.0
    gear: float = 1.0
    counts_per_turn: float = 20_000.0
    torque_limit: float = 40.0
    model: str = ''
    epsilon: float = 0.2


def robot_nodes(options: RobotOptions) -> dict[str, NodeOf]:
    """Node name -> what to start, in the order of ending."""
    gate = {'torque_limit': options.torque_limit, 'sample_rate_hz': RATE_HZ}
    model = {'model_file': options.model, 'sample_rate_hz': RATE_HZ}
    return {
        'drive': NodeOf('cg_hardware', 'drive_node', gate | {
            'stale_after': STALE, 'interface': options.interface, 'channel': options.channel,
            'node_id': options.drive, 'sign': options.drive_sign, 'gear': options.gear,
            'counts_per_turn': options.counts_per_turn,
        }),
        'imu': NodeOf('cg_hardware', 'imu_node', {
            'port': options.imu, 'baud': options.baud, 'rate_hz': RATE_HZ, 'axis': options.axis,
            'sign': options.imu_sign, 'zero_file': options.zero_file,
        }),
        'balance': NodeOf(
            'cg_control', 'balance_node', model, ((topics.TORQUE_COMMAND, topics.TORQUE_REQUEST),)
        ),
        'safety_gate': NodeOf('cg_hardware', 'safety_gate_node', gate | {
            'arming': True, 'fall_angle': FALLEN, 'stale_after': MISSING,
        }),
        'observer': NodeOf('cg_estimation', 'observer_node', model | {
            'epsilon': options.epsilon, 'longest_blind': BLIND,
        }),
    }  # fmt: skip
