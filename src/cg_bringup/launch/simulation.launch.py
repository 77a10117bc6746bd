"""The simulated hardware on its own, for controllers, `ros2 param`, plots and play.

    ros2 launch cg_bringup simulation.launch.py model:=my_robot.yaml gate:=true

With `gate:=true` the safety gate stands on the torque path: controllers then publish
/torque_request.
"""

from launch import LaunchDescription

from cg_bringup.balance_run import MACHINE
from cg_bringup.launching import description, node_actions, number
from cg_bringup.runs import MODES, NodeOf

ARGUMENTS = {
    'model': ('', 'model to simulate, a file or a name; empty: the nominal compass gait', None),
    'setup': ('', 'what was done to the rig: YAML text or a file', None),
    'mode': ('real_time', 'clock of the machine', list(MODES)),
    'seed': ('0', 'seed of the sensor noise', None),
    'gate': ('false', 'whether the safety gate stands on the torque path', ['true', 'false']),
}


def start(given: dict[str, str]) -> list:
    """The machine, and the gate if there is to be one."""
    machine = {
        'model_file': given['model'],
        'setup': given['setup'],
        'mode': given['mode'],
        'seed': number(given, 'seed', int),
    }
    nodes = {MACHINE: NodeOf('cg_hardware', 'simulation_node', machine)}
    if given['gate'] == 'true':
        nodes['safety_gate'] = NodeOf('cg_hardware', 'safety_gate_node', {})
    return node_actions(nodes)


def generate_launch_description() -> LaunchDescription:
    """Arguments and nodes."""
    return description(ARGUMENTS, start)
