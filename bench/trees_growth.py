"""A tree to both legs: how it grows, what it covers, how often its claims are false.

    python bench/trees_growth.py [--samples 20000] [--workers 2] [--write] [--tree FILE]

States are drawn as in bench/trees_screen.py, whose census of many guesses is what the tree is held
against (results/tree_census.jsonl: 640 states of the seeds 46 and 47, which neither this bench nor
the tree draws; a state counts as feasible if a motion of no or of one step was found, on the robot
without friction). *Covered* is the share of the feasible states that the tree claims and the exact
hybrid robot, friction included, brings home from there. *False* is the share of claims, of states
drawn anew, from which it does not come home.

*Funnels* claim what their ellipsoids hold. *Previews* (preview.py) claim what comes home from an
entry of the tree when it is simulated; whether that is true is judged by a simulation of its own,
in steps of 0.25 ms in place of 2 ms. At last the tree is pruned to the branches of the champions.
CPU time is that of all processes, without that of the judging.
"""

import argparse
import json
import multiprocessing
import platform
import resource
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.stats import beta

from cg_control.grow_tree import BOX, CHAMPIONSHIP, GROWTH, REGION, SAMPLE, upright_tree
from cg_control.trees.extension import Extension
from cg_control.trees.growth import Grower, Region
from cg_control.trees.lookup import Lookup
from cg_control.trees.preview import CHAMPIONS, LANDING, Preview, champions, pruned
from cg_control.trees.tree import Tree
from cg_description.model_file import write_atomically
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_dynamics.watched_processes import WatchedProcesses

HALF = np.array(BOX)
FINE = replace(LANDING, step=LANDING.step / 8)
JUDGED = 20000  # states drawn for the false claims
MARKS = 10  # rows of the growth curve
KEPT = (20, 40, 60, 100)  # champions of each leg in pruned trees
THREADS = multiprocessing.cpu_count()
MODEL = Model.load(model_path('compass_gait_mit'))
FOLDER = Path(__file__).parent / 'results'


@dataclass(frozen=True)
class Share:
    """So many of so many, with the Clopper-Pearson interval of 95 %."""

    hits: int
    of: int

    def __str__(self) -> str:
        low = beta.ppf(0.025, self.hits, self.of - self.hits + 1) if self.hits else 0.0
        high = beta.ppf(0.975, self.hits + 1, self.of - self.hits) if self.hits < self.of else 1.0
        share = self.hits / max(self.of, 1)
        return f'{self.hits} of {self.of} = {share:.1%} ({low:.1%} to {high:.1%})'


def census() -> tuple[np.ndarray, np.ndarray]:
    """Legs and states of the census from which a motion was found."""
    rows = [json.loads(line) for line in (FOLDER / 'tree_census.jsonl').read_text().splitlines()]
    rows = [row for row in rows if any(row['feasible'])]
    return (
        np.array([STANCES.index(row['stance']) for row in rows]),
        np.array([row['x'] for row in rows]),
    )


def by_funnels(tree: Tree, leg: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether states are claimed by funnels, and whether the claimed ones come home."""
    grower = Grower(MODEL, tree, Region(HALF), lambda *_: [], threads=THREADS)
    node, depth = Lookup(tree.nodes).best_of_many(leg, x)
    claimed = depth <= 1.0
    home = np.zeros(len(leg), bool)
    home[claimed] = grower.bring_home(node[claimed], x[claimed], learn=False)
    return claimed, home


def by_previews(tree: Tree, leg: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same of previews, judged by a finer simulation."""
    entry = Preview(tree, MODEL, threads=THREADS).choose(leg, x)
    claimed = entry >= 0
    home = np.zeros(len(leg), bool)
    judge = Preview(tree, MODEL, simulation=FINE, threads=THREADS)
    home[claimed] = judge.brings_home(entry[claimed], x[claimed])
    return claimed, home


Policy = Callable[[Tree, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]


def judged(tree: Tree, policy: Policy) -> tuple[Share, Share]:
    """Covered share of the feasible census, share of false claims."""
    _, home = policy(tree, *census())
    claimed, came = policy(tree, *Region(HALF).draw(np.random.default_rng([777, 1]), JUDGED))
    false = claimed & ~came
    return Share(int(home.sum()), len(home)), Share(int(false.sum()), int(claimed.sum()))


def with_champions(tree: Tree, count: int) -> Tree:
    """The tree with so many champions of each leg."""
    sample = REGION.draw(np.random.default_rng([0, CHAMPIONSHIP]), SAMPLE)
    found = champions(Preview(tree, MODEL, threads=THREADS), *sample, count=count)
    return replace(tree, champions=found)


def grow(samples: int, workers: int) -> tuple[Tree, list[str], str]:
    """A tree, the rows of its growth curve and a sentence about its cost."""
    processes = WatchedProcesses(workers)
    grower = Grower(
        MODEL, upright_tree(MODEL), REGION, Extension(MODEL, executor=processes), GROWTH,
        threads=workers,
    )  # fmt: skip
    rows: list[str] = []
    marks = np.unique(np.geomspace(grower.options.round_size, samples, MARKS).astype(int))
    wall = cpu = 0.0
    while grower.counts.samples < samples:
        began = time.perf_counter(), time.process_time()
        grower.round()
        wall, cpu = wall + time.perf_counter() - began[0], cpu + time.process_time() - began[1]
        counts = grower.counts
        if counts.samples >= marks[min(len(rows), len(marks) - 1)]:
            covered, false = judged(grower.tree, by_funnels)
            previewed, _ = judged(with_champions(grower.tree, CHAMPIONS), by_previews)
            rows.append(
                f'| {counts.samples} | {counts.grown} | {len(grower.nodes)} | {wall:.0f} '
                f'| {covered} | {false} | {previewed} |'
            )
            print(rows[-1], flush=True)
    processes.shutdown()
    cpu += resource.getrusage(resource.RUSAGE_CHILDREN).ru_utime
    counts = grower.counts
    words = (
        f'{counts.samples} states in {wall:.0f} s of wall time with {workers} workers, '
        f'{1e3 * cpu / counts.samples:.2f} ms of CPU a state; {counts.planned} were planned for, '
        f'{counts.rejected} motions did not bring their state home, {counts.given_up} were given '
        f'up. {counts.rollouts} robots were simulated for the funnels.'
    )
    return grower.tree, rows, words


def pruned_rows(tree: Tree) -> list[str]:
    """What is left of the tree with so many branches of each leg."""
    whole = with_champions(tree, max(KEPT))
    rows = []
    for count in (*KEPT, 0):
        named = replace(whole, champions=whole.champions[:, : count or CHAMPIONS])
        one = pruned(named) if count else named
        covered, false = judged(one, by_previews)
        own, wrong = judged(one, by_funnels)
        rows.append(
            f'| {count or "all"} | {one.nodes.branches} | {len(one.nodes)} '
            f'| {covered} | {false} | {own} | {wrong} |'
        )
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--samples', type=int, default=20000, help='[20000]')
    parser.add_argument('--workers', type=int, default=THREADS)
    parser.add_argument('--write', action='store_true', help='store the tables')
    parser.add_argument('--tree', type=Path, help='store the whole tree in this file')
    options = parser.parse_args()
    tree, rows, words = grow(options.samples, options.workers)
    if options.tree:
        with_champions(tree, CHAMPIONS).save(options.tree)
    text = '\n'.join([
        '# A tree to both legs',
        '',
        f'`python bench/trees_growth.py --samples {options.samples} --workers {options.workers} '
        f'--write`, {THREADS} cores, Python {platform.python_version()}. '
        'What is counted is said at the top of the script.',
        '',
        '| states | branches | nodes | s | covered by funnels, of the feasible census '
        '| false, of the claims of funnels | covered by previews |',
        '|---:|---:|---:|---:|---|---|---|',
        *rows,
        '',
        words,
        '',
        'The tree pruned to the branches of so many champions of each leg:',
        '',
        '| champions | branches | nodes | covered by previews | false, of their claims '
        '| covered by funnels | false, of their claims |',
        '|---:|---:|---:|---|---|---|---|',
        *pruned_rows(tree),
        '',
    ])  # fmt: skip
    print(text)
    if options.write:
        write_atomically(FOLDER / 'trees_growth.md', text)


if __name__ == '__main__':
    main()
