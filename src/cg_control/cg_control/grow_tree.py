"""Grow a tree to upright, or onto the orbits of one that walks: trees.md, walking.md.

    python -m cg_control.grow_tree --goal either --samples 5000 --out tree.npz
    python -m cg_control.grow_tree --onto walk.npz --samples 4096 --out grown.npz

Gains of the balance controller, basins and the box of the states are those of the compass gait. A
seed says what grows, whatever the number of workers, and however often the growth is stopped or
killed: the same command goes on where it was, from a checkpoint beside the file.
"""

import argparse
import math
import multiprocessing
import sys
import threading
import time
from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cg_control.balancing.balance import BalanceSettings, balance_gains
from cg_control.balancing.basin import sample_basin, shipped_basins
from cg_control.following.nodes import Nodes, Way
from cg_control.following.tracking import WALKING
from cg_control.trajectories.tvlqr import Weights, balance_regulator
from cg_control.trees.checkpoint import Checkpoint, Keeper
from cg_control.trees.cluster import Cluster
from cg_control.trees.extension import Extension, ExtensionOptions, upright_form
from cg_control.trees.growth import Counts, Grower, GrowthOptions, Region
from cg_control.trees.preview import CHAMPIONS, LANDING, WALKERS, Preview, champions, pruned
from cg_control.trees.tree import Tree, TreeError
from cg_control.walking.walking_region import OrbitPoints, WalkingRegion
from cg_description.paths import model_path
from cg_dynamics.cluster import ClusterError
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_dynamics.stop_request import Stopped, raise_if_stopped, stopped_by_signals
from cg_dynamics.watched_processes import LIMIT, WatchedProcesses

GOALS = {'either': STANCES, 'inner': ('inner',), 'outer': ('outer',)}
BOX = (0.5, 0.8, 1.5, 4.0)  # rad, rad, rad/s, rad/s: Region
REGION = Region(np.array(BOX), near=0.5)
AROUND = (0.15, 0.3, 1.2, 3.0)  # likewise, of deviations from an orbit: WalkingRegion
SWING = 0.3  # rad: amplitude of the swing leg up to which a robot counts as home
GROWTH = GrowthOptions(at_once=16)
ORBITS = 2  # that are tried for a state
RESERVE = 20  # ways upright of each leg, for robots that no way leads back to an orbit
EVERY = 8.0  # s between lines of progress
WRITTEN = 10.0  # s between checkpoints, at least
RECENT = 5  # rounds over which the coverage is counted that they tell
SAMPLE = 3000  # states that the champions are chosen by
CHAMPIONSHIP = 1 << 32  # in place of the number of a round


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
        self._recent: tuple[Counts, ...] = ()
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
            f'{len(self._grower.nodes)} nodes{self._given_up()}{self._coverage()}'
        )

    def count(self, counts: Counts) -> None:
        """Take in what a round came to."""
        self._recent = (*self._recent, counts)[-RECENT:]

    def _given_up(self) -> str:
        given_up = self._grower.counts.given_up
        return f', {given_up} states given up' if given_up else ''

    def _coverage(self) -> str:
        """An estimate of the share that the tree brings home of what can be brought home."""
        recent = self._recent
        drawn, claimed, previewed, new = (
            sum(getattr(c, name) for c in recent)
            for name in ('samples', 'covered', 'previewed', 'grown')
        )
        home = claimed + previewed
        if not home + new:
            return ''
        return (
            f'; of the last {drawn} states {home + new} can be brought home, as far as is known, '
            f'and the tree brought home {100 * home / (home + new):.0f} % of these by itself'
        )

    def _run(self) -> None:
        while not self._over.wait(EVERY):
            print(self, file=sys.stderr, flush=True)


def grow(
    model: Model,
    goal: str,
    samples: int,
    seed: int,
    executor: Executor | None = None,
    threads: int = 1,
    checkpoint: Path | None = None,
    branches: int = 0,
    onto: Tree | None = None,
) -> Tree:
    """A tree of so many states, in whole rounds.

    Args:
        model: A compass gait.
        goal: 'either', 'inner' or 'outer': the leg on which it is to stand upright. That of
            `onto`, where it is given.
        samples: Least number of states that are drawn.
        seed: Of all that is drawn.
        executor: Whose workers plan; None plans here. The tree does not depend on it,
        threads: nor on how many threads simulate.
        checkpoint: File to go on from, if it is there, and to write every few seconds, and where
            this ends before the tree is grown, for whatever reason. It stays when it is grown.
        branches: Keep so many of each leg, the champions, and those that they end on; 0: all.
        onto: Tree with orbits that grows on: from robots that are pushed while they walk, too.

    Raises:
        TreeError: The checkpoint is damaged, or of a tree that was begun otherwise.
    """
    legs, keeper, saved = GOALS[goal], None, None
    if checkpoint is not None:
        keeper = Keeper(checkpoint, WRITTEN)
        if checkpoint.exists():
            saved = Checkpoint.load(checkpoint, model)
    options = ExtensionOptions() if onto is None else ExtensionOptions(orbits=ORBITS)
    extension = Extension(model, legs, options, executor)
    grower = _planted(model, onto, goal, extension, seed, threads)
    more = {'goal': goal, 'extension': extension.options}
    if saved is not None:
        _require_same(saved, Checkpoint.of(grower, **more), samples, checkpoint)
        grower = saved.resumed(grower)
    try:
        with Growing(grower, samples) as growing:
            while grower.counts.samples < samples:
                growing.count(grower.round())
                if keeper is not None:
                    keeper.keep(Checkpoint.of(grower, **more))
                raise_if_stopped()
    finally:
        if keeper is not None:
            keeper.write()
    tree = grower.tree
    rng = np.random.default_rng([seed, CHAMPIONSHIP])
    if isinstance(grower.region, WalkingRegion):
        sample = grower.region.draw_walking(rng, SAMPLE)
        preview = Preview(tree, model, WALKING, threads=threads)
        order = walking_champions(preview, *sample, branches or WALKERS)
    else:
        sample = grower.region.draw(rng, SAMPLE)
        preview = Preview(tree, model, threads=threads)
        order = champions(preview, *sample, count=branches or CHAMPIONS)
    tree = replace(tree, champions=order)
    if branches:
        tree = pruned(tree)
    return replace(tree, provenance={
        **tree.provenance, **_drawn(onto), 'counts': vars(grower.counts),
        'command': f'grow_tree {f"--goal {goal}" if onto is None else "--onto TREE"} '
        f'--samples {samples} --seed {seed} --branches {branches}',
    })  # fmt: skip


def _planted(
    model: Model, onto: Tree | None, goal: str, extension: Extension, seed: int, threads: int
) -> Grower:
    """What grows from these homes."""
    options = replace(GROWTH, seed=seed)
    if onto is None:
        return Grower(
            model, upright_tree(model, GOALS[goal]), REGION, extension, options,
            simulation=LANDING, threads=threads,
        )  # fmt: skip
    region = WalkingRegion(
        REGION.half, near=REGION.near, orbits=OrbitPoints(onto.nodes), around=np.array(AROUND)
    )
    if onto.legs != GOALS[goal]:
        raise ValueError(f'goal is {goal!r}; the tree is upright on {" or ".join(onto.legs)}')
    # No state is planned for that the tree brings home already, as far as previews go.
    options = replace(options, dense=0)
    return Grower(
        model, onto, region, extension, options, settings=WALKING, simulation=LANDING,
        threads=threads,
    )  # fmt: skip


def walking_champions(preview: Preview, leg: np.ndarray, x: np.ndarray, count: int) -> np.ndarray:
    """Champions of a tree that walks: those it has, then those to orbits, then some to upright.

    Args:
        preview: Of the tree.
        leg: Legs that stand, of a sample of robots that were pushed, shape (B,).
        x: The sample, shape (B, nx).
        count: How many of each leg lead to orbits.

    Returns:
        Shape (2, m), -1 for none.
    """
    nodes = preview.tree.nodes
    upright = nodes.ways[nodes.entries] == Way.UPRIGHT
    onto = champions(preview, leg, x, count, nodes.entries[~upright])
    lost = preview.choose(leg, x, onto[onto >= 0]) < 0
    rest = champions(preview, leg[lost], x[lost], RESERVE, nodes.entries[upright])
    found = [preview.tree.champions, onto, np.where(
        np.isin(rest, preview.tree.champions), -1, rest
    )]  # fmt: skip
    return np.hstack(found).astype(np.int32)


def _drawn(onto: Tree | None) -> dict[str, Any]:
    """What the file says of the states that were drawn, and of what the tree grew on."""
    if onto is None:
        return {'box': list(BOX)}
    return {'box': list(BOX), 'around': list(AROUND), 'onto': dict(onto.provenance)}


def _require_same(saved: Checkpoint, here: Checkpoint, samples: int, path: Path | None) -> None:
    """Refuse to go on from what would not become the tree that is asked for; else say so."""
    done = saved.counts.samples
    try:
        saved.require(here.decided)
        if done - GROWTH.round_size >= samples:
            raise TreeError(
                f'{done} states are drawn already, but asked for are only {samples}; ask for as '
                'many, or delete the file and begin anew'
            )
    except TreeError as error:
        raise TreeError(f'{path}: {error}') from None
    print(
        f'grow_tree: goes on from {path}: {done} of {samples} states are done',
        file=sys.stderr, flush=True,
    )  # fmt: skip


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_control grow_tree`."""
    parser = argparse.ArgumentParser(prog='grow_tree', description=__doc__)
    parser.add_argument(
        '--model', default='compass_gait_mit', help='a file or a name [compass_gait_mit]'
    )
    parser.add_argument('--goal', choices=sorted(GOALS), default='either', help='leg [either]')
    parser.add_argument(
        '--onto', type=Path, metavar='FILE',
        help='tree of plan_walk that grows on, with ways back to its orbits',
    )  # fmt: skip
    parser.add_argument('--samples', type=int, default=5000, help='states to draw [5000]')
    parser.add_argument(
        '--branches', type=int, default=0,
        help='keep so many of each leg, those that bring most states home [0: all]',
    )  # fmt: skip
    parser.add_argument('--seed', type=int, default=0, help='of all that is drawn [0]')
    parser.add_argument('--workers', type=int, help='local processes [one per core]')
    parser.add_argument(
        '--scheduler', metavar='ADDRESS',
        help='plan on the workers of this dask scheduler instead, such as tcp://127.0.0.1:8786',
    )  # fmt: skip
    parser.add_argument(
        '--limit', type=float, default=LIMIT, metavar='S',
        help='time after which planning for one state is given up, s [%(default)g]',
    )  # fmt: skip
    parser.add_argument('--out', type=Path, required=True, help='file to write, .npz')
    parser.add_argument(
        '--checkpoint', type=Path, metavar='FILE',
        help='file that a stopped growth goes on from; gone when the tree is grown [OUT.part]',
    )  # fmt: skip
    options = parser.parse_args(args)
    checkpoint = options.checkpoint or options.out.with_name(f'{options.out.name}.part')
    cores = multiprocessing.cpu_count()
    try:
        model = Model.load(model_path(options.model))
        _require_sound(options, checkpoint)
        onto = Tree.load(options.onto, model) if options.onto else None
        with (
            stopped_by_signals(),
            Cluster(options.scheduler, options.limit)
            if options.scheduler is not None
            else WatchedProcesses(options.workers or cores, options.limit) as executor,
        ):
            tree = grow(
                model, options.goal, options.samples, options.seed, executor,
                options.workers or cores, checkpoint, options.branches, onto,
            )  # fmt: skip
            tree.save(options.out)
            checkpoint.unlink(missing_ok=True)
    except Stopped as stopped:
        print(f'grow_tree: {stopped}; {_then(checkpoint)}', file=sys.stderr)
        return stopped.status
    except ClusterError as error:
        then = f'; {_then(checkpoint)}' if checkpoint.exists() else ''
        print(f'grow_tree: {error}{then}', file=sys.stderr)
        return 2
    except (ValueError, OSError) as error:
        print(f'grow_tree: {error}', file=sys.stderr)
        return 2
    print(
        f'grow_tree: {options.out}: {len(tree.nodes)} nodes in {tree.nodes.branches} branches, '
        f'upright on the {" or ".join(tree.legs)} leg'
    )
    return 0


def _require_sound(options: argparse.Namespace, checkpoint: Path) -> None:
    """Refuse what cannot be grown or written, before it takes hours."""
    if options.scheduler is not None and options.workers is not None:
        raise ValueError('--workers are local processes; leave it out where --scheduler is given')
    if options.branches < 0:
        raise ValueError(f'--branches is {options.branches}; it must be 0 (all) or more')
    if options.samples < 1 or (options.workers is not None and options.workers < 1):
        raise ValueError('--samples and --workers must be 1 or more')
    if not 0 < options.limit < math.inf:
        raise ValueError(f'--limit is {options.limit:g} s; it must be positive and finite')
    for path in (options.out, checkpoint):
        if not path.absolute().parent.is_dir():
            raise TreeError(f'{path}: there is no such directory')
    if checkpoint.absolute() == options.out.absolute():
        raise ValueError('--checkpoint and --out must be two files')


def _then(checkpoint: Path) -> str:
    """How to go on."""
    if not checkpoint.exists():
        return 'no round is finished, so the same command begins anew'
    return f'the tree so far is in {checkpoint}, and the same command goes on from there'


if __name__ == '__main__':
    raise SystemExit(main())
