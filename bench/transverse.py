"""Transversal surfaces and transverse LQR along orbits: how wide the tube is, what comes back.

    python bench/transverse.py              prints the tables
    python bench/transverse.py --write      stores them as bench/results/transverse.md

The simulated robot is the exact hybrid model without friction; its state is known, commands are
held for 2 ms and limited to what the motor gives, the phase is that of the plane that holds the
state. Starts are drawn on the impact surface, uniform within so many units (0.1 rad, 0.3 rad/s).
"""

import argparse
import math
import platform
import time
from pathlib import Path

import numpy as np

from cg_control.orbits.orbit import plan_orbit
from cg_control.orbits.surfaces import METHODS, UNITS, phase_of, tube, with_surfaces
from cg_control.orbits.transverse import TRANSVERSE, monodromy, stabilise_transversely
from cg_control.trajectories.collocation import planning_model
from cg_control.trajectories.tvlqr import Weights, stabilise
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.walking.hybrid import WalkOptions, walk

ROBOT = Model.load(model_path('compass_gait_mit'))
DEMANDS = (
    (0.15, 0.3, 0), (0.25, 0.3, 0), (0.25, 0.4, 0), (0.35, 0.3, 0), (0.35, 0.4, 0),
    (0.25, 0.4, 3), (0.25, 0.3, -3), (0.35, 0.4, -3),
)  # fmt: skip
WALKED = ((0.25, 0.3), (0.25, 0.4), (0.3, 0.3))
WEIGHTS = {
    'those of balance': Weights(),
    'default': TRANSVERSE,
    'even': Weights(100.0, 100.0, 11.0, 11.0, 1 / 100),
}
SIZES = (0.5, 1.0)
STARTS, STEPS = 10, 6
RESULT = Path(__file__).parent / 'results' / 'transverse.md'


def surfaces_row(speed: float, length: float, degrees: int) -> list[str]:
    motion = plan_orbit(ROBOT, speed, length, math.radians(degrees)).trajectory
    rows = []
    for method in METHODS:
        began = time.process_time()
        found = with_surfaces(motion, ROBOT, method)
        spent = time.process_time() - began
        radii = [f'{t.well_posed.min():.2f}, {t.advancing.min():.2f}' for t in tube(found, ROBOT)]
        began = time.process_time()
        stabilised = stabilise_transversely(found, ROBOT)
        solved = time.process_time() - began
        values = np.abs(np.linalg.eigvals(monodromy(stabilised, ROBOT, 16)))
        rows.append(
            f'| {speed} | {length} | {degrees} | {method} | {radii[0]} | {radii[1]} | '
            f'{1e3 * spent:.0f} | {1e3 * solved:.0f} | {", ".join(f"{v:.2g}" for v in values)} |'
        )
    return rows


def walks_on(motion, start: np.ndarray, by_clock: bool) -> bool:
    """Whether a robot walks on from a state right after an impact."""
    phases = {phase.stance: phase for phase in motion.phases}
    state = {'leg': '', 's': 0.0, 't': 0.0}

    def command(t, leg, x):
        phase = phases[leg]
        s = phase.start if leg != state['leg'] else state['s'] + t - state['t']
        if not by_clock:
            s = phase_of(phase, x, s)
        state.update(leg=leg, s=s, t=t)
        point = phase.at(s)
        u = point.torque - point.gain @ (x - point.state)
        return np.clip([u], -ROBOT.torque_limit, ROBOT.torque_limit)

    how = WalkOptions(largest_steps=STEPS, swing_angle=1.5)
    robot = planning_model(ROBOT, friction=False)
    duration = 1.5 * STEPS * motion.duration / 2
    return walk(robot, motion.modes[0], start, duration, command, how).outcome == 'steps'


def walks_row(speed: float, length: float) -> list[str]:
    motion = plan_orbit(ROBOT, speed, length).trajectory
    ways = {'over time, clock set at impacts (`tvlqr`)': (stabilise(motion, ROBOT), True)}
    for method, name in (*(('widest', name) for name in WEIGHTS), ('flow', 'default')):
        planes = with_surfaces(motion, ROBOT, method)
        found = stabilise_transversely(planes, ROBOT, WEIGHTS[name])
        ways[f'transverse, {method}, weights: {name}'] = (found, False)
    rows = []
    for name, (found, by_clock) in ways.items():
        shares = []
        for size in SIZES:
            rng = np.random.default_rng(1)  # weights were chosen on others
            d = size * rng.uniform(-1, 1, size=(STARTS, 4)) * UNITS
            d[:, 1] = -d[:, 0]
            done = [walks_on(found, found.states[0] + one, by_clock) for one in d]
            shares.append(f'{sum(done)} of {STARTS}')
        rows.append(f'| {speed} | {length} | {name} | {" | ".join(shares)} |')
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split('\n', 1)[0])
    parser.add_argument('--write', action='store_true')
    options = parser.parse_args()
    began = time.process_time()
    surfaces = [row for demand in DEMANDS for row in surfaces_row(*demand)]
    print(*surfaces, sep='\n', flush=True)
    walks = [row for demand in WALKED for row in walks_row(*demand)]
    spent = time.process_time() - began
    lines = [
        '# Transversal surfaces and transverse LQR',
        '',
        f'Made by `python bench/transverse.py --write`, {spent:.0f} s CPU, '
        f'Python {platform.python_version()}, {platform.machine()}.',
        '',
        'Least radii of the tube on the inner and the outer leg, in units of 0.1 rad and 0.3 '
        'rad/s: well-posed, advancing. CPU of surfaces and of the Riccati equation, multipliers '
        'with its feedback (default weights).',
        '',
        '| speed, m/s | step, m | slope | surfaces | inner | outer | CPU, ms | Riccati, ms '
        '| multipliers |',
        '|---:|---:|---:|---|---|---|---:|---:|---|',
        *surfaces,
        '',
        f'Robots that walk {STEPS} steps on, of starts after an impact off the orbit by up to so '
        'many units in each coordinate:',
        '',
        '| speed, m/s | step, m | feedback | ' + ' | '.join(f'{s:g}' for s in SIZES) + ' |',
        '|---:|---:|---|' + '---:|' * len(SIZES),
        *walks,
    ]
    if options.write:
        RESULT.write_text('\n'.join(lines) + '\n')


if __name__ == '__main__':
    main()
