"""The one-step rebalance live: `ros2 run cg_bringup rebalance --first outer --mode lockstep`.

The robot balances on one leg, takes a step when it has stood for a second, is caught on the other
leg and balances there. Starts the simulated hardware off its blocks, the observer, the trajectory
server, the TVLQR controller and the safety gate as processes of their own, for machines without
`ros2 launch`; rebalance.launch.py starts the same nodes with the same parameters. The last line
says whether it worked, and so does the exit status.
"""

import argparse
from dataclasses import dataclass, field
from typing import Any

import yaml

from cg_bringup.balance_run import MACHINE, carry_out
from cg_bringup.balancing import FALLEN
from cg_bringup.runs import MODES, PEERS, NodeOf
from cg_bringup.verdict import rebalance_verdict
from cg_control.following.tracking import REMEDIES
from cg_description.paths import model_path
from cg_dynamics.rig import STANCES
from cg_interfaces import topics

ROBOT = 'compass_gait_flexible'


@dataclass(frozen=True)
class RebalanceOptions:
    """What `rebalance` and the launch file are told.

    Attributes:
        robot: Model file of the simulated machine.
        model: Model file of observer, planner and controller.
        first: Leg that stands at the start.
        remedy: What is done about an impact off its time.
        friction: Plan with friction.
        start_after: Start the step after balancing for so long, s; 0 waits for ~/start.
        mode: Clock of the machine.
        seed: Of the sensor noise.
        duration: In s; 0 for ever.
    """

    robot: str = field(default_factory=lambda: str(model_path(ROBOT)))
    model: str = ''
    first: str = 'inner'
    remedy: str = 'event'
    friction: bool = True
    start_after: float = 1.0
    mode: str = 'real_time'
    seed: int = 1
    duration: float = 0.0


def rebalance_nodes(options: RebalanceOptions) -> dict[str, NodeOf]:
    """Node name -> what to start, in the order of ending."""
    rate = {'sample_rate_hz': 500.0}
    second = next(leg for leg in STANCES if leg != options.first)
    machine: dict[str, Any] = {
        'model_file': options.robot,
        'setup': yaml.safe_dump({'stance': options.first, 'on_blocks': False}),
        'initial_state': [0.01, 0.01, 0.0, 0.0],
        'mode': options.mode,
        'seed': options.seed,
        'duration': options.duration,
        'await_answer': True,
        'peer_timeout': PEERS,
        'experiment': 'one_step_rebalance',
        'exit_when_done': True,
        'fall_angle': FALLEN,
        **rate,
    }
    planner = {
        'model_file': options.model,
        'trajectory': f'{options.first}_to_{second}',
        'friction': options.friction,
    }
    controller = {
        'model_file': options.model,
        'remedy': options.remedy,
        'start_after': options.start_after,
        'await_trajectory': options.start_after > 0.0,
        **rate,
    }
    observer = {'model_file': options.model}
    remapped = ((topics.TORQUE_COMMAND, topics.TORQUE_REQUEST),)
    return {
        MACHINE: NodeOf('cg_hardware', 'simulation_node', machine),
        'trajectory_server': NodeOf('cg_control', 'trajectory_server_node', planner),
        'tvlqr': NodeOf('cg_control', 'tvlqr_node', controller, remapped),
        'safety_gate': NodeOf('cg_hardware', 'safety_gate_node', {}),
        'observer': NodeOf('cg_estimation', 'observer_node', observer),
    }


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_bringup rebalance`."""
    default = RebalanceOptions()
    parser = argparse.ArgumentParser(prog='rebalance', description=__doc__)
    parser.add_argument('--robot', default=default.robot, help='simulated: a model file or a name')
    parser.add_argument('--model', default='', help='of observer and controller: the same')
    parser.add_argument('--first', choices=STANCES, default='inner', help='[inner]')
    parser.add_argument('--remedy', choices=REMEDIES, default='event', help='[event]')
    parser.add_argument(
        '--no-friction', dest='friction', action='store_false',
        help='plan without friction and compensate it',
    )  # fmt: skip
    parser.add_argument('--start-after', type=float, default=1.0, help='s; 0 waits [1]')
    parser.add_argument('--mode', choices=MODES, default='real_time', help='[real_time]')
    parser.add_argument('--seed', type=int, default=1, help='of the sensor noise [1]')
    parser.add_argument('--duration', type=float, default=6.0, help='in s, 0 for ever [6]')
    options = RebalanceOptions(**vars(parser.parse_args(args)))
    asked = options.start_after > 0.0
    return carry_out(
        'rebalance', rebalance_nodes(options), lambda o: rebalance_verdict(o, options.first, asked)
    )


if __name__ == '__main__':
    raise SystemExit(main())
