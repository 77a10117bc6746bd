"""Learning from walking: hidden effects named from walks, and walking with what was named.

    ./cg exec python bench/walking_learn.py --write bench/results/walking_learn.md
    ... --masses --cases payload --seconds 7 --speeds 0.2 0.25 --springs 5
    ... --masses --cases foot_slip --seconds 9 --speeds 0.3 0.3

The robot walks under the tree that was planned for the nominal model, in the lock-step loop with
noise, encoder counts and the observer; two or four such records are all that the diagnosis gets,
unless `--springs` adds some. A second part hides more than the nominal tree bears. It falls, the
falls are recorded, and a tree for the diagnosed model walks instead. CPU times are of one process.
`--raw` keeps every row, and the table is made of all rows there.
"""

import argparse
import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cg_bringup.balancing import BalanceRun, balance, record_of
from cg_control.balancing.balance import BalanceController, balance_gains
from cg_control.balancing.basin import sample_basin, shipped_basins
from cg_control.following.tracking import WALKING
from cg_control.plan_walk import walking_tree
from cg_control.trajectories.collocation import PlanningError
from cg_control.trajectories.trajectory import TrajectoryError
from cg_control.trees.recovery import ReadyTree, RecoverySettings, TreeController
from cg_control.trees.tree import Tree
from cg_description.model_file import write_atomically
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import STANCES, Setup
from cg_estimation.high_gain import HighGainObserver
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Diagnosis, Options
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.records.record import Record
from cg_sysid.stances.phases import Cut, cut_steps

NOMINAL = Model.load(model_path('compass_gait_mit'))
T, EPSILON = 0.002, 0.01  # s
# An observer's phase is noisy: it is drawn to the surfaces more slowly than that of a known state.
PULL = 100.0  # 1/s
SPEEDS = (0.2, 0.25, 0.3)  # m/s
STEPS = 20  # that a robot is asked for
LUMPS = ('c1', 'c2', 'c3', 'c4', 'c5', 'c6')
ERROR = 0.03  # relative, of the robots' own numbers
EFFECTS = (
    'payload', 'actuator_lag', 'actuator_delay', 'foot_slip', 'impact_restitution',
    'torque_constant', 'torque_bias', 'encoder_offset', 'imu_offset', 'quadratic_friction',
)  # fmt: skip
HIDDEN = {
    'nothing': {},
    'payload': {'mass': 1.0, 'distance': 0.6},
    'actuator_lag': {'time_constant': 0.015},
    'foot_slip': {'friction': 0.35},
}


@dataclass(frozen=True)
class Walker:
    """All that the controller side knows of a robot: model, tree, basins."""

    known: Model
    ready: ReadyTree
    basins: dict

    @staticmethod
    def of(known: Model, tree: Tree) -> 'Walker':
        """With basins sampled, where none are shipped."""
        gains = balance_gains(known, RecoverySettings(), T)
        limit = known.torque_limit
        basins = shipped_basins(known, gains, limit) or {
            leg: sample_basin(known, leg, gains[leg], limit) for leg in STANCES
        }
        return Walker(known, ReadyTree.of(tree, known, T), basins)

    def walk(self, robot: Model, speed: float, seconds: float, seed: int, leg: str) -> BalanceRun:
        """A robot walks on and on, from rest on one leg, until the time is over or it lies."""
        settings = RecoverySettings(
            speed=speed, steps=1000, remedy=WALKING.remedy, pull=PULL, fastest=WALKING.fastest
        )
        gains = balance_gains(self.known, settings, T)
        balancing = BalanceController(self.known, settings, gains, self.basins)
        controller = TreeController(balancing, settings)
        controller.take(self.ready)
        setup = Setup(stance=leg, on_blocks=False)
        plant = Plant(robot, setup, np.zeros(4), T, seed=seed)
        return balance(plant, HighGainObserver(self.known, setup, EPSILON), controller, seconds)


def steps_of(run: BalanceRun) -> int:
    return int(np.count_nonzero(np.diff(run.standing)))


def robot_of(effect: str, values: dict, seed: int) -> Model:
    """The nominal robot with its own numbers up to `ERROR` off, and with the effect."""
    rng = np.random.default_rng(seed)
    while True:
        robot = NOMINAL.with_values(
            {name: NOMINAL.values[name] * (1 + ERROR * rng.uniform(-1, 1)) for name in LUMPS}
        )
        try:
            robot.require_consistency()
        except ValueError:
            continue
        at = 'inner' if effect == 'payload' else None
        return robot.with_effect(effect, at, **values) if values else robot


def recorded(
    walker: Walker, robot: Model, seconds: float, seed: int, speeds: list[float]
) -> list[Record]:
    """Walks at several speeds, from either leg."""
    records = []
    for k, speed in enumerate(speeds):
        leg = STANCES[k % 2]
        run = walker.walk(robot, speed, seconds, 100 * seed + k, leg)
        records.append(record_of(f'walk_{k}', run, Setup(stance=leg, on_blocks=False)))
    return records


def on_springs(robot: Model, seconds: float, seed: int) -> list[Record]:
    """One record on either leg; springs of known stiffness measure what a walk cannot."""
    records = []
    for leg in STANCES:
        e = load_experiment(f'spring_stabilised_{leg}')
        signal = make_signal(ExcitationSettings(**e.excitation, duration=seconds, seed=seed))
        records.append(
            rehearse(f'springs_{leg}', robot, e.setup, e.initial_state, [signal], seconds, T, seed)
        )
    return records


def diagnosed(records: list[Record], effects: tuple[str, ...] | None) -> tuple[Cut, Diagnosis]:
    cut = cut_steps(records, NOMINAL)
    options = Options(workers=1, **({'effects': effects} if effects else {}))
    return cut, diagnose(NOMINAL, cut.records, options, landings=cut.landings)


def causes_of(found: Diagnosis) -> str:
    return '; '.join(
        f'{c.label}: ' + ', '.join(f'{n} {v:.3g} ± {s:.1g}' for n, (v, s, _) in
                                   c.parameters.items())
        + (f' (or {", ".join(c.rivals)})' if c.rivals else '')
        for c in found.causes
    ) or '-'  # fmt: skip


def named(walker: Walker, effect: str, options: argparse.Namespace, seed: int) -> dict:
    """What a diagnosis says of walks."""
    robot = robot_of(effect, HIDDEN[effect], seed)
    records = recorded(walker, robot, options.seconds, seed, options.speeds)
    records += on_springs(robot, options.springs, seed) if options.springs else []
    began = time.process_time()
    cut, found = diagnosed(records, None if options.library else EFFECTS)
    return {
        'part': 'named', 'hidden': effect, 'seed': seed, 'library': options.library,
        'springs': options.springs,
        'at': options.speeds,
        'walked': round(sum(r.duration for r in records), 1), 'steps': len(cut.landings),
        'verdict': found.verdict, 'named': causes_of(found),
        'causes': [c.label for c in found.causes],
        'cpu': round(time.process_time() - began),
    }  # fmt: skip


def fares(walker: Walker, robot: Model, speed: float, seed: int) -> int:
    """Steps until it falls, of STEPS."""
    run = walker.walk(robot, speed, 4.0 + STEPS * 0.3 / speed * 1.3, seed, 'inner')
    return min(STEPS, steps_of(run))


def better(nominal: Walker, mass: float, options: argparse.Namespace, seed: int) -> dict:
    """Steps with the tree of the nominal, the diagnosed and the true model."""
    robot = robot_of('payload', {'mass': mass, 'distance': 0.6}, seed)
    records = recorded(nominal, robot, options.seconds, seed, options.speeds)
    row = {
        'part': 'better', 'mass': mass, 'seed': seed,
        'walked': round(sum(r.duration for r in records), 1), 'speeds': list(options.fresh),
    }  # fmt: skip
    began = time.process_time()
    cut, found = diagnosed(records, EFFECTS)
    row |= {'landings': len(cut.landings), 'verdict': found.verdict, 'named': causes_of(found)}
    row['cpu'] = round(time.process_time() - began)
    began = time.process_time()
    for name, known in (('nominal', None), ('diagnosed', found.extended.model), ('true', robot)):
        try:
            walker = nominal if known is None else Walker.of(known, walking_tree(known, SPEEDS))
        except (PlanningError, TrajectoryError, ValueError) as error:
            row[name] = []
            print(f'{name}: {error}', file=sys.stderr)
            continue
        row[name] = [fares(walker, robot, v, 7000 + seed) for v in options.fresh]
    row['walk_cpu'] = round(time.process_time() - began)
    return row


def table(rows: list[dict], command: str) -> str:
    lines = ['# Learning from walking', '', f'`{command}`', '']
    own = [r for r in rows if r['part'] == 'named']
    lines += [
        f'Robots whose numbers are up to {ERROR:.0%} off walk under the tree of the nominal '
        'model. "few": '
        f'{len(EFFECTS)} effects are tried ({", ".join(EFFECTS)}); "all": the whole library.',
        '',
        '| hidden | robot | library | speeds, m/s | s recorded | of these on springs | steps '
        '| verdict | named | s CPU |',
        '|---|---:|---|---|---:|---:|---:|---|---|---:|',
        *(
            f'| {r["hidden"]} | {r["seed"]} | {"all" if r["library"] else "few"} '
            f'| {", ".join(f"{v:g}" for v in r["at"])} | {r["walked"]} '
            f'| {2 * r.get("springs", 0):g} | {r["steps"]} | {r["verdict"]} | {r["named"]} '
            f'| {r["cpu"]} |'
            for r in own
        ),
        '',
    ]
    own = [r for r in rows if r['part'] == 'better']
    if own:
        lines += [
            f'Steps, at most {STEPS}, with a tree for the nominal, the diagnosed and the true '
            f'model, at {", ".join(map(str, own[0]["speeds"]))} m/s:', '',
            '| payload, kg | robot | s recorded | steps | verdict | named | nominal | diagnosed '
            '| true |',
            '|---:|---:|---:|---:|---|---|---:|---:|---:|',
            *(
                f'| {r["mass"]} | {r["seed"]} | {r["walked"]} | {r["landings"]} | {r["verdict"]} '
                f'| {r["named"]} | '
                + ' | '.join(', '.join(map(str, r[k])) or 'no tree'
                             for k in ('nominal', 'diagnosed', 'true')) + ' |'
                for r in own
            ), '',
        ]  # fmt: skip
        for name in ('nominal', 'diagnosed', 'true'):
            every = [n for r in own for n in (r[name] or [0] * len(r['speeds']))]
            lines.append(
                f'- {name}: {sum(n >= STEPS for n in every)} of {len(every)} walks of '
                f'{STEPS} steps, {np.mean(every):.1f} steps on average.'
            )
    return '\n'.join(lines) + '\n'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--cases', nargs='*', default=list(HIDDEN), choices=list(HIDDEN))
    parser.add_argument('--masses', type=float, nargs='*', default=[2.0], help='kg')
    parser.add_argument('--seeds', type=int, nargs='+', default=[1])
    parser.add_argument('--seconds', type=float, default=12.0, help='of each record')
    parser.add_argument('--speeds', type=float, nargs='+', default=[0.2, 0.25, 0.3, 0.2],
                        help='of the records, m/s')  # fmt: skip
    parser.add_argument('--fresh', type=float, nargs='+', default=[0.2, 0.3], help='m/s')
    parser.add_argument(
        '--springs', type=float, default=0.0, help='s of a record on springs on each leg besides'
    )
    parser.add_argument('--library', action='store_true', help='try every effect')
    parser.add_argument('--raw', type=Path, default=Path('bench/results/walking_learn.jsonl'))
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    walker = Walker.of(NOMINAL, walking_tree(NOMINAL, SPEEDS))
    for seed in options.seeds:
        for case in (*options.cases, *options.masses):
            one = named if isinstance(case, str) else better
            row = one(walker, case, options, seed)
            print(row, flush=True)
            with options.raw.open('a') as raw:
                raw.write(json.dumps(row) + '\n')
    rows = [json.loads(line) for line in options.raw.read_text().splitlines()]
    text = table(
        rows, 'python bench/walking_learn.py --write FILE, with the options that its head lists'
    )
    print(text)
    if options.write:
        write_atomically(options.write, text)


if __name__ == '__main__':
    main()
