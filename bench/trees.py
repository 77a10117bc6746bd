"""Following a tree: hybrid rollouts in batch beside walk and Tracker, and what one step costs.

    python bench/trees.py             prints the tables
    python bench/trees.py --write     stores them as bench/results/trees.md

The robot of the thesis, friction included, follows the one-step rebalance of 2 x 25 intervals
from states near its start, +-(0.03, 0.08) rad and +-(0.08, 0.15) rad/s: 2 s, one impact, torque
held for 2 ms. All routes get the same states; one integration step a sample, unless said
otherwise. The stance batch is `simulate_batch` of cg_dynamics with the balance controller of the
outer leg: no impact, no reference. CPU time of one core, median of the repetitions; ratios of one
run are the result.

*One drawn state* is one of the box in which trees are grown: a motion is planned, in no step, then
in one, and the robot follows it. The text's procedure fixes the end of each motion to upright and
simulates it alone; here it is done with this package's planner as a user calls it.
"""

import argparse
import contextlib
import platform
import time
from collections.abc import Callable
from pathlib import Path

import casadi as ca
import numpy as np

from cg_control.following.nodes import Nodes
from cg_control.following.planning import plan
from cg_control.following.tracking import REMEDIES, Tracker, TrackingSettings
from cg_control.grow_tree import BOX, upright_tree
from cg_control.trajectories.collocation import Options, PlanningError, optimise
from cg_control.trajectories.task import Box, Task
from cg_control.trajectories.tvlqr import stabilise
from cg_control.trees.extension import Extension
from cg_control.trees.growth import Region
from cg_control.trees.rollouts import follow
from cg_description.paths import model_path
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.batch import Feedback, simulate_batch
from cg_dynamics.walking.hybrid import WalkOptions, walk

RESULT = Path(__file__).parent / 'results' / 'trees.md'
ROBOT = Model.load(model_path('compass_gait_mit'))
SPREAD = np.array([0.03, 0.08, 0.08, 0.15])
DURATION, SAMPLE_TIME = 2.0, 0.002
OUTER = Setup(stance='outer')


def cpu(what: Callable[[], object], repetitions: int) -> float:
    """Median CPU time in s; the first call is not counted."""
    what()
    found = []
    for _ in range(repetitions):
        began = time.process_time()
        what()
        found.append(time.process_time() - began)
    return float(np.median(found))


def states(count: int) -> np.ndarray:
    return np.random.default_rng(0).uniform(-1, 1, (count, 4)) * SPREAD


def walked(nodes: Nodes, x: np.ndarray, options: WalkOptions) -> np.ndarray:
    ends = []
    for x0 in x:
        tracker = Tracker(nodes, ROBOT)
        done = walk(
            ROBOT, 'inner', x0, DURATION,
            lambda t, s, y, tracker=tracker: np.array([tracker.torque(t, s, y)]), options,
        )  # fmt: skip
        ends.append(done.state)
    return np.array(ends)


def rollout_lines(nodes: Nodes, count: int, slow: int) -> list[str]:
    x, start = states(count), np.full(count, nodes.first)
    whole = WalkOptions(sample_time=SAMPLE_TIME, step=SAMPLE_TIME)
    half = WalkOptions(sample_time=SAMPLE_TIME, step=SAMPLE_TIME / 2)
    n = round(DURATION / SAMPLE_TIME) + 1
    still = Feedback(
        np.tile(nodes.K[0], (n, 1, 1)), np.zeros((n, 4)), np.array([ROBOT.torque_limit])
    )
    rows, p = np.arange(n) * SAMPLE_TIME, parameter_vector(ROBOT, OUTER)

    def batch(**how):
        how = {'options': whole} | how
        return lambda: follow(nodes, ROBOT, start, x, DURATION, **how)

    routes = {
        'hybrid batch, `event`': cpu(batch(), 5) / count,
        'hybrid batch, `phase`': cpu(batch(settings=TrackingSettings(remedy='phase')), 5) / count,
        'hybrid batch, `event`, nodes visited': cpu(batch(visits=100), 5) / count,
        'hybrid batch, `event`, two integration steps a sample': cpu(batch(options=half), 5)
        / count,
        'stance batch: no impact, no reference': cpu(
            lambda: simulate_batch(ROBOT, OUTER, rows, np.zeros((n, 1)), x, p, feedback=still), 5
        )
        / count,
        '`walk` + `Tracker`': cpu(lambda: walked(nodes, x[:slow], whole), 1) / slow,
    }
    ours = routes['hybrid batch, `event`']
    lines = ['| 2 s, one impact | us a rollout | x hybrid batch |', '|---|---:|---:|']
    lines += [f'| {k} | {1e6 * v:.1f} | {v / ours:.2f} |' for k, v in routes.items()]
    found = follow(nodes, ROBOT, start, x, DURATION, options=whole)
    apart = np.abs(found.state[:slow] - walked(nodes, x[:slow], whole)).max()
    one = cpu(lambda: follow(nodes, ROBOT, start[:1], x[:1], SAMPLE_TIME), 50)
    return [
        *lines,
        '',
        f'{count} rollouts, {100 * (found.impacts == 1).mean():.1f} % with one impact; {slow} by '
        f'`walk` and `Tracker`, whose final states differ by at most {apart:.0e}. A call of '
        f'`follow` costs {1e6 * one:.0f} us besides.',
    ]


def tracker_lines(nodes: Nodes) -> list[str]:
    path = [nodes.x0[nodes.first] + 1e-3 * k for k in range(400)]
    lines = ['| one step of `Tracker` | us |', '|---|---:|']
    for remedy in REMEDIES:
        tracker = Tracker(nodes, ROBOT, TrackingSettings(remedy=remedy))

        def steps(tracker=tracker):
            tracker.begin(nodes.first)
            for k, x in enumerate(path):
                tracker.torque(k * SAMPLE_TIME, 'inner', x)

        lines.append(f'| {remedy} | {1e6 * cpu(steps, 15) / len(path):.1f} |')
    return lines


def build_lines(nodes: Nodes) -> list[str]:
    motion = optimise(ROBOT, Task(('inner', 'outer'), reach=0.2), Options(fine=25))
    step = stabilise(motion, ROBOT)
    tree = nodes
    while len(tree) < 4000:
        tree = tree.joined(nodes)
    rows = {
        '`stabilise`, two phases of 25 intervals': cpu(lambda: stabilise(motion, ROBOT), 15),
        'text and hash of a model, once for each': cpu(ROBOT.text, 15),
        '`Nodes.of` that trajectory': cpu(lambda: Nodes.of(step, ROBOT), 15),
        '`Tracker` of it': cpu(lambda: Tracker(nodes, ROBOT), 15),
        f'graft on a tree of {len(tree)} nodes': cpu(lambda: tree.grafted(step, ROBOT, 0), 15),
    }
    lines = ['| once for a trajectory | ms |', '|---|---:|']
    return [*lines, *(f'| {name} | {1e3 * value:.2f} |' for name, value in rows.items())]


def procedure_lines(count: int) -> list[str]:
    """What one drawn state costs that nothing claims: by the text's procedure, and by ours."""
    tree = upright_tree(ROBOT)
    extension, region = Extension(ROBOT), Region(np.array(BOX))
    legs, x = region.draw(np.random.default_rng(9), count)

    def text() -> int:
        found = 0
        for leg, x0 in zip(legs, x, strict=True):
            order = STANCES if leg == 0 else STANCES[::-1]
            for modes in (order[:1], order):
                with contextlib.suppress(PlanningError):
                    motion = optimise(ROBOT, Task(modes, Box.point(x0)), Options(), False)
                    followed = stabilise(motion, ROBOT)
                    nodes = Nodes.of(followed, ROBOT)
                    tracker = Tracker(nodes, ROBOT)
                    walk(
                        ROBOT, modes[0], x0, motion.duration + 1.0,
                        lambda t, s, y, tracker=tracker: np.array([tracker.torque(t, s, y)]),
                    )  # fmt: skip
                    found += 1
                    break
        return found

    def ours() -> int:
        branches = extension(tree.nodes, legs, x)
        for row, branch in enumerate(branches):
            if branch is not None:
                nodes = tree.nodes.grafted(
                    branch.trajectory, ROBOT, branch.onto, funnels=branch.funnels
                )
                follow(nodes, ROBOT, np.array([nodes.first]), x[row : row + 1], 5.0,
                       goal=tree.goal)  # fmt: skip
        return sum(branch is not None for branch in branches)

    routes = {'fixed ends, several guesses, `walk` + `Tracker`': text,
              'screen, cheap plans, batch rollouts': ours}  # fmt: skip
    lines = [f'| one drawn state | ms of CPU | motions found, of {count} |', '|---|---:|---:|']
    for name, route in routes.items():
        found = route()
        lines.append(f'| {name} | {1e3 * cpu(route, 1) / count:.1f} | {found} |')
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--write', action='store_true', help=f'store {RESULT}')
    parser.add_argument('--rollouts', type=int, default=4000, help='in batch [4000]')
    parser.add_argument('--walks', type=int, default=40, help='by walk and Tracker [40]')
    parser.add_argument('--states', type=int, default=100, help='drawn, one by one [100]')
    arguments = parser.parse_args()
    step = plan(ROBOT, Task(('inner', 'outer'), reach=0.2), Options(fine=25))
    nodes = Nodes.of(step, ROBOT)
    lines = [
        '# Trees',
        '',
        f'Command: `python bench/trees.py --write`. Python {platform.python_version()}, '
        f'casadi {ca.__version__}, numpy {np.__version__}; CPU time of one core. What is compared '
        'is said at the top of `bench/trees.py`.',
        '',
        *rollout_lines(nodes, arguments.rollouts, arguments.walks),
        '',
        *tracker_lines(nodes),
        '',
        *build_lines(nodes),
        '',
        *procedure_lines(arguments.states),
        '',
    ]
    text = '\n'.join(lines)
    print(text)
    if arguments.write:
        RESULT.write_text(text)


if __name__ == '__main__':
    main()
