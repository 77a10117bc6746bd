"""How long a diagnosis takes: the whole library on six records of 20 s at 500 Hz.

    ./cg exec python bench/diagnosis_speed.py [--cases 20] [--workers 2] [--write FILE]
    ./cg exec python bench/diagnosis_speed.py --other DIR      the same with another checkout, too

Machines are those of outside.py: single effects by the library's laws and by others, pairs, sound
ones, small faults, what is in no library; the first of that sample. The records are longer, and
so is the sweep of the excitation: the first seconds say less about what is fast. The first case
is a newcomer's: a pendulum, four records of 20 s at 200 Hz, Stribeck friction hidden.

Every diagnosis is a process of its own. Compilation counts: the folder of compiled models is new.
With --other the same records go to the packages of another checkout, right after, and what has
no answer within --limit there is marked with '>'.
"""

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
SECONDS, RATE = 20.0, 200.0
LIMIT = 600.0  # s of wall time of one diagnosis
HERE = Path(__file__).name
PENDULUM = 'pendulum'


def records_for(name: str):
    """Nominal model and records of a case of outside.py, or of the newcomer's pendulum."""
    from hidden_effects import PROGRAMME
    from outside import programme, records_of

    if name == PENDULUM:
        return pendulum()
    case = next(case for case in programme() if case.name == name)
    return records_of(case, PROGRAMME[:6], SECONDS)[:2]


def pendulum():
    """A pendulum whose friction falls with the rate, by its own model file."""
    from cg_description.paths import model_path
    from cg_dynamics.model import Model
    from cg_dynamics.rig import Setup
    from cg_sysid.experiments.rehearsal import rehearse

    nominal = Model.load(model_path('sydney_pendulum'))
    turning = nominal.values['coulomb_friction.transition_rate']
    machine = nominal.with_effect(
        'stribeck_friction', torque=0.02, stribeck_rate=1.0, transition_rate=turning
    )
    records = []
    for k in range(4):
        f = 0.3 + 0.15 * k

        def torque(t, f=f, k=k):
            turn = 2 * math.pi * f * t
            return 0.12 * math.sin(turn) + 0.03 * math.sin(2.3 * turn)

        start = [0.2 * k, 0.0]
        records.append(
            rehearse(f'swing_{k}', machine, Setup(), start, [torque], SECONDS, 1 / RATE, k)
        )
    return nominal, records


def diagnosed(name: str, workers: int) -> None:
    """Carry out one diagnosis and print what it took, as JSON."""
    from outside import cpu_seconds

    from cg_sysid.diagnosis.diagnose import diagnose
    from cg_sysid.diagnosis.result import Options

    nominal, records = records_for(name)
    wall, cpu = time.monotonic(), cpu_seconds()
    found = diagnose(nominal, records, Options(workers=workers))
    print(json.dumps({
        'verdict': found.verdict, 'causes': [c.label for c in found.causes],
        'wall': time.monotonic() - wall, 'cpu': cpu_seconds() - cpu,
    }))  # fmt: skip


def timed(name: str, workers: int, packages: Path, limit: float) -> dict:
    """What one diagnosis by the packages of a checkout took."""
    with tempfile.TemporaryDirectory() as cache:
        paths = [str(p) for p in sorted(packages.glob('src/cg_*'))]
        env = os.environ | {'PYTHONPATH': ':'.join(paths), 'XDG_CACHE_HOME': cache}
        command = [sys.executable, str(ROOT / 'bench' / HERE), '--one', name, '--workers',
                   str(workers)]  # fmt: skip
        try:
            done = subprocess.run(
                command, env=env, capture_output=True, text=True, timeout=limit + 60, check=True
            )
        except subprocess.TimeoutExpired:
            return {'verdict': 'no answer', 'causes': [], 'wall': limit, 'cpu': limit,
                    'over': True}  # fmt: skip
        except subprocess.CalledProcessError as error:
            return {'verdict': 'failed', 'causes': [error.stderr.strip().splitlines()[-1]],
                    'wall': math.nan, 'cpu': math.nan}  # fmt: skip
    return json.loads(done.stdout.splitlines()[-1])


def row_of(name: str, laws: str, new: dict, other: dict | None) -> str:
    """One line of the table."""
    cells = [name, laws, new['verdict'], ', '.join(new['causes']), f'{new["wall"]:.0f}',
             f'{new["cpu"]:.0f}']  # fmt: skip
    if other:
        over = '>' if other.get('over') else ''
        cells += [f'{over}{other["wall"]:.0f}', f'{over}{other["wall"] / new["wall"]:.1f}']
    return '| ' + ' | '.join(cells) + ' |'


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--cases', type=int, default=20)
    parser.add_argument('--workers', type=int, default=2)
    parser.add_argument('--limit', type=float, default=LIMIT)
    parser.add_argument('--other', type=Path, help='another checkout, its wheels being the same')
    parser.add_argument('--one', help=argparse.SUPPRESS)
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    if options.one:
        diagnosed(options.one, options.workers)
        return
    from outside import programme, sampled

    chosen = {case.name: ' + '.join(case.laws) or f'nothing, friction: {case.friction}'
              for case in sampled(programme(), options.cases - 1)}  # fmt: skip
    chosen = {PENDULUM: 'stribeck_friction', **chosen}
    lines, walls, ratios = [], [], []
    for name, laws in chosen.items():
        new = timed(name, options.workers, ROOT, options.limit)
        other = None
        if options.other:
            other = timed(name, options.workers, options.other, options.limit)
        walls.append(new['wall'])
        ratios += [other['wall'] / new['wall']] if other else []
        lines.append(row_of(name, laws, new, other))
        print(lines[-1], f'load {os.getloadavg()[0]:.1f}', flush=True)
    median, late, longest = np.nanquantile(walls, [0.5, 0.95, 1.0])
    total = (
        f'{len(walls)} cases, wall time with {options.workers} workers: median {median:.0f} s, '
        f'95 % {late:.0f} s, longest {longest:.0f} s.'
    )
    if ratios:
        total += f' The other checkout took {np.nanmedian(ratios):.1f} times as long (median).'
    print(total)
    if options.write:
        other = ' other, s | ratio |' if options.other else ''
        options.write.write_text('\n'.join([
            '# Speed of a diagnosis', '',
            f'Six records of {SECONDS:g} s at 500 Hz, the whole library, compilation included; '
            'the command stands in bench/diagnosis_speed.py.', '', total, '',
            f'| case | hidden | verdict | causes | wall, s | CPU, s |{other}',
            '|---|---|---|---|---:|---:|' + ('---:|---:|' if options.other else ''), *lines, '',
        ]))  # fmt: skip


if __name__ == '__main__':
    main()
