"""Gains against surfaces: why transverse LQR on the widest planes loses, and what mends it.

    python bench/walking_surfaces.py --write     bench/results/walking_surfaces.md

Gains and the surfaces that give the phase are changed apart from each other. Each cell is a law:
the gains of its row, K, follow the reference at the phase of its column. Robots, box and ground
are those of walking_rivals.py; a robot walked if it makes 20 steps within 1.5 times their time.

    gains      over time (`stabilise_periodically`); over phase; transverse LQR designed for the
               planes in parentheses
    phase      clock: set at impacts. widest, flow: surfaces.py. own: (OWN) of theory.md, the first
               surface of a phase included. between impacts: (OWN), each phase begins with the
               impact surface (`with_own_surfaces`)

0.25 and 0.35 m/s are the orbits by which the weights OVER_PHASE were chosen, 0.3 m/s is not.
"""

import argparse
import math
import platform
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from flock import Flock, Following, Physics, walked
from walking_rivals import ROBOT, STEP, STEPS, duration_of, section

from cg_control.following.nodes import Nodes
from cg_control.following.tracking import WALKING, TrackingSettings
from cg_control.orbits.orbit import Orbit, plan_orbit
from cg_control.orbits.surfaces import with_surfaces
from cg_control.orbits.transverse import (
    monodromy,
    stabilise_over_phase,
    stabilise_transversely,
    with_own_surfaces,
)
from cg_control.trajectories.tvlqr import Weights, stabilise_periodically
from cg_dynamics.rig import STANCES

SPEEDS = (0.25, 0.3, 0.35)
DEGREES = (0.0, -0.5, 0.5, -1.0, 1.0)
ROBOTS, STARTS = 50, 200
HEAD = [f'{d:g} deg' for d in DEGREES] + ['3 mm', 'basin']
RESULT = Path(__file__).parent / 'results' / 'walking_surfaces.md'


def designs(orbit: Orbit) -> dict[str, Nodes]:
    """Name -> an orbit with its gains and its surfaces."""
    motion = orbit.trajectory
    wide, flow = (with_surfaces(motion, ROBOT, method) for method in ('widest', 'flow'))
    found = {
        'over time': stabilise_periodically(motion, ROBOT),
        'over phase': stabilise_over_phase(motion, ROBOT),
        'transverse (widest)': stabilise_transversely(wide, ROBOT),
        'transverse (flow)': stabilise_transversely(flow, ROBOT),
        'transverse (between impacts)':
            stabilise_transversely(with_own_surfaces(motion, ROBOT), ROBOT, Weights()),
    }  # fmt: skip
    multipliers[orbit.speed] = {
        name: float(np.abs(np.linalg.eigvals(monodromy(m, ROBOT))).max())
        for name, m in found.items() if name.startswith('transverse')
    }  # fmt: skip
    return {name: Nodes.orbit(m, ROBOT) for name, m in found.items()}


multipliers: dict[float, dict[str, float]] = {}


def cells(orbit: Orbit, law: Following) -> list[str]:
    """Share of the robots that walk on, in each condition."""
    physics, x0 = Physics(ROBOT), orbit.trajectory.states[0]
    flocks = [Flock.of(physics, 0, section(x0, ROBOTS, 0.2, 5)) for _ in HEAD[:-1]]
    for flock, degrees in zip(flocks, DEGREES, strict=False):
        flock.slope[:] = math.radians(degrees)
    signs = np.random.default_rng(8).choice([-1.0, 1.0], (ROBOTS, STEPS + 2))
    flocks[-1].rise = 0.003 * signs
    flocks.append(Flock.of(physics, 0, section(x0, STARTS, 1.0, 2022)))
    kind = np.concatenate([np.full(len(f), k) for k, f in enumerate(flocks)])
    done = walked(ROBOT, flocks[0].and_(*flocks[1:]), law, STEPS, duration_of(orbit, STEPS))
    ok = done.impacts >= STEPS
    return [f'{ok[kind == k].mean():.0%}' for k in range(len(flocks))]


def readings(nodes: dict[str, Nodes]) -> list[str]:
    """What the surfaces read: n in the middle of each phase."""
    lines = []
    for name in ('transverse (widest)', 'transverse (flow)', 'transverse (between impacts)'):
        tree = nodes[name]
        for start in tree.phase_starts(0):
            leg = int(tree.stance[start])
            on = np.flatnonzero((tree.stance == leg) & ~tree.late & ~tree.impact)
            stands = tree.x0[on, leg]
            n = tree.surfaces[on[np.abs(stands).argmin()], 0]
            n = n[[leg, 1 - leg, 2 + leg, 3 - leg]]
            lines.append(
                f'| {name[12:-1]} | {STANCES[leg]} | '
                + ' | '.join(f'{v:.2f}' for v in n)
                + f' | {n[2] / n[0]:.2f} |'
            )
    return lines


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split('\n', 1)[0])
    parser.add_argument('--write', action='store_true')
    options = parser.parse_args()
    began, table, read = time.process_time(), [], []
    for speed in SPEEDS:
        orbit = plan_orbit(ROBOT, speed, STEP)
        nodes = designs(orbit)
        phases = {
            'widest': nodes['transverse (widest)'], 'flow': nodes['transverse (flow)'],
            'own': nodes['over phase'], 'between impacts': nodes['transverse (between impacts)'],
        }  # fmt: skip
        for name, gains in nodes.items():
            laws = {'clock': Following(gains, ROBOT, TrackingSettings(remedy='event'))}
            laws |= {
                phase: Following(replace(gains, normal=of.normal), ROBOT, WALKING)
                for phase, of in phases.items()
            }
            for phase, law in laws.items():
                row = ' | '.join(cells(orbit, law))
                table.append(f'| {speed:g} | {name} | {phase} | {row} |')
                print(table[-1], flush=True)
        read += [f'| {speed:g} {line}' for line in readings(nodes)]
    lines = [
        '# Gains against surfaces',
        '',
        f'Made by `python bench/walking_surfaces.py --write`, {time.process_time() - began:.0f} s '
        f'CPU, Python {platform.python_version()}, {platform.machine()}; what is measured is said '
        f'at the top of the script. {STARTS} starts of the basin, {ROBOTS} robots a cell of the '
        'rest.',
        '',
        '| speed | gains | phase | ' + ' | '.join(HEAD) + ' |',
        '|---:|---|---|' + '---:|' * len(HEAD),
        *table,
        '',
        'What surfaces read where the stance leg passes upright: n of the stance and the swing '
        'angle in s/rad, of their rates in s^2/rad, and the ratio of rate to angle of the stance '
        'leg in s. One that falls with the unstable eigenvalue, 3.18 1/s, has 0.31 s.',
        '',
        '| speed | surfaces | stance leg | stance | swing | stance rate | swing rate | ratio |',
        '|---:|---|---|---:|---:|---:|---:|---:|',
        *read,
        '',
        'Largest multipliers: ' + '; '.join(
            f'{speed:g} m/s: ' + ', '.join(f'{name} {m:.2g}' for name, m in found.items())
            for speed, found in multipliers.items()
        ) + '.',
    ]  # fmt: skip
    if options.write:
        RESULT.write_text('\n'.join(lines) + '\n')
    print(*lines[-30:], sep='\n')


if __name__ == '__main__':
    main()
