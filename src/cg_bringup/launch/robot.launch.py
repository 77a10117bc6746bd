"""A robot on wires: IMU, drive, observer, balance, gate. Nothing moves before a person says so.

    ros2 launch cg_bringup robot.launch.py imu:=/dev/ttyACM0 interface:=socketcan channel:=can0
    ros2 topic echo /robot_state
    ros2 service call /imu/zero std_srvs/srv/Trigger            # legs upright and still
    ros2 service call /drive/zero std_srvs/srv/Trigger          # legs parallel
    ros2 service call /drive/enable std_srvs/srv/Trigger
    ros2 service call /safety_gate/arm std_srvs/srv/Trigger     # from here on it balances
    ros2 service call /safety_gate/stop std_srvs/srv/Trigger    # emergency stop

Without a robot: `./cg exec python -m cg_hardware.emulators.robot FOLDER` makes FOLDER/imu and
FOLDER/can; give those with `interface:=slcan`.
"""

from dataclasses import fields

from launch import LaunchDescription

from cg_bringup.launching import description, node_actions, number
from cg_bringup.robot_run import RobotOptions, robot_nodes

DEFAULT = RobotOptions()
TOLD = {
    'imu': 'serial line of the IMU',
    'baud': 'of it, bit/s',
    'axis': 'angle of the IMU that is the lean: roll, pitch or yaw',
    'imu_sign': '1, or -1 where the IMU counts a forward lean negative',
    'zero_file': 'keeps the zero of the IMU; empty for none',
    'interface': "python-can's name of the CAN adapter: socketcan, slcan, ...",
    'channel': 'of the adapter',
    'drive': 'number of the drive on the bus',
    'drive_sign': '1, or -1 where its torque turns the joint backward',
    'gear': 'torque at the joint per torque of the motor',
    'counts_per_turn': 'of the encoder, per turn of the joint',
    'torque_limit': 'N m',
    'model': 'model of observer and controller, a file or a name; empty: nominal',
    'epsilon': 'time constant of the observer, s',
}
ARGUMENTS = {
    field.name: (str(getattr(DEFAULT, field.name)), TOLD[field.name], None)
    for field in fields(RobotOptions)
}


def start(given: dict[str, str]) -> list:
    """The nodes that the arguments describe."""
    values = {}
    for field in fields(RobotOptions):
        kind = type(getattr(DEFAULT, field.name))
        values[field.name] = given[field.name] if kind is str else number(given, field.name, kind)
    return node_actions(robot_nodes(RobotOptions(**values)))


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes."""
    return description(ARGUMENTS, start)
