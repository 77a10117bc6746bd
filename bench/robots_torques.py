"""How often `cg torques` is right about the robots of robots.py, which share no code with models.

    ./cg exec python bench/robots_torques.py [PATTERN ...]     such as 'arm6:*'
        [--raw FILE] [--write bench/results/robots_torques.md]

The same machines and bags as there, whole, and no simulation. Each case has one core, and as many
run side by side as there are. A case is one of three kinds, settled by what is hidden before any
was run:

    told        by torques: a law of a joint, a body, a drive. Right: the first law that is taken
                up is that at that place, or another that robots_machines.right says is the same.
    not asked   a delay, a sensor, a rotor that moves by itself, a push. Nothing can be right; any
                law that is taken up stands in for it and is counted.
    nothing     sound machines, some with small faults or hard friction. Right: no law.
"""

import argparse
import os
import sys
import tempfile
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from case_rows import known_rows, with_missing
from outside import cpu_seconds, wilson
from robots import ROOT, Case, labels, made, programme, version

from cg_dynamics.model import Model
from cg_sysid.checks.loading import load_bags
from cg_sysid.diagnosis.diagnose import split
from cg_sysid.identification.data_set import prepare
from cg_sysid.search.torque_selection import select

NOT_ASKED = {
    'actuator_delay', 'sensor_delay', 'encoder_eccentricity', 'encoder_offset',
    'joint_flexibility', 'backlash', 'external_push',
}  # fmt: skip
KINDS = 'told', 'not asked', 'nothing'


def kind_of(effect: str) -> str:
    """One of KINDS."""
    if effect == 'sound':
        return 'nothing'
    return 'not asked' if effect in NOT_ASKED else 'told'


def run(case: Case, of: str, limit: float) -> dict[str, Any]:
    """One line of the raw results."""
    with tempfile.TemporaryDirectory() as folder:
        model_file, bags, values = made(case, Path(folder))
        began = cpu_seconds()
        loaded = load_bags(bags, model_file, whole=True)
        model = Model.load(model_file)
        train, held = split(prepare(model, loaded.records))
        found = select(model, train, held)
        seconds = cpu_seconds() - began
    return {
        'case': case.name, 'robot': case.robot, 'effect': case.effect, 'site': case.site,
        'faults': case.faults, 'hard': case.hard, 'right': labels(case), 'values': values,
        'laws': [law.label for law in found.laws],
        'rivals': [list(law.rivals) for law in found.laws],
        'parameters': [dict(law.parameters) for law in found.laws],
        'identified': found.identified.tolist(), 'extended': found.extended.tolist(),
        'seconds': seconds, 'version': of,
    }  # fmt: skip


def is_right(row: dict[str, Any]) -> bool:
    """As the head of this file says."""
    if kind_of(row['effect']) == 'told':
        return bool(row['laws']) and row['laws'][0] in row['right']
    return not row['laws']


def table_of(rows: list[dict[str, Any]]) -> list[str]:
    """By robot and kind, then every case."""
    lines = [
        '| robot | hidden | cases | right | 95 % interval | further laws | CPU s: median '
        '| longest |',
        '|---|---|---:|---:|---:|---:|---:|---:|',
    ]
    for robot in (*dict.fromkeys(row['robot'] for row in rows), 'all'):
        for kind in KINDS:
            own = [
                row for row in rows
                if robot in (row['robot'], 'all') and kind_of(row['effect']) == kind
            ]  # fmt: skip
            if not own:
                continue
            correct = sum(map(is_right, own))
            low, high = wilson(correct, len(own))
            further = sum(len(row['laws'][kind == 'told' :]) for row in own)
            spent = [row['seconds'] for row in own]
            lines.append(
                f'| {robot} | {kind} | {len(own)} | {correct} | {low:.0%} to {high:.0%} '
                f'| {further} | {np.median(spent):.0f} | {max(spent):.0f} |'
            )
    lines += ['', '| case | where | small faults | laws (rivals) | right | CPU s |',
              '|---|---|---|---|---|---:|']  # fmt: skip
    for row in rows:
        laws = '; '.join(
            f'{law} ({", ".join(rivals)})' if rivals else law
            for law, rivals in zip(row['laws'], row['rivals'], strict=True)
        )
        where = 'hard friction' if row['hard'] else row['site']
        lines.append(
            f'| {row["case"]} | {where} | {"yes" if row["faults"] else ""} | {laws} '
            f'| {"yes" if is_right(row) else "**no**"} | {row["seconds"]:.0f} |'
        )
    return lines


def told(row: dict[str, Any]) -> str:
    """A row for the screen."""
    words = row['case'], row['site'], '->', *row['laws'], '' if is_right(row) else 'WRONG'
    return ' '.join([*words, f'{row["seconds"]:.0f} s'])


def main() -> int:
    """Run what is missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('patterns', nargs='*', default=['*'], help="such as 'arm2:*friction'")
    parser.add_argument('--raw', type=Path, default=ROOT / 'bench/results/robots_torques.jsonl')
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    of = version()
    cases = [c for c in programme() if any(fnmatch(c.name, p) for p in options.patterns)]
    found = with_missing(
        known_rows(options.raw, of), cases, run, of, options.raw, os.cpu_count() or 1, np.inf, told
    )
    lines = [
        '# Laws by torques alone, of robots that share no code with the models',
        '',
        'Command: `./cg exec python bench/robots_torques.py`. What counts as right stands at the '
        f'head of the bench. Sources {of}.',
        '',
        *table_of([found[case.name] for case in cases]),
    ]
    text = '\n'.join(lines) + '\n'
    print(text)
    if options.write:
        options.write.write_text(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
