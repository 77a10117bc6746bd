"""The robot balances live: `ros2 run cg_bringup balance --stance outer --duration 60`.

Starts the simulated hardware, the observer, the balance controller and the safety gate as
processes of their own, for machines without `ros2 launch`; balance.launch.py starts the same
nodes with the same parameters (`balance_nodes`). Ends when the time is over, the robot has fallen,
or with Ctrl-C; the last line says whether it worked, and so does the exit status.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import yaml

from cg_bringup.balancing import FALLEN
from cg_bringup.runs import MODES, NodeOf
from cg_bringup.supervisor import ProcessDied, supervised
from cg_bringup.verdict import Verdict, balance_verdict
from cg_description.paths import model_path
from cg_dynamics.rig import STANCES
from cg_dynamics.stop_request import Stopped
from cg_hardware.standing import Outcome
from cg_interfaces import topics

ROBOT = 'compass_gait_flexible'
LEAN = 0.06  # rad
MACHINE = 'simulation_node'


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


def balance_nodes(options: BalanceOptions) -> dict[str, NodeOf]:
    """Node name -> what to start, in the order of ending."""
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
        'fall_angle': FALLEN,
        **rate,
    }
    if options.pushes:
        machine['pushes'] = [float(number) for number in options.pushes]
    observer = {'model_file': options.model, 'method': options.method, 'epsilon': options.epsilon}
    return {
        MACHINE: NodeOf('cg_hardware', 'simulation_node', machine),
        'balance': NodeOf(
            'cg_control',
            'balance_node',
            {'model_file': options.model, **rate},
            ((topics.TORQUE_COMMAND, topics.TORQUE_REQUEST),),
        ),
        'safety_gate': NodeOf('cg_hardware', 'safety_gate_node', {}),
        'observer': NodeOf('cg_estimation', 'observer_node', observer | rate),
    }


def carry_out(program: str, nodes: dict[str, NodeOf], judge: Callable[[Outcome], Verdict]) -> int:
    """Run the nodes until the machine has finished, and end with one line of how it went.

    Args:
        program: Its name, for the line.
        nodes: Node name -> what to start.
        judge: Says whether what the robot did is what was asked.

    Returns:
        Exit status: 0 if it worked, 1 if not, 128 + the signal if one came.
    """
    with tempfile.TemporaryDirectory(prefix='cg_outcome_') as directory:
        outcome = Path(directory) / 'outcome.json'
        interruption: ProcessDied | Stopped | None = None
        status = 0
        try:
            with supervised(with_outcome(nodes, outcome)) as supervisor:
                status = supervisor.wait(MACHINE)
        except (ProcessDied, Stopped) as error:
            interruption = error
        verdict = verdict_of(outcome, judge)
    line = f'{interruption}; until then {verdict.line}' if interruption else verdict.line
    worked = verdict.worked and status == 0 and not isinstance(interruption, ProcessDied)
    print(f'{program}: {line}', file=sys.stdout if worked else sys.stderr, flush=True)
    if isinstance(interruption, Stopped):
        return interruption.status
    return 0 if worked else 1


def with_outcome(nodes: dict[str, NodeOf], outcome: Path) -> dict[str, NodeOf]:
    """The same nodes, with a machine that writes there how the robot fared."""
    machine = nodes[MACHINE]
    parameters = machine.parameters | {'outcome_file': str(outcome)}
    return nodes | {MACHINE: replace(machine, parameters=parameters)}


def verdict_of(outcome: Path, judge: Callable[[Outcome], Verdict]) -> Verdict:
    """What is said of a run whose machine was to write its outcome there."""
    try:
        return judge(Outcome.load(outcome))
    except FileNotFoundError:
        return Verdict(False, 'the machine had not started')


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_bringup balance`."""
    default = BalanceOptions()
    parser = argparse.ArgumentParser(prog='balance', description=__doc__)
    parser.add_argument('--robot', default=default.robot, help='simulated: a model file or a name')
    parser.add_argument('--model', default='', help='of observer and controller: the same')
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
    return carry_out(
        'balance', balance_nodes(options), lambda o: balance_verdict(o, options.pushes)
    )


if __name__ == '__main__':
    raise SystemExit(main())
