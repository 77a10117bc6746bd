"""Are stated intervals right? Fits of the true structure to hidden effects, against the truth.

    ./cg exec python bench/intervals.py [--first 3001] [--seeds 3] [--effects a,b] [--faults]
        [--workers N] [--write FILE]

Machines and records are those of bench/hidden_effects.py. No cause is sought: to each machine the
thorough fit of its own structure is made, as the diagnosis makes it of what it has found, from
the file's numbers and four fifths of the effect's. What lies between its values and the true ones,
in stated standard deviations, is z: of a right interval 95 % of them lie within 1.96, and their
root mean square is 1. `--faults` leaves in small faults and lets the fit have them.
"""

import argparse
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
from hidden_effects import SPRING_ERROR, errors_of, hide, records_of, with_small_faults

from cg_bringup.hidden import hideable_effects
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_sysid.diagnosis.diagnose import split
from cg_sysid.identification.data_set import led_in, prepare
from cg_sysid.identification.identify import fit
from cg_sysid.parallel import run_all
from cg_sysid.search import settings
from cg_sysid.search.nuisance import with_nuisances

SIZES = 1.0, 0.5
SHORT_OF = 0.8  # of the true values, where the fit sets out
ELSEWHERE = 'external_push', 'friction_drift', 'imu_drift'  # own to records, or begin late
OUTLIER = 10.0  # standard deviations, beyond which a fit did not find the bottom


def z_scores(name, seed, faults):
    """Errors of the effect's parameters and of the robot's own in stated sigmas: two lists."""
    size = float(np.random.default_rng(seed).choice(SIZES))
    nominal, machine, hidden = hide(Model.load(model_path(NOMINAL_MODEL)), (name,), size, seed)
    machine = with_small_faults(machine) if faults else machine
    records = records_of(machine, seed, SPRING_ERROR * faults)
    train, held = split([led_in(data_set) for data_set in prepare(nominal, records)])
    values = hidden[name]  # none of those that the nominal model had, and has lost here
    structure = nominal.with_effect(name, None, **{n: SHORT_OF * v for n, v in values.items()})
    bounds = {}
    if faults:
        structure, bounds = with_nuisances(structure, [t.setup for t in (*train, *held)])
    found = fit(
        structure,
        train,
        bounds=bounds,
        thorough=True,
        iterations=settings.FITTING.thorough_iterations,
    )
    numbers = {
        u.name: (value, sigma, u.unit)
        for u, value, sigma in zip(found.unknowns, found.values, found.sigmas, strict=True)
    }
    prefix = f'{name}.'
    own = {n.removeprefix(prefix): x for n, x in numbers.items() if n.startswith(prefix)}
    true = values or {n: machine.values[prefix + n] for n in own}
    robots = {n: x for n, x in numbers.items() if n in nominal.quantities and n not in bounds}
    return (
        [error / sigma for error, sigma in errors_of(own, true)],
        [(value - machine.values[n]) / sigma for n, (value, sigma, _) in robots.items()],
    )


def row_of(name, z):
    z = np.array(z)
    near = np.abs(z) < OUTLIER
    return (
        f'| {name} | {len(z)} | {(np.abs(z) < 1.96).sum()} | {np.sqrt((z[near] ** 2).mean()):.2f} '
        f'| {(~near).sum()} |'
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--first', type=int, default=3001)
    parser.add_argument('--seeds', type=int, default=3)
    parser.add_argument('--effects', help='comma-separated')
    parser.add_argument('--faults', action='store_true', help='leave in small faults')
    parser.add_argument('--workers', type=int)
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    known = hideable_effects(Model.load(model_path(NOMINAL_MODEL)))
    wanted = options.effects.split(',') if options.effects else known
    cases = [
        (name, options.first + 1000 * k + j, options.faults)
        for k in range(options.seeds)
        for j, name in enumerate(known) if name in wanted and name not in ELSEWHERE
    ]  # fmt: skip
    began = time.monotonic()
    results = run_all(z_scores, cases, options.workers)
    effects, robots = defaultdict(list), []
    for (name, _, _), (own, others) in zip(cases, results, strict=True):
        effects[name] += own
        robots += others
    lines = [
        '# Stated intervals against the truth', '',
        f'Command: `./cg exec python bench/intervals.py --first {options.first} --seeds '
        f'{options.seeds}{" --faults" * options.faults}`. {len(cases)} fits, '
        f'{time.monotonic() - began:.0f} s.', '',
        f'| parameters of | number | inside 95 % | rms of z | beyond {OUTLIER:g} |',
        '|---|---:|---:|---:|---:|',
        *(row_of(name, z) for name, z in sorted(effects.items())),
        row_of('**all effects**', [z for own in effects.values() for z in own]),
        row_of('**the robot itself**', robots), '',
    ]  # fmt: skip
    print('\n'.join(lines))
    if options.write:
        options.write.write_text('\n'.join(lines))


if __name__ == '__main__':
    main()
