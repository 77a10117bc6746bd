"""The shipped walking tree in the loop: pushes, ground, slopes, errors; starts, changes, stops.

    python bench/walking_conditions.py --write     bench/results/walking_conditions.md

Robots are those of flock.py, each followed by a `TreeController` of its own with the settings of
the nodes: previews, balance controller, law of the tree. States are known but where it says
observer (high-gain, eps 10 ms, noise of the sensors).

*Largest push* at the hip such that the robot does not fall within `AFTER` s from this one and all
smaller ones, in steps of 1 N s up to 8, at 8 instants of the period.

*Conditions*: robots begin right after an impact within a fifth of the box of walking_rivals.py and
are to make 10 steps; they have 1.5 times the nominal time, and 6 s more. *Ground*: every foothold
is higher or lower by so much than the last, at random. *Slopes* fall ahead, the controller takes
them for even ground. *Errors*: bench/rebalance.py, the controller knows the nominal robot.

*Transitions*: upright at first, half of the robots on either leg, up to 10 mrad off; told to walk
at 0.25 m/s, after 5 steps at 0.35, after 11 to stop. A robot has *started* if it came into the
tube at 0.25 m/s, *changed* if it came into that at 0.35 m/s later, *stopped* if the balance
controller holds it at the end, and steps are those after the demand to stop.
"""

import argparse
import math
import platform
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from flock import SAMPLE_TIME, Flock, Physics, pushed, walked
from walking_rivals import BOX, ROBOT, STEP, points, section, wrong_parameters

from cg_control.balancing.balance import BALANCING, BalanceController, balance_gains
from cg_control.balancing.basin import shipped_basins
from cg_control.following.nodes import Way
from cg_control.following.tracking import Tracker
from cg_control.orbits.orbit import Orbit, plan_orbit
from cg_control.trees.recovery import ReadyTree, RecoverySettings, TreeController
from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import tree_path
from cg_description.model_file import write_atomically
from cg_dynamics.rig import STANCES

SPEEDS = (0.25, 0.35)  # m/s
PHASES, PUSHES, AFTER = 8, np.arange(1.0, 8.1), 6.0
STEPS, ROBOTS = 10, 10
SLOPES = (-2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0)  # degrees
TRANSITIONS = 4  # robots on each slope
CHANGE, STOP = 5, 11  # steps
LONGEST = 26.0  # s
RESULT = Path(__file__).parent / 'results' / 'walking_conditions.md'


class Trees:
    """As a law of flock.py: one `TreeController` for each robot."""

    def __init__(self, ready: ReadyTree, settings: RecoverySettings):
        self.ready, self.settings = ready, settings
        self.gains = balance_gains(ROBOT, settings, SAMPLE_TIME)
        self.basins = shipped_basins(ROBOT, self.gains, ROBOT.torque_limit)
        self.before: np.ndarray | None = None  # states that were told before the first ones

    def begin(self, flock: Flock) -> None:
        """Before the first sample."""
        self.controllers, self.ticks = [], 0
        for b in range(len(flock)):
            balance = BalanceController(ROBOT, self.settings, self.gains, self.basins)
            one = TreeController(balance, self.settings)
            # Only the tracker has a state of its own.
            one.take(replace(self.ready, tracker=Tracker(self.ready.tree.nodes, ROBOT)))
            if self.before is not None:
                one.step(0, STANCES[flock.leg[b]], self.before[b])
            self.controllers.append(one)

    def torque(self, who, leg, x, taken, first: bool) -> np.ndarray:
        """Torque of the robots `who`, (n,)."""
        self.ticks += 1
        now = round(self.ticks * SAMPLE_TIME * 1e9)
        return np.array([
            self.controllers[b].step(now, STANCES[s], y).torque
            for b, s, y in zip(who, leg, x, strict=True)
        ])  # fmt: skip


def push_rows(ready: ReadyTree, orbit: Orbit) -> list[str]:
    """Largest pushes, forward and backward, at each instant of the period."""
    physics, where = Physics(ROBOT), points(orbit, PHASES)
    law, rows = Trees(ready, RecoverySettings(speed=orbit.speed)), []
    for sign, words in ((1, 'forward'), (-1, 'backward')):
        starts = [(leg, n, x, P) for leg, n, x in where for P in PUSHES]
        flocks = [
            Flock.of(physics, leg, pushed(ROBOT, STANCES[leg], x, sign * P), n)
            for leg, n, x, P in starts
        ]
        law.before = np.array([x for _, _, x, _ in starts])
        done = walked(ROBOT, flocks[0].and_(*flocks[1:]), law, 1000, AFTER)
        kept = np.cumprod(done.standing.reshape(PHASES, len(PUSHES)), axis=1).sum(axis=1)
        best = np.where(kept > 0, PUSHES[np.maximum(kept, 1) - 1], 0.0)
        cells = ' | '.join(f'{b:g}' for b in best)
        rows.append(f'| {orbit.speed:g} | {words} | {cells} | {best.mean():.1f} |')
        print(rows[-1], flush=True)
    return rows


def conditions(orbit: Orbit) -> dict[str, Flock]:
    """Name -> robots."""
    physics, x0 = Physics(ROBOT), orbit.trajectory.states[0]
    rng, found = np.random.default_rng(8), {}

    def near(name: str) -> Flock:
        found[name] = Flock.of(physics, 0, section(x0, ROBOTS, 0.2, 5))
        return found[name]

    near('even')
    for height, words in ((0.003, '3 mm'), (0.006, '6 mm'), (0.01, '1 cm')):
        near(words).rise = height * rng.choice([-1.0, 1.0], (ROBOTS, STEPS + 2))
    for degrees in (-2, -1, -0.5, 0.5, 1, 2):
        near(f'{degrees:g} deg').slope[:] = math.radians(degrees)
    for error in (0.05, 0.10):
        near(f'{100 * error:.0f} %').p = wrong_parameters(error, ROBOTS)
    near('observer').observed[:] = True
    return found


def condition_row(ready: ReadyTree, orbit: Orbit) -> tuple[list[str], str]:
    """Names of the conditions; how many made the steps, and how many did not fall."""
    parts = conditions(orbit)
    first, *others = parts.values()
    law = Trees(ready, RecoverySettings(speed=orbit.speed))
    duration = 1.5 * STEPS * orbit.period / 2 + AFTER
    done = walked(ROBOT, first.and_(*others), law, STEPS, duration, known=ROBOT)
    made = (done.impacts >= STEPS).reshape(len(parts), ROBOTS).sum(axis=1)
    stands = done.standing.reshape(len(parts), ROBOTS).sum(axis=1)
    cells = ' | '.join(f'{m}, {s}' for m, s in zip(made, stands, strict=True))
    row = f'| {orbit.speed:g} | {cells} |'
    print(row, flush=True)
    return list(parts), row


def transition_rows(ready: ReadyTree) -> list[str]:
    """Starts, changes and stops on each slope."""
    physics, count = Physics(ROBOT), len(SLOPES) * TRANSITIONS
    rng = np.random.default_rng(6)
    x = np.zeros((count, 4))
    x[:, 0] = x[:, 1] = rng.uniform(-0.01, 0.01, count)
    flock = Flock.of(physics, np.arange(count) % 2, x)
    flock.slope = np.radians(np.repeat(SLOPES, TRANSITIONS))
    law = Trees(ready, RecoverySettings(speed=SPEEDS[0]))
    started, changed, stopped, asked = (np.zeros(count, int) for _ in range(4))

    def watch(tick, who, leg, x, law):
        for b in who:
            one = law.controllers[b]
            taken = one.steps_taken
            one.demand = SPEEDS[0] if taken < CHANGE else SPEEDS[1] if taken < STOP else 0.0
            inside = one.way == Way.ORBIT and one.depth <= 1.0
            started[b] |= inside and one.speed == SPEEDS[0]
            changed[b] |= inside and one.speed == SPEEDS[1] and taken >= CHANGE
            asked[b] |= taken >= STOP
            stopped[b] = one.mode == BALANCING and taken >= STOP

    done = walked(ROBOT, flock, law, 1000, LONGEST, known=ROBOT, watch=watch)
    rows = []
    for k, slope in enumerate(SLOPES):
        mine = slice(k * TRANSITIONS, (k + 1) * TRANSITIONS)
        on = done.standing[mine]
        steps = (done.impacts[mine] - STOP)[on & (stopped[mine] > 0)]
        rows.append(
            f'| {slope:g} | {started[mine].sum()} | {changed[mine].sum()} '
            f'| {(stopped[mine] * on).sum()} | {on.sum()} '
            f'| {max(steps) if len(steps) else ""} |'
        )
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split('\n', 1)[0])
    parser.add_argument('--write', action='store_true')
    options = parser.parse_args()
    began = time.process_time()
    tree = Tree.load(tree_path('compass_gait_mit_walk'), ROBOT)
    ready = ReadyTree.of(tree, ROBOT, SAMPLE_TIME)
    orbits = [plan_orbit(ROBOT, speed, STEP) for speed in SPEEDS]
    transitions = transition_rows(ready)
    found = [condition_row(ready, orbit) for orbit in orbits]
    pushes = [row for orbit in orbits for row in push_rows(ready, orbit)]
    names = found[0][0]
    lines = [
        '# The walking tree in the loop',
        '',
        f'Made by `python bench/walking_conditions.py --write`, {time.process_time() - began:.0f} '
        f's CPU, Python {platform.python_version()}, {platform.machine()}; what is measured is '
        f'said at the top of the script. compass_gait_mit_walk: {len(tree.nodes)} nodes, '
        f'{tree.nodes.branches} branches.',
        '',
        f'Largest push in N s that the robot stands at {PHASES} instants of the period, and the '
        'mean:',
        '',
        '| speed | push |' + ''.join(f' {k}/{PHASES} |' for k in range(PHASES)) + ' mean |',
        '|---:|---|' + '---:|' * (PHASES + 1),
        *pushes,
        '',
        f'Of {ROBOTS} robots those that made {STEPS} steps, and those that did not fall in the '
        f'time they have; starts within {0.2 * BOX[0]:g} rad, {0.2 * BOX[1]:g} and '
        f'{0.2 * BOX[2]:g} rad/s:',
        '',
        '| speed | ' + ' | '.join(names) + ' |',
        '|---:|' + '---|' * len(names),
        *(row for _, row in found),
        '',
        f'Of {TRANSITIONS} robots on each slope:',
        '',
        '| slope, degrees | started | changed | stopped | did not fall | most steps of a stop |',
        '|---:|---:|---:|---:|---:|---:|',
        *transitions,
    ]
    if options.write:
        write_atomically(RESULT, '\n'.join(lines) + '\n')
    print(f'{time.process_time() - began:.0f} s CPU')


if __name__ == '__main__':
    main()
