"""Landings hidden in walking records: what the diagnosis says of the ground.

    ./cg exec python bench/landings.py --seeds 5 6 --cases plastic e0.3 mu0.25

Six walks of 4 s down a slope of 0.05 rad (src/cg_dynamics/test/walking.py: a finer step, noise,
counts, stamps that jitter) on machines whose numbers are 10 to 20 % off. Writes a table.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / 'src/cg_dynamics/test'), str(ROOT / 'src/cg_sysid/test')]

from walking import walking  # noqa: E402 - test support
from walking_records import as_record  # noqa: E402

from cg_bringup.hidden import perturb  # noqa: E402
from cg_description.paths import model_path  # noqa: E402
from cg_dynamics.model import Model  # noqa: E402
from cg_sysid.diagnosis.diagnose import diagnose  # noqa: E402
from cg_sysid.diagnosis.result import Options  # noqa: E402
from cg_sysid.stances.phases import cut_steps  # noqa: E402

CASES = {
    'plastic': {},
    'e0.1': {'impact_restitution': {'coefficient': 0.1}},
    'e0.3': {'impact_restitution': {'coefficient': 0.3}},
    'mu0.35': {'foot_slip': {'friction': 0.35}},
    'mu0.25': {'foot_slip': {'friction': 0.25}},
    'mu0.2': {'foot_slip': {'friction': 0.2}},
    'e0.2 mu0.35': {
        'impact_restitution': {'coefficient': 0.2}, 'foot_slip': {'friction': 0.35},
    },
    'payload': {'payload': {'mass': 1.2, 'distance': 0.3}},
}  # fmt: skip
EFFECTS = ('foot_slip', 'impact_restitution', 'external_push', 'torque_bias', 'payload')
WALKS, DURATION = 6, 4.0


def row(case: str, seed: int) -> str:
    nominal = Model.load(model_path('compass_gait_mit'))
    machine, _ = perturb(nominal, np.random.default_rng(seed))
    for effect, values in CASES[case].items():
        machine = machine.with_effect(effect, None, **values)
    records = []
    for k in range(WALKS):
        stance = ('inner', 'outer')[k % 2]
        done = walking(machine, k, DURATION, stance=stance)
        records.append(as_record(f'walk_{k}', done, stance, k))
    began = time.perf_counter()
    cut = cut_steps(records, nominal)
    found = diagnose(nominal, cut.records, Options(effects=EFFECTS, workers=1),
                     landings=cut.landings)  # fmt: skip
    named = ', '.join(
        f'{c.label} '
        + ' '.join(f'{n} {v:.4g} ± {s:.2g}' for n, (v, s, _) in c.parameters.items())
        + (f' or {" or ".join(c.rivals)}' if c.rivals else '')
        for c in found.causes
    )
    return (
        f'| {case} | {seed} | {len(cut.landings)} | {found.verdict} | {named} '
        f'| {time.perf_counter() - began:.0f} |'
    )


def main() -> None:
    options = argparse.ArgumentParser()
    options.add_argument('--seeds', type=int, nargs='+', default=[5])
    options.add_argument('--cases', nargs='+', default=list(CASES), choices=list(CASES))
    options.add_argument('--out', type=Path, default=ROOT / 'bench/results/landings.md')
    given = options.parse_args()
    lines = [
        '# Landings hidden in walking records', '',
        f'`bench/landings.py`, effects tried: {", ".join(EFFECTS)}.', '',
        '| hidden | machine | touchdowns | verdict | named | s |', '|---|---|---|---|---|---|',
    ]  # fmt: skip
    for seed in given.seeds:
        for case in given.cases:
            lines.append(row(case, seed))
            print(lines[-1], flush=True)
            given.out.write_text('\n'.join(lines) + '\n', encoding='utf-8')


if __name__ == '__main__':
    main()
