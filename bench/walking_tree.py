"""Robots that are pushed while they walk: the gains of an orbit alone, and trees.

    python bench/walking_tree.py [--tree FILE ...] [--phases 8] [--write]

The loop is that of the nodes without ROS (cg_bringup/balancing.py), 500 Hz in lock-step: a robot
walks on an orbit for one period, is pushed at the hip at an instant of the next one, and has
`AFTER` seconds. It *walks* if it is at the end on the orbit that is wanted, or on its way there,
and has not fallen; it walks *directly* if the balance controller has not held it since the push,
and *by way of upright* otherwise. It *stands* if the balance controller holds it at the end. Steps
are counted from the push to the first sample after which it is in a tube for half a second.

`gains alone` is the same controller on a tree of orbits without previews, that leaves no tube.

*Previews* are of states around the orbits, drawn as in the growth of a tree with another seed.
"""

import argparse
import platform
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from trees_live import Known, share

from cg_bringup.balancing import balance
from cg_control.balancing.balance import BALANCING, BalanceController, balance_gains
from cg_control.balancing.basin import shipped_basins
from cg_control.following.nodes import Way
from cg_control.following.tracking import WALKING
from cg_control.grow_tree import AROUND, REGION
from cg_control.trees.preview import LANDING, Preview
from cg_control.trees.recovery import FOLLOWING, ReadyTree, RecoverySettings, TreeController
from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import tree_path
from cg_control.walking.walking_region import OrbitPoints, WalkingRegion
from cg_description.model_file import write_atomically
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import STANCES, Setup
from cg_estimation.high_gain import HighGainObserver

SPEEDS = (0.25, 0.35)  # m/s
DRAWN, SEED = 2000, 99  # states that are previewed
IMPULSES = (-6.0, -4.0, -2.0, 2.0, 4.0, 6.0)  # N s
AFTER = 6.0  # s
HELD = 0.5  # s in a tube that count as back
EPSILON = 0.01  # s, of the observer
RESULT = Path(__file__).parent / 'results' / 'walking_tree.md'
MODEL = Model.load(model_path('compass_gait_mit'))
ON_ORBITS = RecoverySettings()
GAINS = balance_gains(MODEL, ON_ORBITS, LANDING.sample_time)
BASINS = shipped_basins(MODEL, GAINS, MODEL.torque_limit)


@dataclass(frozen=True)
class Fared:
    """One robot: whether it walks or stands at the end, whether it stood, its steps."""

    walks: bool
    stands: bool
    stood: bool
    steps: int | None


def pushed(
    ready: ReadyTree,
    speed: float,
    phase: float,
    impulse: float,
    known: bool,
    alone: bool,
    seed: int,
) -> Fared:
    """One run of the loop.

    Args:
        ready: The tree.
        speed: Of one of its orbits, m/s.
        phase: At which the push comes, as a share of the period.
        impulse: N s.
        known: The state is known; otherwise observer and noise.
        alone: The gains of the orbit alone.
        seed: Of the noise.
    """  # fmt: skip
    nodes = ready.tree.nodes
    orbit = ready.routes.home_at(speed)
    start = int(nodes.phase_starts(orbit)[0])
    period = nodes.span[nodes.orbiting & ~nodes.impact & (nodes.orbit_of == orbit)].sum()
    when = period * (1 + phase)
    setup = Setup(stance=STANCES[nodes.stance[start]], on_blocks=False)
    x = nodes.x0[start].copy()
    plant = Plant(MODEL, setup, x, seed=seed, minimum_step=LANDING.minimum_step)
    observer = Known(plant) if known else HighGainObserver(MODEL, setup, EPSILON)
    settings = replace(ON_ORBITS, speed=speed)
    if alone:
        settings = replace(settings, preview=False, hold=1e6, margin=1e6)
    controller = TreeController(BalanceController(MODEL, settings, GAINS, BASINS), settings)
    controller.take(ready)
    rows, step = [], controller.step

    def noted(stamp_ns, stance, x):
        command = step(stamp_ns, stance, x)
        tube = controller.way == Way.ORBIT and controller.depth <= 1.0
        rows.append((stamp_ns * 1e-9, controller.mode, controller.way, tube, stance))
        return command

    controller.step = noted
    run = balance(plant, observer, controller, when + AFTER, ((when, impulse),))
    time, modes, ways, tube, stance = (np.array(column) for column in zip(*rows, strict=True))
    after = time >= when
    lasted = run.time[-1] > when + AFTER - 0.01
    stood = bool((modes[after] == BALANCING).any())
    walks = bool(lasted and modes[-1] == FOLLOWING and ways[-1] != Way.UPRIGHT)
    return Fared(
        walks, bool(lasted and modes[-1] == BALANCING), stood,
        _steps(time[after], tube[after], stance[after]) if walks else None,
    )  # fmt: skip


def _steps(time: np.ndarray, tube: np.ndarray, stance: np.ndarray) -> int | None:
    """Steps until the robot is in a tube for HELD seconds; None if it never is."""
    out = np.flatnonzero(~tube)
    edges = np.concatenate([[-1], out, [len(tube)]])
    for first, last in zip(edges[:-1] + 1, edges[1:] - 1, strict=True):
        if last > first and time[last] - time[first] >= HELD:
            return int((stance[1 : first + 1] != stance[:first]).sum())
    return None


def orbits_only(tree: Tree) -> Tree:
    """The orbits of a tree, without any way."""
    nodes, _ = tree.nodes.pruned(np.empty(0, int))
    return replace(tree, nodes=nodes, champions=np.zeros((len(STANCES), 0), np.int32))


def row(name: str, what: str, fared: Sequence[Fared]) -> str:
    """A row of the table."""
    count = len(fared)
    steps = [f.steps for f in fared if f.walks and not f.stood and f.steps is not None]
    walks = [f for f in fared if f.walks]
    taken = f'{np.median(steps):.0f}, {max(steps)}' if steps else ''
    return (
        f'| {name} | {what} | {share(len(walks) + sum(f.stands for f in fared), count)} '
        f'| {sum(not f.stood for f in walks)} | {sum(f.stood for f in walks)} '
        f'| {sum(f.stands for f in fared)} | {taken} |'
    )


def previews(trees: dict[str, Tree]) -> list[str]:
    """Table: of states around orbits, those that a preview leads back to one, and home."""
    first = next(iter(trees.values()))
    region = WalkingRegion(REGION.half, orbits=OrbitPoints(first.nodes), around=np.array(AROUND))
    leg, x = region.draw_walking(np.random.default_rng(SEED), DRAWN)
    lines = ['', '| previews | to an orbit | to an orbit or upright |', '|---|---|---|']
    for name, tree in trees.items():
        found = Preview(tree, MODEL, WALKING).choose(leg, x, walking=True)
        home = found >= 0
        onto = home & (tree.nodes.ways[found] != Way.UPRIGHT)
        lines.append(
            f'| {name} | {share(int(onto.sum()), DRAWN)} | {share(int(home.sum()), DRAWN)} |'
        )
    return lines


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--tree', nargs='+', default=['compass_gait_mit_walk'], metavar='FILE')
    parser.add_argument('--phases', type=int, default=8)
    parser.add_argument('--write', action='store_true', help=f'write {RESULT.name}')
    options = parser.parse_args()
    trees = {Path(name).stem: Tree.load(tree_path(name), MODEL) for name in options.tree}
    first = next(iter(trees.values()))
    laws = {'gains alone': (ReadyTree.of(orbits_only(first), MODEL), True)}
    laws |= {name: (ReadyTree.of(tree, MODEL), False) for name, tree in trees.items()}
    told = [f'{n}: {len(t.nodes)} nodes, {t.nodes.branches} branches' for n, t in trees.items()]
    lines = [
        '# Pushed while walking',
        '',
        f'`python bench/walking_tree.py --tree {" ".join(options.tree)} --phases '
        f'{options.phases} --write`, Python {platform.python_version()}. What is counted is said '
        f'at the top of the script. {"; ".join(told)}. {options.phases} instants of the period, '
        f'{len(IMPULSES)} pushes from {IMPULSES[0]:g} to {IMPULSES[-1]:g} N s.',
        '',
        '| law | state, speed | did not fall | walks, directly | by way of upright | stands '
        '| steps until back, median, most |',
        '|---|---|---|---:|---:|---:|---|',
    ]
    small = []
    for known in (True, False):
        for speed in SPEEDS:
            for name, (ready, alone) in laws.items():
                fared = {
                    (k, impulse): pushed(
                        ready, speed, (k + 0.5) / options.phases, impulse, known, alone, k + 1
                    )
                    for k in range(options.phases) for impulse in IMPULSES
                }  # fmt: skip
                what = f'{"known" if known else "observer, noise"}, {speed:g} m/s'
                lines.append(row(name, what, list(fared.values())))
                print(lines[-1], flush=True)
                upheld = [
                    sum(f.walks or f.stands for (_, i), f in fared.items() if i == impulse)
                    for impulse in IMPULSES
                ]
                small.append(f'| {name} | {what} | {" | ".join(map(str, upheld))} |')
    lines += [
        '',
        f'Of {options.phases} robots each, those that did not fall, by the push in N s:',
        '',
        f'| law | state, speed | {" | ".join(f"{i:g}" for i in IMPULSES)} |',
        f'|---|---|{"---:|" * len(IMPULSES)}',
        *small,
        *previews(trees),
    ]
    if options.write:
        write_atomically(RESULT, '\n'.join(lines) + '\n')


if __name__ == '__main__':
    main()
