"""A control from the literature: the pendulum that swings up, by the code that grows our trees.

    python bench/trees_pendulum.py [--seeds 10] [--write]

The pendulum of the first LQR-trees (models/tedrake_pendulum.yaml: 1 kg at 0.5 m, 0.1 N m s/rad,
3 N m where 4.9 hold it level), in their box: any angle, rates within 20 rad/s. Growth, funnels,
look-up and rollouts are those of the robot that walks; motions are planned by swing_up.py, gains
have the published Q = diag(10, 1) and R = 15. States are looked up at up to four whole turns
either way. Nothing is previewed: a state is planned for where no funnel holds it.

*Census*: one state drawn in each cell of a grid of 100 x 100 over the box, which no tree sees. A
state counts as *covered* if its best claim is true: the pendulum that begins there, followed in
steps of 0.25 ms, comes to the goal region, in which the regulator keeps within its torque limit
and its cost to go falls. *False* are claims that do not come true, as a share of all claims. A
state is tried once, there is no second claim. *5000 in a row*: how many states were drawn until
so many in a row, those that are only tried included, were all held by true claims. CPU time of
one process.
"""

import argparse
import platform
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.stats import norm

from cg_control.trees.growth import Grower, GrowthOptions, Region
from cg_control.trees.lookup import Lookup
from cg_control.trees.preview import AT_HOME
from cg_control.trees.rollouts import Outcome, follow
from cg_control.trees.swing_up import SwingOptions, SwingUp, upright_root, whole_turns
from cg_description.model_file import write_atomically
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.walking.hybrid import WalkOptions

MODEL = Model.load(model_path('tedrake_pendulum'))
BOX = np.array([np.pi, 20.0])  # rad, rad/s
TURNS = whole_turns(joint=0, nx=2, most=4)
SWING = SwingOptions(Q=np.diag([10.0, 1.0]), R=15.0)
GROWTH = GrowthOptions(round_size=32, at_once=1, dense=10**9)
# A pendulum that goes over is no fallen robot.
SIMULATION = WalkOptions(sample_time=0.002, step=0.002, fall_angle=np.inf)
JUDGED = replace(SIMULATION, step=0.00025)
CELLS = 100
SHOWN = (32, 128, 512, 2048, 4096, 8192, 16384, 32768)
SAMPLES = SHOWN[-1]
STREAK = 5000
RULES = {0.0: 'none may fail (Reist and Tedrake)', 0.01: '1 % may fail (ours)'}
INTERVALS = (10, 20, 40)
PUBLISHED = """\
| | states drawn | trajectories | nodes | covers | time |
|---|---:|---:|---:|---|---|
| Tedrake 2009 (RSS), figure of the pendulum's tree [1] | - | - | 1, 8, 24, 104 | the whole box at 104, by the figure | - |
| Tedrake, Manchester, Tobenkin, Roberts 2010 (IJRR) [2] | - | 13 | - | "completely" | - |
| Reist and Tedrake 2010 (ICRA) [3] | until 5000 in a row come home | - | - | - | half an hour |
| here, {rule}, {seeds} seeds | {samples} | {branches} | {nodes} | {covered} | {cpu} s of CPU |

[1] read as a copy of the figure and of its caption in the repository brooky56/MCP_LQR_Trees (results/image_2.png,
LQR_Trees.ipynb): same box, mass, length, damping, Q and R. What limits the torque there is not said in what was read; 3 N m
is the limit in `PendulumPlant.m` of Drake, by the same authors. Their funnels are verified by sums of squares, ours are not.
[2], [3] read in a reader's notes alone (aresearch.wordpress.com, 29 October 2012). Whether the 5000 in a row are those of the
pendulum or of the cart-pole is not clear from them. Of Reist, Preiswerk and Tedrake 2016 (IJRR) no figure for a pendulum was found.
A dash: not found.
"""  # noqa: E501


def grower(seed: int, tolerated: float, intervals: int) -> Grower:
    """A tree that has not begun to grow."""
    swing = replace(SWING, intervals=intervals)
    return Grower(
        MODEL, upright_root(MODEL, swing), Region(BOX, legs=1), SwingUp(MODEL, swing, TURNS),
        replace(GROWTH, seed=seed, tolerated=tolerated), simulation=SIMULATION, turns=TURNS,
    )  # fmt: skip


def census_states() -> np.ndarray:
    """One state of each cell, shape (CELLS^2, 2)."""
    rng = np.random.default_rng(2010)
    cells = np.stack(np.meshgrid(*2 * [np.arange(CELLS)], indexing='ij'), axis=-1).reshape(-1, 2)
    return BOX * (2 * (cells + rng.random(cells.shape)) / CELLS - 1)


def claims(grown: Grower, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which of the states (B, 2) are claimed, and which of the claims are true, (B,) each."""
    nodes = grown.nodes
    lookup = Lookup(nodes, TURNS)
    node, depth = lookup.best_of_many(np.zeros(len(x), int), x)
    claimed = depth <= 1.0
    at = lookup.turned(node[claimed], x[claimed])
    done = follow(
        nodes, MODEL, node[claimed], at, nodes.to_go[node[claimed]] + AT_HOME,
        goal=grown.tree.goal, options=JUDGED,
    )  # fmt: skip
    true = np.zeros(len(x), bool)
    true[claimed] = done.outcome == Outcome.ARRIVED
    return claimed, true


def wilson(hits: int, of: int) -> tuple[float, float]:
    """Wilson's interval of 95 % of a share."""
    z = norm.ppf(0.975)
    middle = (hits + z**2 / 2) / (of + z**2)
    half = z / (of + z**2) * np.sqrt(hits * (of - hits) / of + z**2 / 4)
    return middle - half, middle + half


def share(hits: int, of: int) -> str:
    """A share with its interval."""
    low, high = wilson(hits, of)
    return f'{hits / of:.2%} ({low:.2%} to {high:.2%})'


def grow(seed: int, tolerated: float, intervals: int, x: np.ndarray, shown: tuple[int, ...]):
    """Rows of one tree: (states, branches, nodes, claimed, true, CPU in s); and its streak."""
    growing, rows, began = grower(seed, tolerated, intervals), [], time.process_time()
    quiet, streak = 0, None
    while growing.counts.samples < shown[-1]:
        counts = growing.round()
        # The states that are tried besides count as well.
        tried = GROWTH.round_size * (1 + GROWTH.falsifiers)
        quiet = 0 if counts.unclaimed or counts.false_claims else quiet + tried
        if streak is None and quiet >= STREAK:
            streak = growing.counts.samples
        if growing.counts.samples in shown:
            paused = time.process_time()
            counts, found = growing.counts, [int(some.sum()) for some in claims(growing, x)]
            rows.append((counts.samples, counts.grown, len(growing.nodes), *found, paused - began))
            began += time.process_time() - paused
    return rows, streak


def line(first: str, row: tuple, count: int) -> str:
    """A row of a table."""
    samples, branches, nodes, claimed, true, cpu = row
    return (
        f'| {first} | {samples} | {branches} | {nodes} | {share(true, count)} '
        f'| {share(claimed - true, claimed)} | {cpu:.1f} |'
    )


def span(values) -> str:
    """The least, the median and the largest."""
    three = np.min(values), np.median(values), np.max(values)
    return ' / '.join(f'{value:.4g}' if value < 1e4 else f'{value:.0f}' for value in three)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--seeds', type=int, default=10)
    parser.add_argument('--write', action='store_true', help='store the table')
    options = parser.parse_args()
    x = census_states()
    count = len(x)
    head = 'states drawn | branches | nodes | covered | false, of claims | CPU, s'
    rule = '|---|---:|---:|---:|---|---|---:|'
    curves, seeds, published = [], [], ''
    for tolerated, words in RULES.items():
        every, streaks = [], []
        for seed in range(options.seeds):
            rows, streak = grow(seed, tolerated, SWING.intervals, x, SHOWN)
            if seed == 0:
                curves += [line(words, row, count) for row in rows]
            every.append(rows[-1])
            streaks.append(streak)
            print(line(f'{words}, seed {seed}', rows[-1], count), 'streak', streak, flush=True)
        _, branches, nodes, claimed, true, cpu = np.array(every).T
        covered = span(100 * true / count)
        false = span(100 * (claimed - true) / claimed)
        done = [s for s in streaks if s is not None]
        reached = f'{len(done)} of {len(streaks)}' + (f', after {span(done)}' if done else '')
        seeds.append(
            f'| {words} | {span(branches)} | {span(nodes)} | {covered} | {false} | {reached} '
            f'| {span(cpu)} |'
        )
        published = published or PUBLISHED.format(
            rule=words, seeds=options.seeds, samples=SAMPLES, branches=span(branches),
            nodes=span(nodes), covered=f'{covered} %', cpu=span(cpu),
        )  # fmt: skip
    coarse = []
    for intervals in INTERVALS:
        rows, _ = grow(0, 0.0, intervals, x, (4096,))
        coarse.append(line(f'{intervals}', rows[-1], count))
        print(coarse[-1], flush=True)
    text = '\n'.join([
        '# A pendulum that swings up, beside what others have published',
        '',
        f'`python bench/trees_pendulum.py --seeds {options.seeds} --write`, Python '
        f'{platform.python_version()}. What is counted is said at the top of the script. '
        f'Intervals are Wilson\'s of 95 %, of {count} states. Three numbers: least / median / '
        'largest.',
        '',
        published,
        f'## {options.seeds} seeds, {SAMPLES} states drawn each',
        '',
        f'| rule of the levels | branches | nodes | covered, % | false, % of claims '
        f'| {STREAK} in a row | CPU, s |',
        '|---|---|---|---|---|---|---|',
        *seeds,
        '',
        '## While it grows, seed 0',
        '',
        f'| rule of the levels | {head} |',
        rule,
        *curves,
        '',
        '## Nodes are knots: the same tree with fewer of them, seed 0, no failure tolerated',
        '',
        f'| intervals a motion | {head} |',
        rule,
        *coarse,
        '',
    ])  # fmt: skip
    print(text)
    if options.write:
        write_atomically(Path(__file__).parent / 'results' / 'trees_pendulum.md', text)


if __name__ == '__main__':
    main()
