"""Grow a tree to upright, and write its file: docs/trees.md.

    python -m cg_control.grow_tree --goal either --samples 5000 --out tree.npz

Gains of the balance controller, basins and the box of the states are those of the compass gait. A
seed says what grows, whatever the number of workers.
"""

import argparse
import multiprocessing
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cg_control.balance import BalanceSettings, balance_gains
from cg_control.basin import sample_basin, shipped_basins
from cg_control.extension import Extension, upright_form
from cg_control.growth import Grower, GrowthOptions, Region
from cg_control.nodes import Nodes
from cg_control.tree import Tree, TreeError
from cg_control.tvlqr import Weights, balance_regulator
from cg_description.paths import model_path
from cg_dynamics.hybrid import WalkOptions
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES

GOALS = {'either': STANCES, 'inner': ('inner',), 'outer': ('outer',)}
BOX = (0.5, 0.8, 1.5, 4.0)  # rad, rad, rad/s, rad/s: Region
SWING = 0.3  # rad: amplitude of the swing leg up to which a robot counts as home
LANDING = WalkOptions(sample_time=0.002, step=0.002, minimum_step=0.1)
EVERY = 8.0  # s between lines of progress


def upright_tree(model: Model, legs: Sequence[str] = STANCES) -> Tree:
    """A tree without branches: upright on each of these legs, held by the balance controller.

    Args:
        model: A compass gait.
        legs: Those that are a goal.
    """
    gains = balance_gains(model, BalanceSettings(), LANDING.sample_time)
    basins = shipped_basins(model, gains, model.torque_limit) or {
        leg: sample_basin(model, leg, gains[leg], model.torque_limit) for leg in legs
    }
    nodes, goal = None, np.full((len(STANCES), 4, 4), np.nan)
    for leg in legs:
        modes, bound = basins[leg].modes.to_modes, basins[leg].bounds[-1]
        reach = np.array([bound, bound, SWING, SWING])  # inside the basin at any such swing
        goal[STANCES.index(leg)] = modes.T @ np.diag(reach**-2) @ modes
        root = Nodes.root(
            leg, gains[leg], balance_regulator(model, leg).S, model.hash, True,
            funnel=upright_form(model, leg, Weights()),
        )  # fmt: skip
        nodes = root if nodes is None else nodes.joined(root)
    if nodes is None:
        raise ValueError('legs is empty; one leg at least must be a goal')
    return Tree(nodes, goal, {'model': model.name})


class Growing:
    """Says every few seconds how far a tree is, from a thread of its own.

    Args:
        grower: Of the tree.
        samples: How many states are to be drawn.
    """

    def __init__(self, grower: Grower, samples: int):
        self._grower, self._samples, self._began = grower, samples, time.monotonic()
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name='progress', daemon=True)

    def __enter__(self) -> 'Growing':
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def __str__(self) -> str:
        counts = self._grower.counts
        done = min(counts.samples, self._samples)
        return (
            f'grow_tree: {time.monotonic() - self._began:.0f} s: {done} of {self._samples} states '
            f'done, {self._samples - done} left; {counts.grown} branches, '
            f'{len(self._grower.nodes)} nodes'
        )

    def _run(self) -> None:
        while not self._over.wait(EVERY):
            print(self, file=sys.stderr, flush=True)


def grow(model: Model, goal: str, samples: int, seed: int, workers: int = 1) -> Tree:
    """A tree of so many states, in whole rounds.

    Args:
        model: A compass gait.
        goal: 'either', 'inner' or 'outer': the leg on which it is to stand upright.
        samples: Least number of states that are drawn.
        seed: Of all that is drawn.
        workers: Processes; the tree does not depend on them.
    """
    legs = GOALS[goal]
    extension = Extension(model, legs, workers=workers)
    try:
        grower = Grower(
            model, upright_tree(model, legs), Region(np.array(BOX)), extension,
            GrowthOptions(seed=seed, at_once=16), simulation=LANDING, threads=workers,
        )  # fmt: skip
        with Growing(grower, samples):
            while grower.counts.samples < samples:
                grower.round()
    finally:
        extension.close()
    told = {
        'command': f'grow_tree --goal {goal} --samples {samples} --seed {seed}',
        'box': list(BOX),
        'counts': vars(grower.counts),
    }
    return replace(grower.tree, provenance={**grower.tree.provenance, **told})


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_control grow_tree`."""
    parser = argparse.ArgumentParser(prog='grow_tree', description=__doc__)
    parser.add_argument(
        '--model', default='compass_gait_mit', help='a file or a name [compass_gait_mit]'
    )
    parser.add_argument('--goal', choices=sorted(GOALS), default='either', help='leg [either]')
    parser.add_argument('--samples', type=int, default=5000, help='states to draw [5000]')
    parser.add_argument('--seed', type=int, default=0, help='of all that is drawn [0]')
    parser.add_argument(
        '--workers', type=int, default=multiprocessing.cpu_count(), help='processes [all cores]'
    )
    parser.add_argument('--out', type=Path, required=True, help='file to write, .npz')
    options = parser.parse_args(args)
    try:
        model = Model.load(model_path(options.model))
        if options.samples < 1 or options.workers < 1:
            raise ValueError('--samples and --workers must be 1 or more')
        if not options.out.absolute().parent.is_dir():
            raise TreeError(f'{options.out}: there is no such directory')
        tree = grow(model, options.goal, options.samples, options.seed, options.workers)
        tree.save(options.out)
    except (ValueError, OSError) as error:
        print(f'grow_tree: {error}', file=sys.stderr)
        return 2
    print(
        f'grow_tree: {options.out}: {len(tree.nodes)} nodes in {int(tree.nodes.branch.max())} '
        f'branches, upright on the {" or ".join(tree.legs)} leg'
    )
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
