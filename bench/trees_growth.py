"""A tree to both legs: how it grows, what it covers, how often its claims are false.

    python bench/trees_growth.py [--samples 20000] [--workers 2] [--write]

States are drawn as in bench/trees_screen.py, whose census of many guesses is what the tree is held
against (results/tree_census.jsonl: 640 states of the seeds 46 and 47, which neither this bench nor
the tree draws; a state counts as feasible if a motion of no or of one step was found, on the robot
without friction). *Covered* is the share of the feasible states that the tree claims and the exact
hybrid robot, friction included, brings home from there. *False* is the share of claims, of states
drawn anew, from which it does not come home.
"""

import argparse
import json
import multiprocessing
import platform
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.stats import beta

from cg_control.balance import BalanceSettings, balance_gains
from cg_control.basin import shipped_basins
from cg_control.extension import Extension, upright_form
from cg_control.growth import Grower, GrowthOptions, Region
from cg_control.lookup import Lookup
from cg_control.nodes import Nodes
from cg_control.tree import Tree
from cg_control.tvlqr import Weights, balance_regulator
from cg_description.model_file import write_atomically
from cg_description.paths import model_path
from cg_dynamics.hybrid import WalkOptions
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_dynamics.watched_processes import WatchedProcesses

HALF = np.array([0.5, 0.8, 1.5, 4.0])  # rad, rad, rad/s, rad/s, as in trees_screen.py
LANDING = WalkOptions(sample_time=0.002, step=0.002, minimum_step=0.1)
JUDGED = 20000  # states drawn for the false claims
MARKS = 12  # rows of the growth curve
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


def roots(model: Model) -> Tree:
    """Upright on either leg, held by the balance controller."""
    gains = balance_gains(model, BalanceSettings(), LANDING.sample_time)
    basins = shipped_basins(model, gains, model.torque_limit)
    if basins is None:
        raise SystemExit('no shipped basins of this model; run bench/balance_basins.py')
    nodes, goal = None, np.full((2, 4, 4), np.nan)
    for leg, stance in enumerate(STANCES):
        modes, bound = basins[stance].modes.to_modes, basins[stance].bounds[-1]
        reach = np.array([bound, bound, 0.3, 0.3])  # inside the basin at any swing
        goal[leg] = modes.T @ np.diag(reach**-2) @ modes
        root = Nodes.root(
            stance, gains[stance], balance_regulator(model, stance).S, model.hash, True,
            funnel=upright_form(model, stance, Weights()),
        )  # fmt: skip
        nodes = root if nodes is None else nodes.joined(root)
    return Tree(nodes, goal, {'model': model.name})


def census() -> tuple[np.ndarray, np.ndarray]:
    """Legs and states of the census from which a motion was found."""
    rows = [json.loads(line) for line in (FOLDER / 'tree_census.jsonl').read_text().splitlines()]
    rows = [row for row in rows if any(row['feasible'])]
    return (
        np.array([STANCES.index(row['stance']) for row in rows]),
        np.array([row['x'] for row in rows]),
    )


def policy(grower: Grower, leg: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether states are claimed, and whether the claimed ones come home."""
    node, depth = Lookup(grower.nodes).best_of_many(leg, x)
    claimed = depth <= 1.0
    home = np.zeros(len(leg), bool)
    home[claimed] = grower.bring_home(node[claimed], x[claimed], learn=False)
    return claimed, home


def judged(grower: Grower, legs: np.ndarray, x: np.ndarray) -> tuple[Share, Share]:
    """Covered share of the feasible census, share of false claims."""
    _, home = policy(grower, legs, x)
    fresh = grower.region.draw(np.random.default_rng([777, 1]), JUDGED)
    claimed, came = policy(grower, *fresh)
    return Share(int(home.sum()), len(home)), Share(int((claimed & ~came).sum()), claimed.sum())


def grow(samples: int, workers: int) -> tuple[Grower, list[str], str]:
    """A tree, the rows of its growth curve and a sentence about its cost."""
    model = Model.load(model_path('compass_gait_mit'))
    processes = WatchedProcesses(workers) if workers > 1 else None
    extension = Extension(model, executor=processes)
    grower = Grower(
        model, roots(model), Region(HALF), extension, GrowthOptions(at_once=16),
        simulation=LANDING, threads=workers,
    )  # fmt: skip
    legs, x = census()
    rows: list[str] = []
    marks = np.unique(np.geomspace(grower.options.round_size, samples, MARKS).astype(int))
    began, spent = time.perf_counter(), 0.0
    while grower.counts.samples < samples:
        grower.round()
        spent = time.perf_counter() - began
        if grower.counts.samples >= marks[min(len(rows), len(marks) - 1)]:
            covered, false = judged(grower, legs, x)
            began = time.perf_counter() - spent
            counts = grower.counts
            rows.append(
                f'| {counts.samples} | {counts.grown} | {len(grower.nodes)} | {spent:.0f} '
                f'| {covered} | {false} |'
            )
            print(rows[-1], flush=True)
    if processes is not None:
        processes.shutdown()
    words = (
        f'{grower.counts.samples} states in {spent:.0f} s of wall time with {workers} workers: '
        f'{1e3 * spent / grower.counts.samples:.2f} ms a state; {grower.counts.planned} were '
        f'planned for, {grower.counts.rejected} motions did not bring their state home. '
        f'{grower.counts.rollouts} robots were simulated.'
    )
    return grower, rows, words


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--samples', type=int, default=20000, help='[20000]')
    parser.add_argument('--workers', type=int, default=multiprocessing.cpu_count())
    parser.add_argument('--write', action='store_true', help='store table and tree')
    options = parser.parse_args()
    _, rows, words = grow(options.samples, options.workers)
    text = '\n'.join([
        '# A tree to both legs',
        '',
        f'`python bench/trees_growth.py --samples {options.samples} --workers {options.workers} '
        f'--write`, {multiprocessing.cpu_count()} cores, Python {platform.python_version()}. '
        'What is counted is said at the top of the script.',
        '',
        '| states | branches | nodes | s | covered, of the feasible census '
        '| false, of the claims |',
        '|---:|---:|---:|---:|---|---|',
        *rows,
        '',
        words,
        '',
    ])  # fmt: skip
    print(text)
    if options.write:
        write_atomically(FOLDER / 'trees_growth.md', text)


if __name__ == '__main__':
    main()
