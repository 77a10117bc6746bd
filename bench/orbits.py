"""Walking orbits over speed, step length and slope: what they cost, need and do by themselves.

    python bench/orbits.py              prints the tables
    python bench/orbits.py --write      stores them as bench/results/orbits.md

Each orbit is planned twice, from guesses and from its neighbour in speed (`orbit_library`); the
cheaper one counts. Its closure is that of another integration than the planner's: the period from
x0 on under the nominal torque, by Dormand and Prince of order 8 with relative errors of 1e-12.
"""

import argparse
import math
import platform
import time
from pathlib import Path

import numpy as np
from scipy.integrate import solve_ivp

from cg_control.orbits.floquet import multipliers
from cg_control.orbits.orbit import Orbit, plan_orbit
from cg_control.orbits.orbit_library import OrbitLibrary, orbit_library
from cg_control.trajectories.collocation import PlanningError
from cg_description.paths import model_path
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.walking.impact import impact

ROBOT = Model.load(model_path('compass_gait_mit'))
SPEEDS = np.arange(2, 9) * 0.05
LENGTHS = (0.2, 0.3, 0.4)
SLOPES = (0, 3, -3)  # degrees; positive falls ahead
LIMITS = (None, 10.0)
STEEPER = ((0, 0.3, 0.3), (0, 0.4, 0.4), (3, 0.3, 0.2), (3, 0.4, 0.3), (-3, 0.3, 0.3))
APPROACHES = (0.05, 0.1, 0.15, 0.3)  # m/s
RESULT = Path(__file__).parent / 'results' / 'orbits.md'


def closure(orbit: Orbit) -> float:
    """Largest |x(T) - x0| after a period without feedback, rad or rad/s."""
    x = orbit.trajectory.states[0]
    for phase in orbit.trajectory.phases:
        setup = Setup(stance=phase.stance)
        f, p = compile_model(orbit.planned, setup).f, parameter_vector(orbit.planned, setup)

        def rates(t, x, phase=phase, f=f, p=p):
            return np.asarray(f(x, [np.interp(t, phase.time, phase.torque)], p)).ravel()

        for span in zip(phase.time[:-1], phase.time[1:], strict=True):
            x = solve_ivp(rates, span, x, 'DOP853', rtol=1e-12, atol=1e-14).y[:, -1]
        x = impact(orbit.planned, phase.stance, x).x_plus
    return float(np.abs(x - orbit.trajectory.states[0]).max())


def timed(plan, *arguments, **options):
    """What planning gave, or None, and its CPU time in s."""
    began = time.process_time()
    try:
        found = plan(*arguments, **options)
    except PlanningError:
        found = None
    return found, time.process_time() - began


def row(degrees: int, length: float, speed: float, library: OrbitLibrary | None) -> str:
    planned, spent = timed(plan_orbit, ROBOT, speed, length, math.radians(degrees))
    near = library and library.nearest(speed)
    if near is not None and abs(near.speed - speed) > 1e-6:
        near = None
    found = [orbit for orbit in (planned, near) if orbit is not None]
    if not found:
        return f'| {degrees} | {length} | {speed:.2f} | none found |' + ' |' * 8
    orbit = min(found, key=lambda o: o.trajectory.provenance['cost'])
    first, second = (phase.end - phase.start for phase in orbit.trajectory.phases)
    values = ', '.join(f'{abs(value):.2g}' for value in multipliers(orbit))
    cpu = f'{1e3 * spent:.0f}' if planned else f'not found ({1e3 * spent:.0f})'
    return (
        f'| {degrees} | {length} | {speed:.2f} | {first:.2f} + {second:.2f} | '
        f'{orbit.cost_of_transport:.3f} | {orbit.positive_cost_of_transport:.3f} | '
        f'{orbit.peak_torque:.1f} | {orbit.friction_needed:.2f}, '
        f'{orbit.impact_friction_needed:.2f} | {1e3 * orbit.foot_depth:.1f} | {values} | '
        f'{closure(orbit):.0e} | {cpu} |'
    )


def why(said: str) -> str:
    """In few words."""
    for sign, words in (
        ('search ends', 'end of the search'), ('lands', 'the foot lands early'),
        ('pull', 'the ground would have to pull'), ('misses', 'no motion near the guesses'),
    ):  # fmt: skip
        if sign in said:
            return words
    return 'no motion found'


def reach(degrees: int, length: float, limit: float | None, found: OrbitLibrary | None) -> str:
    head = f'| {degrees} | {length} | {limit or ROBOT.torque_limit:g} |'
    if found is None:
        return f'{head} none found | | |'
    return (
        f'{head} {found.speeds[0]:.3f} to {found.speeds[-1]:.3f} | {why(found.slower)} | '
        f'{why(found.faster)} |'
    )


def steeper(degrees: int, length: float, speed: float, approach: float) -> str:
    orbit, _ = timed(
        plan_orbit, ROBOT, speed, length, math.radians(degrees), approach=approach
    )  # fmt: skip
    head = f'| {degrees} | {length} | {speed:.2f} | {approach} |'
    if orbit is None:
        return f'{head} none found | | |'
    return (
        f'{head} {orbit.impact_friction_needed:.2f} | {orbit.cost_of_transport:.3f} | '
        f'{orbit.peak_torque:.1f} |'
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split('\n', 1)[0])
    parser.add_argument('--write', action='store_true')
    options = parser.parse_args()
    timed(plan_orbit, ROBOT, 0.3, 0.3)  # what is compiled once
    began = time.process_time()
    orbits, ranges = [], []
    for degrees in SLOPES:
        for length in LENGTHS:
            slope, whole = math.radians(degrees), None
            for limit in LIMITS:
                library, _ = timed(orbit_library, ROBOT, length, slope, limit)
                whole = library if limit is None else whole
                ranges.append(reach(degrees, length, limit, library))
                print(ranges[-1], flush=True)
            for speed in SPEEDS:
                orbits.append(row(degrees, length, speed, whole))
                print(orbits[-1], flush=True)
    landings = [steeper(*what, approach) for what in STEEPER for approach in APPROACHES]
    print(*landings, sep='\n')
    spent = time.process_time() - began
    lines = [
        '# Walking orbits',
        '',
        f'Made by `python bench/orbits.py --write`, {spent:.0f} s CPU, '
        f'Python {platform.python_version()}, {platform.machine()}.',
        '',
        'The robot of `compass_gait_mit`, limit 40 N m. Slope in degrees, positive falling ahead; '
        'durations of the inner and the outer phase; CoT of the power of the motor and of its '
        'positive part; peak torque with friction; friction of the ground that stance and impacts '
        'need; how deep the extended foot would be; multipliers without feedback; closure after a '
        'period without feedback; CPU of planning from guesses.',
        '',
        '| slope | step, m | speed, m/s | durations, s | CoT | CoT+ | peak, N m | friction needed '
        '| depth, mm | multipliers | closure | CPU, ms |',
        '|---:|---:|---:|---|---:|---:|---:|---|---:|---|---:|---:|',
        *orbits,
        '',
        '## Speeds that are reached from one to the next',
        '',
        '| slope | step, m | limit, N m | speeds, m/s | what ends them below | above |',
        '|---:|---:|---:|---|---|---|',
        *ranges,
        '',
        '## A least rate at which feet land',
        '',
        '| slope | step, m | speed, m/s | approach, m/s | friction needed at impacts | CoT '
        '| peak, N m |',
        '|---:|---:|---:|---:|---:|---:|---:|',
        *landings,
    ]
    if options.write:
        RESULT.write_text('\n'.join(lines) + '\n')


if __name__ == '__main__':
    main()
