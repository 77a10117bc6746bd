"""Recovery along a tree, in the loop: what it claims with an observer and noise, and pushes.

    python bench/trees_live.py [--tree NAME] [--starts 200] [--pushes 20] [--write]

The loop is that of the nodes without ROS (cg_bringup/balancing.py): simulated sensors with their
noise and quantisation, observer, tree controller, torque gate, 500 Hz in lock-step. *Starts* are
states outside the goal regions that a preview brings home, drawn from the box in which the tree
was grown. A robot came home if it is upright for the last half second of 4 s.
*Pushes* hit the hip of a robot that stands upright, forward and backward in turn, on either leg.
"""

import argparse
import multiprocessing
import platform
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import beta

from cg_bringup.balancing import BalanceRun, balance
from cg_bringup.recover_run import RecoverOptions, start_of
from cg_control.balancing.balance import BalanceController, BalanceSettings, balance_gains
from cg_control.balancing.basin import shipped_basins
from cg_control.trees.preview import LANDING
from cg_control.trees.recovery import ReadyTree, RecoverySettings, TreeController
from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import tree_path
from cg_description.model_file import write_atomically
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import STANCES, Setup
from cg_estimation.estimator import Estimate
from cg_estimation.high_gain import HighGainObserver

DURATION = 4.0  # s
PUSHED_AT = 0.5  # s
IMPULSES = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0)  # N s
EPSILONS = (0.01, 0.02, 0.2)  # s
UPRIGHT = 0.2  # rad of both legs, for the last half second
RESULT = Path(__file__).parent / 'results' / 'trees_live.md'
MODEL = Model.load(model_path('compass_gait_mit'))
GAINS = balance_gains(MODEL, BalanceSettings(), LANDING.sample_time)
BASINS = shipped_basins(MODEL, GAINS, MODEL.torque_limit)


class Known:
    """In place of an observer: the true state of the machine."""

    def __init__(self, plant: Plant):
        self._plant = plant

    def step(self, stamp_ns, torque, outputs, stance):
        """The state as it is."""
        return Estimate(stamp_ns, stance, self._plant.state[:4].copy(), stamp_ns * 1e-9, 0.0)


@dataclass(frozen=True)
class Fared:
    """One robot."""

    home: bool
    switches: int
    outside: int


def in_the_loop(
    ready: ReadyTree | None,
    stance: str,
    x,
    epsilon: float | None,
    seed: int,
    pushes=(),
    settings: RecoverySettings | None = None,
    duration: float = DURATION,
) -> tuple[BalanceRun, BalanceController | TreeController]:
    """One run of the loop, and the controller that was in it.

    Args:
        ready: The tree; None: the balance controller alone.
        stance: Leg that stands at the start.
        x: State, shape (4,).
        epsilon: Of the observer, s; None: the state is known.
        seed: Of the noise.
        pushes: Instants in s and impulses in N s.
        settings: Of the tree controller.
        duration: In s.
    """
    setup = Setup(stance=stance, on_blocks=False)
    plant = Plant(MODEL, setup, np.asarray(x, float), seed=seed, minimum_step=LANDING.minimum_step)
    observer = Known(plant) if epsilon is None else HighGainObserver(MODEL, setup, epsilon)
    settings = settings or RecoverySettings()
    balancing = BalanceController(MODEL, settings, GAINS, BASINS)
    controller: BalanceController | TreeController = balancing
    if ready is not None:
        controller = TreeController(balancing, settings)
        controller.take(ready)
    return balance(plant, observer, controller, duration, pushes), controller


def recovered(
    ready: ReadyTree | None,
    stance: str,
    x,
    epsilon: float | None,
    seed: int,
    pushes=(),
    settings: RecoverySettings | None = None,
) -> Fared:
    """How one run of the loop ends; arguments as `in_the_loop`."""
    run, controller = in_the_loop(ready, stance, x, epsilon, seed, pushes, settings)
    switches = getattr(controller, 'switches', 0)
    return Fared(came_home(run), switches, int((run.torque == 0.0).sum()))


def came_home(run: BalanceRun) -> bool:
    """Whether the robot stands at the end, whichever law holds it up."""
    tail = run.time > run.time[-1] - 0.5
    lasted = run.time[-1] > DURATION - 0.01
    return bool(lasted and np.abs(run.states[tail, :2]).max() < UPRIGHT and run.torque[-1] != 0.0)


def share(hits: int, of: int) -> str:
    """So many of so many, with the Clopper-Pearson interval of 95 %."""
    low = beta.ppf(0.025, hits, of - hits + 1) if hits else 0.0
    high = beta.ppf(0.975, hits + 1, of - hits) if hits < of else 1.0
    return f'{hits} of {of} = {hits / of:.0%} ({low:.0%} to {high:.0%})'


def starts_table(tree: Tree, count: int) -> list[str]:
    """Rows: what is known of the state, who came home."""
    starts = [start_of(tree, MODEL, seed) for seed in range(1, count + 1)]
    ready = ReadyTree.of(tree, MODEL)
    rows = []
    for epsilon in (None, *EPSILONS):
        fared = [
            recovered(ready, stance, x, epsilon, seed)
            for seed, (stance, x) in enumerate(starts, start=1)
        ]
        what = 'state known' if epsilon is None else f'observer, eps {epsilon:g} s, noise'
        switches = [f.switches for f in fared if f.home]
        rows.append(
            f'| {what} | {share(sum(f.home for f in fared), count)} '
            f'| {np.mean(switches):.2f} | {np.max(switches)} |'
        )
        print(rows[-1], flush=True)
    return rows


def pushes_table(tree: Tree, count: int) -> list[str]:
    """Rows: impulse, who stands, with and without the tree."""
    ready, rows = ReadyTree.of(tree, MODEL), []
    for impulse in IMPULSES:
        found = []
        for followed in (None, ready):
            fared = [
                recovered(followed, STANCES[k % 2], np.zeros(4), EPSILONS[0], k + 1,
                          ((PUSHED_AT, impulse if k % 4 < 2 else -impulse),))
                for k in range(count)
            ]  # fmt: skip
            found.append(share(sum(f.home for f in fared), count))
        rows.append(f'| {impulse:g} | {found[0]} | {found[1]} |')
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--tree', default=RecoverOptions().tree, help='a file or a name')
    parser.add_argument('--starts', type=int, default=200)
    parser.add_argument('--pushes', type=int, default=20, help='robots an impulse')
    parser.add_argument('--write', action='store_true')
    options = parser.parse_args()
    tree = Tree.load(tree_path(options.tree), MODEL)
    text = '\n'.join([
        '# Recovery along a tree, in the loop',
        '',
        f'`python bench/trees_live.py --tree {options.tree} --starts {options.starts} --pushes '
        f'{options.pushes} --write`, Python {platform.python_version()}, '
        f'{multiprocessing.cpu_count()} cores. What is counted is said at the top of the script. '
        f'Tree: {len(tree.nodes)} nodes, {tree.nodes.branches} branches.',
        '',
        '| starts that the tree brings home | came home | node switches, mean | largest |',
        '|---|---|---:|---:|',
        *starts_table(tree, options.starts),
        '',
        f'| push, N s | balance alone | tree (observer, eps {EPSILONS[0]:g} s) |',
        '|---:|---|---|',
        *pushes_table(tree, options.pushes),
        '',
    ])  # fmt: skip
    print(text)
    if options.write:
        write_atomically(RESULT, text)


if __name__ == '__main__':
    main()
