"""A robot on wires: IMU, drive, observer, balance, gate. Nothing moves before a person says so.

    ros2 launch cg_bringup robot.launch.py imu:=/dev/ttyACM0 interface:=socketcan channel:=can0
    ros2 topic echo /robot_state
    ros2 service call /imu/zero std_srvs/srv/Trigger            # legs upright and still
    ros2 service call /drive/zero std_srvs/srv/Trigger          # legs parallel
    ros2 service call /drive/enable std_srvs/srv/Trigger
    ros2 service call /safety_gate/arm std_srvs/srv/Trigger     # from here on it balances
    ros2 service call /safety_gate/stop std_srvs/srv/Trigger    # emergency stop

The same nodes as `ros2 run cg_bringup robot`, which with `--emulated` needs no robot.
"""

from dataclasses import fields

from launch import LaunchDescription

from cg_bringup.launching import description, node_actions, number
from cg_bringup.robot_run import TOLD, RobotOptions, robot_nodes

DEFAULT = RobotOptions()
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
