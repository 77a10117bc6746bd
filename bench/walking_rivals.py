"""Rivals of the walking controller in the same run: basins, pushes, ground, errors, delays, noise.

    python bench/walking_rivals.py              prints the tables
    python bench/walking_rivals.py --write      stores them as bench/results/walking_rivals.md
    python bench/walking_rivals.py --phases     only the table of phases

Orbits of 0.25 and 0.35 m/s with steps of 0.3 m on even ground. Robots are those of flock.py:
hybrid and exact, commands held for 2 ms and limited to 40 N m. A robot walked if it makes 20 steps
within 1.5 times their nominal time; it fell at 0.6 rad of the stance or 2 rad of the swing leg.

    clock          TVLQR round the orbit, phase the time, whatever leg stands (tracking.py)
    event          the same gains, the clock set at impacts
    over phase     the same with another design: the clock starts anew at impacts, the phase is
                   that of surfaces that the cost to go asks for (transverse.py, OVER_PHASE)
    constraints    virtual constraints (hybrid zero dynamics), w = 20 /s
    transverse     transverse LQR on the widest surfaces
    flow           transverse LQR on surfaces normal to the motion
    transverse, own   transverse LQR on surfaces that the cost to go asks for, between impact
                   surfaces (`with_own_surfaces`), with the weights of TVLQR
    tree           previews of the shipped walking tree; its loop has walking_conditions.py
    passive        no torque, no friction, down a slope

*Basin*: states right after an impact, uniform in a box around the orbit: half the angle between
the legs +-0.08 rad, rate of the stance leg +-0.5, of the swing leg +-1 rad/s. *Push*: the largest
impulse at the hip such that the robot walks on from this one and all smaller ones, in steps of
0.5 N s up to 6, forward and backward at 8 phases of the orbit's period: mean and least. All else
starts within a fifth of the box. *Ground*: every foothold is higher or lower by so much than the
last, at random. *Errors*: bench/rebalance.py. *Friction unknown*: none is given back. *Observer*:
high-gain, eps 10 ms, with the noise of the sensors.
"""

import argparse
import math
import platform
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from flock import Constrained, Flock, Following, Passive, Physics, pushed, walked
from rebalance import wrong_robot

from cg_control.following.nodes import Nodes
from cg_control.following.tracking import LEAST_TURN, WALKING, Tracker, TrackingSettings
from cg_control.orbits.orbit import Orbit, plan_orbit
from cg_control.orbits.surfaces import with_surfaces
from cg_control.orbits.transverse import (
    stabilise_over_phase,
    stabilise_transversely,
    with_own_surfaces,
)
from cg_control.orbits.virtual_constraints import VirtualConstraints
from cg_control.trajectories.tvlqr import Weights, stabilise_periodically
from cg_control.trees.preview import Preview
from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import tree_path
from cg_description.paths import model_path
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.walking.gait import find_gait
from cg_dynamics.walking.hybrid import WalkOptions

ROBOT = Model.load(model_path('compass_gait_mit'))
SPEEDS, STEP = (0.25, 0.35), 0.3
STEPS, SLACK = 20, 1.5
BOX = np.array([0.08, 0.5, 1.0])
STARTS, ROBOTS = 300, 40
IMPULSES = np.arange(0.5, 6.01, 0.5)
PHASES = 8
FAR, FAR_ROBOTS = 200, 20
FAR_LAWS = ('event', 'over phase', 'transverse, own')
ORDER = ('basin', 'push', '3 mm', '6 mm', '1 cm', '-1 deg', '-0.5 deg', '0.5 deg', '1 deg', '5 %',
         '10 %', '2 ms', '4 ms', '8 ms', 'friction unknown', 'observer')  # fmt: skip
RESULT = Path(__file__).parent / 'results' / 'walking_rivals.md'


def interval(hits: int, of: int) -> str:
    """So many of so many, with Wilson's interval of 95 %."""
    z, share = 1.96, hits / of
    middle = (share + z * z / (2 * of)) / (1 + z * z / of)
    half = z / (1 + z * z / of) * math.sqrt(share * (1 - share) / of + z * z / (4 * of * of))
    return f'{share:.0%} ({max(middle - half, 0):.0%} to {min(middle + half, 1):.0%})'


def section(x0: np.ndarray, count: int, size: float, seed: int, slope: float = 0.0) -> np.ndarray:
    """States after an impact around one on the inner leg, (count, 4)."""
    d = size * BOX * np.random.default_rng(seed).uniform(-1, 1, (count, 3))
    half = (x0[1] - x0[0]) / 2 + d[:, 0]
    return np.column_stack([slope - half, slope + half, x0[2] + d[:, 1], x0[3] + d[:, 2]])


def duration_of(orbit: Orbit, steps: int) -> float:
    return SLACK * steps * orbit.period / 2


def rivals(orbit: Orbit) -> dict:
    """Name -> law, and the nodes of a phase at which robots start."""
    motion = orbit.trajectory
    over_time = Nodes.orbit(stabilise_periodically(motion, ROBOT), ROBOT)
    own = Nodes.orbit(stabilise_over_phase(motion, ROBOT), ROBOT)
    wide, flow = (
        Nodes.orbit(stabilise_transversely(with_surfaces(motion, ROBOT, method), ROBOT), ROBOT)
        for method in ('widest', 'flow')
    )
    between = stabilise_transversely(with_own_surfaces(motion, ROBOT), ROBOT, Weights())
    return {
        'clock': Following(over_time, ROBOT, TrackingSettings(remedy='clock')),
        'event': Following(over_time, ROBOT, TrackingSettings(remedy='event')),
        'over phase': Following(own, ROBOT, WALKING),
        'constraints': Constrained(VirtualConstraints(motion, ROBOT), ROBOT),
        'transverse': Following(wide, ROBOT, WALKING),
        'flow': Following(flow, ROBOT, WALKING),
        'transverse, own': Following(Nodes.orbit(between, ROBOT), ROBOT, WALKING),
    }


def points(orbit: Orbit, count: int) -> list[tuple[int, int, np.ndarray]]:
    """(leg, node, state) at equal parts of the period; node numbers are the same for all."""
    nodes = Nodes.orbit(stabilise_periodically(orbit.trajectory, ROBOT), ROBOT)
    on = np.flatnonzero(~nodes.late & ~nodes.impact)
    found = [
        int(on[np.abs(nodes.time[on] - t).argmin()])
        for t in np.arange(count) * orbit.period / count
    ]
    return [(int(nodes.stance[n]), n, nodes.x0[n]) for n in found]


def conditions(orbit: Orbit) -> tuple[list[str], Flock, np.ndarray]:
    """Names of the conditions, all robots, and the number of the condition of each."""
    physics, x0 = Physics(ROBOT), orbit.trajectory.states[0]
    rng = np.random.default_rng(8)
    parts: dict[str, Flock] = {'basin': Flock.of(physics, 0, section(x0, STARTS, 1.0, 2022))}
    pushes = [
        Flock.of(physics, leg, pushed(ROBOT, STANCES[leg], x, sign * P), node)
        for leg, node, x in points(orbit, PHASES) for sign in (1, -1) for P in IMPULSES
    ]  # fmt: skip
    parts['push'] = pushes[0].and_(*pushes[1:])

    def near() -> Flock:
        return Flock.of(physics, 0, section(x0, ROBOTS, 0.2, 5))

    for height, words in ((0.003, '3 mm'), (0.006, '6 mm'), (0.01, '1 cm')):
        parts[words] = near()
        parts[words].rise = height * rng.choice([-1.0, 1.0], (ROBOTS, STEPS + 2))
    for degrees in (-1, -0.5, 0.5, 1):
        parts[f'{degrees:g} deg'] = near()
        parts[f'{degrees:g} deg'].slope[:] = math.radians(degrees)
    for error in (0.05, 0.10):
        one = parts[f'{error * 100:.0f} %'] = near()
        one.p = wrong_parameters(error, ROBOTS)
    for samples in (1, 2, 4):
        parts[f'{2 * samples} ms'] = near()
        parts[f'{2 * samples} ms'].delay[:] = samples
    parts['friction unknown'] = near()
    parts['friction unknown'].compensates[:] = False
    parts['observer'] = near()
    parts['observer'].observed[:] = True
    names = list(parts)
    kind = np.concatenate([np.full(len(f), k) for k, f in enumerate(parts.values())])
    first, *others = parts.values()
    return names, first.and_(*others), kind


def wrong_parameters(error: float, count: int) -> np.ndarray:
    return np.array([
        parameter_vector(wrong_robot(error, 100 + k), Setup()) for k in range(count)
    ])  # fmt: skip


def largest_pushes(ok: np.ndarray) -> str:
    """Mean and least, forward and backward, of (phases, 2, impulses) that walked on."""
    kept = np.cumprod(ok, axis=2).sum(axis=2)
    best = np.where(kept > 0, IMPULSES[np.maximum(kept, 1) - 1], 0.0)
    return ', '.join(f'{best[:, k].mean():.1f} ({best[:, k].min():.1f})' for k in (0, 1))


def rival_row(name: str, law, orbit: Orbit, names, flock: Flock, kind) -> dict[str, str]:
    done = walked(ROBOT, flock, law, STEPS, duration_of(orbit, STEPS))
    ok = done.impacts >= STEPS
    cells = {}
    for k, condition in enumerate(names):
        mine = ok[kind == k]
        if condition == 'push':
            cells[condition] = largest_pushes(mine.reshape(PHASES, 2, len(IMPULSES)))
        elif condition == 'basin':
            cells[condition] = interval(int(mine.sum()), len(mine))
        else:
            cells[condition] = f'{mine.mean():.0%}'
    print(f'{orbit.speed:.2f} {name}: {cells}', flush=True)
    return cells


def tree_basin(tree: Tree, orbit: Orbit) -> str:
    x = section(orbit.trajectory.states[0], STARTS, 1.0, 2022)
    found = Preview(tree, ROBOT, WALKING).choose(np.zeros(len(x), int), x)
    return interval(int((found >= 0).sum()), len(x))


def far(name: str, law, orbit: Orbit, count: int) -> str:
    """200 steps with errors of 5 %, observer and noise."""
    flock = Flock.of(Physics(ROBOT), 0, section(orbit.trajectory.states[0], count, 0.0, 5))
    flock.p, flock.observed = wrong_parameters(0.05, count), np.ones(count, bool)
    done = walked(ROBOT, flock, law, FAR, duration_of(orbit, FAR), known=ROBOT)
    row = (
        f'| {orbit.speed:.2f} | {name} | {(done.impacts >= FAR).sum()} of {count} '
        f'| {np.median(done.impacts):.0f} | {done.torque.mean():.0f} |'
    )
    print('far', row, flush=True)
    return row


def phase_rows(orbit: Orbit) -> list[str]:
    """Projection against propagation: jitter and bias of the phase, lost phases."""
    nodes = Nodes.orbit(stabilise_over_phase(orbit.trajectory, ROBOT), ROBOT)
    physics, count, rows = Physics(ROBOT), 10, []
    x = section(orbit.trajectory.states[0], count, 0.0, 5)
    flocks = [Flock.of(physics, 0, x) for _ in range(4)]
    names = 'exact', 'noise of 0.1 rad/s', 'delay of 4 ms', 'ground 6 mm lower at each landing'
    flocks[1].noise[:], flocks[2].delay[:], flocks[3].rise = 0.1, 2, np.full((count, 1), -0.006)
    flock = flocks[0].and_(*flocks[1:])
    kind = np.repeat(np.arange(4), count)
    for propagated in (False, True):
        for pull in (5.0, 20.0, 100.0, 500.0):
            law = Following(nodes, ROBOT, replace(WALKING, pull=pull), propagated)
            ahead: list[list[np.ndarray]] = [[], [], [], []]
            rates: list[list[np.ndarray]] = [[], [], [], []]
            lost = np.zeros(4)

            def watch(tick, who, leg, x, law):
                # What the phase should be is that of the true state.
                same = nodes.stance[law.node[who]] == leg[who]
                some = who[same]
                value, _, turn = law._ahead(law.node[some], law.elapsed[some], x[some])
                for k in range(4):
                    mine = kind[some] == k
                    ahead[k].append(value[mine])  # noqa: B023
                    rates[k].append(law.rate[some][mine])  # noqa: B023
                    lost[k] += (turn[mine] <= LEAST_TURN).sum()  # noqa: B023

            done = walked(ROBOT, flock, law, 10, duration_of(orbit, 10), watch=watch)
            cells = []
            for k in range(4):
                off, ds = np.concatenate(ahead[k]), np.concatenate(rates[k])
                walks = (done.impacts[kind == k] >= 10).sum()
                cells.append(
                    f'{walks}: {1e3 * off.mean():.1f}, {1e3 * off.std():.1f}, {ds.std():.2f}, '
                    f'{lost[k] / len(off):.1%}'
                )
            how = 'model, corrected' if propagated else 'projection'
            rows.append(f'| {orbit.speed:.2f} | {how} | {pull:g} | {" | ".join(cells)} |')
            print('phase', rows[-1], flush=True)
    head = f'| speed | phase | pull, 1/s | {" | ".join(names)} |'
    return [head, '|---:|---|---:|---|---|---|---|', *rows]


def costs(orbit: Orbit) -> str:
    """Time of one torque, us."""
    nodes = Nodes.orbit(stabilise_over_phase(orbit.trajectory, ROBOT), ROBOT)
    x0, found = orbit.trajectory.states[0], []
    constraints = VirtualConstraints(orbit.trajectory, ROBOT)
    laws = {
        'event': Tracker(nodes, ROBOT, TrackingSettings(remedy='event'), 0).torque,
        'phase, projected': Tracker(nodes, ROBOT, WALKING, 0).torque,
        'constraints': lambda t, stance, x: constraints.torque(stance, x),
        'rates of the model, what propagating adds at least':
            lambda t, stance, x: constraints._rates(stance, x[None]),
    }  # fmt: skip
    for name, law in laws.items():
        began = time.process_time()
        for k in range(1000):
            law(1e-4 * k, 'inner', x0)
        found.append(f'{name} {1e3 * (time.process_time() - began):.0f}')
    return 'CPU of one torque in Python, us: ' + '; '.join(found) + '.'


def passive_lines() -> list[str]:
    """The robot itself finds no passive gait; the classic one is the reference."""
    bare = {'viscous_friction.coefficient': 0.0, 'coulomb_friction.torque': 0.0}
    robot, rng = ROBOT.with_values(bare), np.random.default_rng(4)
    degrees = np.array([0.5, 1, 2, 3, 4, 5])
    count = 2000
    slope = np.radians(degrees[np.arange(count) % len(degrees)])
    half, v = rng.uniform(0.1, 0.35, count), rng.uniform([0.3, -1.0], [1.8, 2.0], (count, 2))
    flock = Flock.of(
        Physics(robot), 0, np.column_stack([slope - half, slope + half, v])
    )  # fmt: skip
    flock.slope = slope
    most = walked(robot, flock, Passive(), STEPS, 30.0).impacts
    classic = robot.with_values({
        'leg_length': 1.0, 'total_mass': 20.0, 'c1': 0.0625, 'c2': 0.0631, 'c3': 1e-7,
        'c4': 0.125, 'c5': 0.124, 'c6': 0.0,
    })  # fmt: skip
    fall = 0.0525
    options = WalkOptions(slope=fall, step=0.002, sample_time=10.0)
    gait = find_gait(classic, 'inner', [0.26, 1.21, 0.71], options, steps=2)
    flock = Flock.of(Physics(classic), 0, section(gait.x0, STARTS, 1.0, 2022, fall))
    flock.slope[:] = fall
    hits = int((walked(classic, flock, Passive(), STEPS, 30.0).impacts >= STEPS).sum())
    lines = [
        f'*Passive.* Of {count} random starts of this robot without friction and torque, on '
        f'slopes of 0.5 to 5 degrees, the longest walk had {most.max()} steps: no gait was found. '
        f'The classic compass gait (20 kg, 1 m, 3 degrees) walks on from '
        f'{interval(hits, STARTS)} of the same box around its own gait.'
    ]
    print(*lines, flush=True)
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split('\n', 1)[0])
    parser.add_argument('--write', action='store_true')
    parser.add_argument('--phases', action='store_true', help='print the table of phases only')
    options = parser.parse_args()
    if options.phases:
        orbit = plan_orbit(ROBOT, SPEEDS[1], STEP)
        print(*phase_rows(orbit), '', costs(orbit), sep='\n')
        return
    began = time.process_time()
    passive, table, distance, phases = passive_lines(), [], [], []
    tree = Tree.load(tree_path('compass_gait_mit_walk'), ROBOT)
    orbits = [plan_orbit(ROBOT, speed, STEP) for speed in SPEEDS]

    def write(done: bool) -> None:
        lines = [
            '# Rivals of the walking controller',
            '',
            f'Made by `python bench/walking_rivals.py --write`, {time.process_time() - began:.0f} '
            f's CPU, Python {platform.python_version()}, {platform.machine()}; what is measured '
            'is said at the top of the script.' + ('' if done else ' Not all of it was run.'),
            '',
            f'{STARTS} starts of the basin, {ROBOTS} robots a cell of what follows. Push: N s, '
            'forward, backward: mean over phases, least in parentheses. The basin of the tree are '
            'states that a preview brings to an orbit or upright.',
            '',
            '| speed | law | ' + ' | '.join(ORDER) + ' |',
            '|---:|---' + '|---' * len(ORDER) + '|',
            *table,
            '',
            *passive,
            '',
            f'{FAR} steps with errors of 5 %, observer and noise, from the orbit: robots that '
            'made them, median of the steps, mean of the largest torque in N m:',
            '',
            '| speed | law | made them | steps | torque |',
            '|---:|---|---|---:|---:|',
            *distance,
            '',
            'Phase over 10 steps on the surfaces of `over phase`: robots of 10 that made them; '
            'then bias and standard deviation of how far the phase of the true state is ahead, '
            'ms, standard deviation of ds/dt, share of samples at which surfaces meet (lost):',
            '',
            *phases,
        ]
        if options.write:
            RESULT.write_text('\n'.join(lines).rstrip() + '\n')

    for orbit in orbits:
        names, flock, kind = conditions(orbit)
        assert tuple(names) == ORDER
        for name, law in rivals(orbit).items():
            cells = rival_row(name, law, orbit, names, flock, kind)
            row = ' | '.join(cells[c] for c in ORDER)
            table.append(f'| {orbit.speed:.2f} | {name} | {row} |')
            write(False)
        basin = tree_basin(tree, orbit)
        print('tree', basin, flush=True)
        rest = ' | '.join('' for _ in ORDER[1:])
        table.append(f'| {orbit.speed:.2f} | tree | {basin} | {rest} |')
        write(False)
    rows = [phase_rows(orbit) for orbit in orbits]
    phases += [*rows[0], *(row for more in rows[1:] for row in more[2:]), '', costs(orbits[1])]
    write(False)
    for orbit in orbits:
        laws = rivals(orbit)
        for name in FAR_LAWS:
            distance.append(far(name, laws[name], orbit, FAR_ROBOTS))
            write(False)
    write(True)
    print(f'{time.process_time() - began:.0f} s CPU')


if __name__ == '__main__':
    main()
