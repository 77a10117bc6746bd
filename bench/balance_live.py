"""Age of the measurement when its torque is latched, in real time, across four processes.

    python bench/balance_live.py [SECONDS]        prints a table; needs ROS (the wheels will do)

What is measured is published by the balance node on /diagnostics; this only collects it.
"""

import os
import sys
import tempfile
import time

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

from cg_bringup.balance_run import MACHINE, BalanceOptions, balance_nodes
from cg_bringup.supervisor import supervised
from cg_dynamics.rig import STANCES
from cg_interfaces.domains import own_domain
from cg_interfaces.ros import MACHINE_QOS


def run(stance: str, seconds: float) -> tuple[dict[str, str], int, int, str]:
    """Last figures of the balance node, missed deadlines, samples, and its last message."""
    node, last, missed, torques = Node('listener'), {}, [], []
    said = ['']

    def on_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == 'balance':
                last.update({value.key: value.value for value in status.values})
                missed.append(int(last['missed_deadlines']))
                said[0] = status.message

    node.create_subscription(DiagnosticArray, '/diagnostics', on_diagnostics, 10)
    node.create_subscription(JointState, '/applied_torque', torques.append, MACHINE_QOS)
    executor = EventsExecutor()
    executor.add_node(node)
    options = BalanceOptions(stance=stance, lean=0.03, duration=seconds)
    with tempfile.TemporaryFile() as log, supervised(balance_nodes(options), log) as supervisor:
        machine = supervisor.processes[MACHINE]
        deadline = time.monotonic() + seconds + 60.0
        while machine.poll() is None and time.monotonic() < deadline:
            supervisor.stop.check()
            executor.spin_once(timeout_sec=0.05)
    executor.remove_node(node)
    node.destroy_node()
    return last, sum(missed), len(torques), said[0]


def main() -> None:
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else 20.0
    print(
        f'load of the machine at the start: {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n'
    )
    print('| stance | samples | age p50, ms | p99 | max | older than 4 ms | at the end |')
    print('|---|---:|---:|---:|---:|---:|---|')
    with own_domain():
        rclpy.init()
        for stance in STANCES:
            last, missed, samples, said = run(stance, seconds)
            ages = ' | '.join(last.get(f'age_{name}_ms', '') for name in ('p50', 'p99', 'max'))
            print(f'| {stance} | {samples} | {ages} | {missed} | {said} |', flush=True)
        rclpy.try_shutdown()


if __name__ == '__main__':
    main()
