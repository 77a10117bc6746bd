"""The simulated hardware on its own, for controllers, `ros2 param`, plots and play.

    ros2 launch cg_bringup simulation.launch.py model:=my_robot.yaml gate:=true

With `gate:=true` the safety gate stands on the torque path: controllers then publish
/torque_request.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    'model': ('', 'model file to simulate; empty for the nominal compass gait', None),
    'setup': ('', 'what was done to the rig: YAML text or a file', None),
    'mode': ('real_time', 'clock of the machine', ['real_time', 'lockstep']),
    'seed': ('0', 'seed of the sensor noise', None),
    'gate': ('false', 'whether the safety gate stands on the torque path', ['true', 'false']),
}


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes."""
    arguments = [
        DeclareLaunchArgument(name, default_value=default, description=text, choices=choices)
        for name, (default, text, choices) in ARGUMENTS.items()
    ]
    machine = Node(
        package='cg_hardware',
        executable='simulation_node',
        output='screen',
        parameters=[
            {
                'model_file': ParameterValue(LaunchConfiguration('model'), value_type=str),
                'setup': ParameterValue(LaunchConfiguration('setup'), value_type=str),
                'mode': ParameterValue(LaunchConfiguration('mode'), value_type=str),
                'seed': ParameterValue(LaunchConfiguration('seed'), value_type=int),
            }
        ],
    )
    gate = Node(
        package='cg_hardware',
        executable='safety_gate_node',
        output='screen',
        condition=IfCondition(LaunchConfiguration('gate')),
    )
    return LaunchDescription([*arguments, machine, gate])
