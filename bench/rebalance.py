"""The one-step rebalance, offline: who still stands, by remedy, model error and hidden effect.

    python bench/rebalance.py                    prints the tables
    python bench/rebalance.py --write            stores them as bench/results/rebalance.md
    python bench/rebalance.py --starts 20        fewer starts

The robot balances on the inner leg, takes a step and is caught on the outer leg, on the exact
hybrid model (cg_dynamics.walking.hybrid), friction and torque limit included, state known exactly,
torque held for 4 ms. A start is drawn uniformly from +-(0.06, 0.15) rad of stance and swing leg
and +-(0.15, 0.3) rad/s of their rates. It counts as rebalanced if, 1.5 s after the nominal end,
the robot stands on the outer leg within 0.05 rad and 0.2 rad/s, having landed once. Steps shorter
than 10 cm do not land: the robot stands on blocks. Every column sees the same starts.
"""

import argparse
import platform
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
from hidden_effects import PROGRAMME

from cg_control.balancing.balance import BalanceSettings, balance_gains
from cg_control.following.planning import CheckOptions, executed, plan
from cg_control.following.tracking import REMEDIES, TrackingSettings
from cg_control.trajectories.collocation import Options, PlanningError
from cg_control.trajectories.task import Task
from cg_control.trajectories.trajectory import Trajectory
from cg_description.paths import model_path
from cg_dynamics.errors import SimulationError
from cg_dynamics.model import Model
from cg_dynamics.walking.hybrid import WalkOptions
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse

ROBOT = Model.load(model_path('compass_gait_mit'))
TASK = Task(('inner', 'outer'), reach=0.2)
SPREAD = np.array([0.06, 0.15, 0.15, 0.3])
SAMPLE_TIME = 0.004
MORE = 1.5
LUMPS = ('c1', 'c2', 'c3', 'c4', 'c5', 'c6')
FRICTION = ('viscous_friction.coefficient', 'coulomb_friction.torque')
ERRORS = (0.0, 0.05, 0.10)
SLOPES = (-0.045, -0.03, -0.015, 0.015, 0.03, 0.045)
OPTIONS = WalkOptions(
    sample_time=SAMPLE_TIME, step=0.002, minimum_step=0.1, fall_angle=0.6, largest_steps=2
)
RECORDED = 6.0  # s of each
RESULT = Path(__file__).parent / 'results' / 'rebalance.md'


def starts(count: int) -> np.ndarray:
    return np.random.default_rng(2011).uniform(-1, 1, (count, 4)) * SPREAD


def wrong_robot(error: float, seed: int) -> Model:
    """A robot whose lumps and friction differ uniformly by up to `error`, of real bodies."""
    rng = np.random.default_rng(seed)
    while error > 0:
        values = {
            name: ROBOT.values[name] * (1 + error * rng.uniform(-1, 1))
            for name in (*LUMPS, *FRICTION)
        }
        robot = ROBOT.with_values(values)
        try:
            robot.require_consistency()
        except ValueError:
            continue
        return robot
    return ROBOT


def planned(known: Model) -> tuple[Trajectory, np.ndarray]:
    """The step and the gain of the catch, from what is known."""
    trajectory = plan(known, TASK, Options(fine=25), checks=CheckOptions(minimum_step=0.1))
    return trajectory, balance_gains(known, BalanceSettings(), SAMPLE_TIME)['outer']


def stands(trajectory, balance, known, robot, remedy: str, x0, slope: float = 0.0) -> bool:
    options = replace(OPTIONS, slope=slope)
    try:
        done = executed(
            trajectory, robot, TrackingSettings(remedy=remedy), known, x0, MORE, options, balance
        )
    except SimulationError:
        return False
    return (
        done.outcome == 'time'
        and done.stance == 'outer'
        and len(done.impacts) == 1
        and abs(done.state[1]) < 0.05
        and abs(done.state[3]) < 0.2
    )


def share(successes: list[bool]) -> str:
    return f'{100 * np.mean(successes):.1f} %'


def remedies_table(count: int) -> list[str]:
    trajectory, balance = planned(ROBOT)
    lines = ['| remedy | ' + ' | '.join(f'{100 * e:.0f} % error' for e in ERRORS) + ' |',
             '|---|' + '---:|' * len(ERRORS)]  # fmt: skip
    robots = {e: [wrong_robot(e, seed) for seed in range(count)] for e in ERRORS}
    for remedy in REMEDIES:
        cells = [
            share([
                stands(trajectory, balance, ROBOT, robot, remedy, x0)
                for robot, x0 in zip(robots[e], starts(count), strict=True)
            ])
            for e in ERRORS
        ]  # fmt: skip
        lines.append(f'| {remedy} | ' + ' | '.join(cells) + ' |')
    return lines


def ground_table(count: int) -> list[str]:
    trajectory, balance = planned(ROBOT)
    reach = float(2 * ROBOT.values['leg_length'] * np.sin(abs(trajectory.phases[0].states[-1][0])))
    heads = [f'{-100 * reach * np.tan(s):+.1f} cm' for s in SLOPES]
    lines = ['| remedy | ' + ' | '.join(heads) + ' |', '|---|' + '---:|' * len(SLOPES)]
    for remedy in REMEDIES:
        cells = [
            share([
                stands(trajectory, balance, ROBOT, ROBOT, remedy, x0 / 2, slope)
                for x0 in starts(count)
            ])
            for slope in SLOPES
        ]  # fmt: skip
        lines.append(f'| {remedy} | ' + ' | '.join(cells) + ' |')
    return lines


def hidden_effects() -> dict[str, Model]:
    """What the robot has and its nominal model does not."""
    return {
        'none': ROBOT,
        'motor delivers half (`torque_constant`)': ROBOT.with_effect(
            'torque_constant', error=-0.5
        ),
        'dry friction of 10 N m instead of 1.84': ROBOT.with_values(
            {'coulomb_friction.torque': 10.0}
        ),
        '5 N m torque bias (`torque_bias`)': ROBOT.with_effect('torque_bias', bias=5.0),
        '1.5 kg on the inner legs (`payload`)': ROBOT.with_effect(
            'payload', at='inner', mass=1.5, distance=0.6
        ),
        '1.5 kg on the outer legs (`payload`)': ROBOT.with_effect(
            'payload', at='outer', mass=1.5, distance=0.6
        ),
    }


def diagnosed(robot: Model) -> tuple[Model, str]:
    """The model that a diagnosis of eight records of 6 s makes of the nominal one, and causes."""
    records = []
    for k, name in enumerate(PROGRAMME):
        e = load_experiment(name)
        settings = ExcitationSettings(**e.excitation, duration=RECORDED, seed=300 + k)
        records.append(
            rehearse(f'{k}_{name}', robot, e.setup, e.initial_state, [make_signal(settings)],
                     RECORDED, seed=300 + k)
        )  # fmt: skip
    found = diagnose(ROBOT, records)
    return found.extended.model, ', '.join(cause.label for cause in found.causes) or '-'


def hidden_table(count: int) -> list[str]:
    lines = [
        '| hidden effect | nominal model | true model | diagnosed model | named |',
        '|---|---:|---:|---:|---|',
    ]
    nominal = planned(ROBOT)
    for name, robot in hidden_effects().items():
        cells = [share([stands(*nominal, ROBOT, robot, 'event', x0) for x0 in starts(count)])]
        found, causes = diagnosed(robot)
        for known in (robot, found):
            try:
                better = planned(known)
                cells.append(
                    share([stands(*better, known, robot, 'event', x0) for x0 in starts(count)])
                )
            except PlanningError as error:
                cells.append(f'no plan: {error}')
        lines.append(f'| {name} | ' + ' | '.join(cells) + f' | {causes} |')
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--starts', type=int, default=200, help='seeded starts of each cell')
    parser.add_argument('--write', action='store_true', help=f'store {RESULT}')
    arguments = parser.parse_args()
    n = arguments.starts
    command = 'python bench/rebalance.py --write' + (f' --starts {n}' if n != 200 else '')
    lines = [
        '# One-step rebalance',
        '',
        f'Command: `{command}`. Python {platform.python_version()}, casadi {ca.__version__}. '
        f'{n} seeded starts a cell in the first table, {n // 2} in the others; what is done is '
        'said at the top of `bench/rebalance.py`.',
        '',
        'Share that stands on the other leg at the end, by remedy at the impact and by the error '
        'of the six lumps and the friction (uniform, each robot another one):',
        '',
        *remedies_table(n),
        '',
        'The ground where the foot lands is higher (+) or lower (-) than planned, so that the '
        'impact comes early or late; starts half as far away:',
        '',
        *ground_table(n // 2),
        '',
        'A hidden effect, planned and controlled (`event`) with the nominal model, with the true '
        'one, and with what the diagnosis of eight recordings of 6 s makes of the nominal one:',
        '',
        *hidden_table(n // 2),
    ]
    text = '\n'.join([*lines, ''])
    print(text)
    if arguments.write:
        RESULT.write_text(text)


if __name__ == '__main__':
    main()
