"""The robot balances live: `ros2 run cg_bringup balance --stance outer --duration 60`.

Starts the simulated hardware, the observer, the balance controller and the safety gate as
processes of their own, for machines without `ros2 launch`; balance.launch.py starts the same
nodes with the same parameters (`balance_nodes`). Ends with the machine, or with Ctrl-C.
"""

import argparse
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from cg_bringup.runs import MODES, parameter_file_text
from cg_description.paths import model_path
from cg_dynamics.rig import STANCES

ROBOT = 'compass_gait_flexible'
LEAN = 0.06  # rad
POLL = 0.05  # s


@dataclass(frozen=True)
class BalanceOptions:
    """What `balance` and the launch file are told.

    Attributes:
        robot: Model file of the simulated machine.
        model: Model file of observer and controller.
        stance: Leg that stands.
        lean: Of both legs at the start, rad.
        mode: Clock of the machine.
        seed: Of the sensor noise.
        duration: In s; 0 for ever.
        pushes: Instants in s and impulses in N s at the hip, in turn.
        method: Of the observer.
        epsilon: Of the observer, s.
    """

    robot: str = field(default_factory=lambda: str(model_path(ROBOT)))
    model: str = ''
    stance: str = 'inner'
    lean: float = LEAN
    mode: str = 'real_time'
    seed: int = 1
    duration: float = 0.0
    pushes: Sequence[float] = ()
    method: str = 'high_gain'
    epsilon: float = 0.2


@dataclass(frozen=True)
class NodeOf:
    """A node to start.

    Attributes:
        package: Package of its executable.
        executable: Name of executable and module.
        parameters: ROS parameters.
        remappings: (from, to) of topics.
    """

    package: str
    executable: str
    parameters: dict[str, Any]
    remappings: tuple[tuple[str, str], ...] = ()


def balance_nodes(options: BalanceOptions) -> dict[str, NodeOf]:
    """Node name -> what to start; the machine comes last."""
    rate = {'sample_rate_hz': 500.0}
    machine: dict[str, Any] = {
        'model_file': options.robot,
        'setup': yaml.safe_dump({'stance': options.stance}),
        'initial_state': [options.lean, options.lean, 0.0, 0.0],
        'mode': options.mode,
        'seed': options.seed,
        'duration': options.duration,
        'await_answer': True,
        'experiment': 'balance',
        'closed_loop': True,
        'exit_when_done': True,
        **rate,
    }
    if options.pushes:
        machine['pushes'] = [float(number) for number in options.pushes]
    observer = {'model_file': options.model, 'method': options.method, 'epsilon': options.epsilon}
    return {
        'observer': NodeOf('cg_estimation', 'observer_node', observer | rate),
        'balance': NodeOf(
            'cg_control',
            'balance_node',
            {'model_file': options.model, **rate},
            (('/torque_command', '/torque_request'),),
        ),
        'safety_gate': NodeOf('cg_hardware', 'safety_gate_node', {}),
        'simulation_node': NodeOf('cg_hardware', 'simulation_node', machine),
    }


def start(nodes: dict[str, NodeOf], directory: Path, output=None) -> dict[str, subprocess.Popen]:
    """Start nodes as processes; parameters go through a file in `directory`."""
    parameters = directory / 'parameters.yaml'
    tree = {name: node.parameters for name, node in nodes.items()}
    parameters.write_text(parameter_file_text(tree), encoding='utf-8')
    return {
        name: subprocess.Popen(
            [
                *(sys.executable, '-m', f'{node.package}.{node.executable}', '--ros-args'),
                *('--params-file', str(parameters)),
                *(word for a, b in node.remappings for word in ('-r', f'{a}:={b}')),
            ],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT if output is not None else None,
            start_new_session=True,
        )
        for name, node in nodes.items()
    }


def stop(processes: dict[str, subprocess.Popen]) -> None:
    """End processes, the controller's first, so that it leaves with zero torque."""
    for process in processes.values():
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
    for process in processes.values():
        try:
            process.wait(timeout=10.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def carry_out(nodes: dict[str, NodeOf]) -> int:
    """Exit code of the machine, `simulation_node`; 1 if another node ended before it."""
    with tempfile.TemporaryDirectory(prefix='cg_run_') as directory:
        processes = start(nodes, Path(directory))
        machine = processes['simulation_node']
        try:
            while machine.poll() is None:
                for name, process in processes.items():
                    if process is not machine and process.poll() is not None:
                        print(f'error: {name} ended early', file=sys.stderr)
                        return 1
                time.sleep(POLL)
            return machine.returncode
        except KeyboardInterrupt:
            return 130
        finally:
            stop(processes)


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_bringup balance`."""
    default = BalanceOptions()
    parser = argparse.ArgumentParser(prog='balance', description=__doc__)
    parser.add_argument('--robot', default=default.robot, help='model file of the machine')
    parser.add_argument('--model', default='', help='model file of observer and controller')
    parser.add_argument('--stance', choices=STANCES, default='inner', help='[inner]')
    parser.add_argument('--lean', type=float, default=LEAN, help=f'at the start, rad [{LEAN}]')
    parser.add_argument('--mode', choices=MODES, default='real_time', help='[real_time]')
    parser.add_argument('--seed', type=int, default=1, help='of the sensor noise [1]')
    parser.add_argument('--duration', type=float, default=0.0, help='in s, 0 for ever [0]')
    parser.add_argument(
        '--pushes', type=float, nargs='*', default=[], help='t1 P1 t2 P2 ... in s and N s'
    )
    parser.add_argument('--method', default='high_gain', help='of the observer [high_gain]')
    parser.add_argument('--epsilon', type=float, default=0.2, help='of the observer, s [0.2]')
    options = BalanceOptions(**vars(parser.parse_args(args)))
    return carry_out(balance_nodes(options))


if __name__ == '__main__':
    raise SystemExit(main())
