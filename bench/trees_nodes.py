"""What following a tree costs in the running nodes, in lock-step and in real time.

    python bench/trees_nodes.py [--tree NAME] [--seconds 20] [--write]       needs ROS
    ./cg run cg_control grow_tree --samples 3584 --out tree.npz             one of 10 000 nodes

Six processes: machine, observer, tree server, tree controller, gate, and a listener that collects
what the controller says on /diagnostics. The robot begins at a state that the tree brings home,
comes home, and balances; every state is looked up, at home as well. *Look-up* is the time of one
product and its least entry in the controller's process, *preview* that of simulating where the
tree leads from a state that no funnel holds, *answer* that from a state's arrival to its torque on
the topic. A *slow* answer took longer than a sample, 2 ms. *Age* is that of the measurement
when the drive latched the torque that answers it, *late* if more than 4 ms.
"""

import argparse
import multiprocessing
import os
import platform
import tempfile
import time
from pathlib import Path

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node

from cg_bringup.balance_run import MACHINE
from cg_bringup.recover_run import RecoverOptions, recover_nodes
from cg_bringup.runs import MODES
from cg_bringup.supervisor import supervised
from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import tree_path
from cg_description.model_file import write_atomically
from cg_interfaces.domains import own_domain

RESULT = Path(__file__).parent / 'results' / 'trees_nodes.md'
FIGURES = (('lookup', 'us'), ('preview', 'us'), ('answer', 'us'), ('age', 'ms'))
COUNTED = ('slow_answers', 'missed_deadlines')


def run(options: RecoverOptions) -> tuple[dict[str, str], dict[str, int], str]:
    """Last figures of the controller, sums of what is counted, and its last message."""
    node, last, said = Node('listener'), {}, ['']
    counted = dict.fromkeys(COUNTED, 0)

    def on_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name == 'tree_controller':
                last.update({value.key: value.value for value in status.values})
                said[0] = status.message
                for name in COUNTED:
                    counted[name] += int(last[name])

    node.create_subscription(DiagnosticArray, '/diagnostics', on_diagnostics, 10)
    executor = EventsExecutor()
    executor.add_node(node)
    with tempfile.TemporaryFile() as log, supervised(recover_nodes(options), log) as supervisor:
        machine = supervisor.processes[MACHINE]
        deadline = time.monotonic() + 10.0 * options.duration + 60.0
        while machine.poll() is None and time.monotonic() < deadline:
            supervisor.stop.check()
            executor.spin_once(timeout_sec=0.05)
    executor.remove_node(node)
    node.destroy_node()
    return last, counted, said[0]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--tree', default=RecoverOptions().tree, help='a file or a name')
    parser.add_argument('--seconds', type=float, default=20.0)
    parser.add_argument('--write', action='store_true')
    options = parser.parse_args()
    path = tree_path(options.tree)
    rows = []
    with own_domain():
        rclpy.init()
        for mode in MODES:
            load = os.getloadavg()[0]
            last, counted, said = run(
                RecoverOptions(tree=str(path), mode=mode, duration=options.seconds)
            )
            figures = [
                ' / '.join(last.get(f'{name}_{k}_{unit}', '-') for k in ('p50', 'p99', 'max'))
                for name, unit in FIGURES
            ]
            rows.append(
                f'| {mode} | {load:.1f} | {" | ".join(figures)} | {counted["slow_answers"]} '
                f'| {counted["missed_deadlines"]} | {said} |'
            )
            print(rows[-1], flush=True)
        rclpy.try_shutdown()
    text = '\n'.join([
        '# Following a tree in the running nodes',
        '',
        f'`python bench/trees_nodes.py --tree {options.tree} --seconds {options.seconds:g} '
        f'--write`, Python {platform.python_version()}, {multiprocessing.cpu_count()} cores, load '
        'as stated. What is counted is said at the top of the script. '
        f'Tree: {len(Tree.load(path).nodes)} nodes.',
        '',
        '| clock | load | look-up, us (p50 / p99 / max) | preview, us | answer, us | age, ms '
        '| slow | late | at the end |',
        '|---|---:|---|---|---|---|---:|---:|---|',
        *rows,
        '',
    ])  # fmt: skip
    print(text)
    if options.write:
        write_atomically(RESULT, text)


if __name__ == '__main__':
    main()
