"""A robot of which the URDF knows the bodies alone, with a secret: `cg torques`, then a diagnosis.

    ./cg exec python bench/robots_bare_secret.py [CASE ...] [--write FILE]

The machines are those of robots_bare.py, with friction at every joint and a rotor at every drive
that no file states. Each has one effect of robots_machines.py more. What is done is what
docs/how_to/robots.md says to do: the torques name what they show, and write a model; the same
recordings and that model go to `diagnose`.

A case is right where the effect is named at its place, by the torques or as a cause, and nothing
is named that the machine does not have. This was settled before any case was run. Frictions and
rotors that neither names are counted and are no mistake here. A drive that gives way or has play
has its rotor behind that, and to call it a rotor is no mistake.

Every case is one line of --raw, with the version of the sources that made it; one that is there is
not run again. A case has all cores, and its time is that of a clock.
"""

import argparse
import multiprocessing
import os
import sys
import tempfile
import time
import traceback
from dataclasses import replace
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np
from case_rows import known_rows, with_missing
from robots import ROOT, Case, answer, labels, version, written
from robots_bare import bare_urdf, machine, said
from robots_machines import EFFECTS, ROBOTS, Secret, sites

from cg_sysid import parallel

ROBOTS_OF = 'arm2', 'cartpole', 'furuta', 'leg3'
LIMIT = 300.0  # s of a diagnosis
BEHIND = 'joint_flexibility', 'backlash'  # effects with a rotor of their own
HAVE = 'viscous_friction', 'coulomb_friction', 'rotor_inertia'  # these machines have them anyway


def programme() -> list[Case]:
    """Every other effect, for each robot where recordings can show it."""
    cases = []
    for name in ROBOTS_OF:
        random = np.random.default_rng([77, list(ROBOTS).index(name)])
        for effect in EFFECTS:
            places = sites(ROBOTS[name], effect)
            if places and effect not in HAVE:
                cases.append(Case(name, effect, 0, str(random.choice(places)), False))
    return cases


def has(case: Case) -> tuple[Secret, list[str], dict[str, float]]:
    """What is wrong with the machine; the laws that it has besides; the secret's numbers."""
    robot = ROBOTS[case.robot]
    bare, lacks = machine(robot)
    secret, values = EFFECTS[case.effect](robot, case.site, np.random.default_rng(case.seed))
    armature = dict(bare.armature)
    if case.effect in BEHIND:
        del armature[case.site]
    values = {name: float(value) for name, value in values.items()}
    return replace(secret, armature=armature), list(lacks), values


def run(case: Case, of: str, limit: float) -> dict[str, Any]:
    """One line of the raw results."""
    robot = ROBOTS[case.robot]
    secret, others, values = has(case)
    row: dict[str, Any] = {
        'case': case.name, 'robot': case.robot, 'effect': case.effect, 'site': case.site,
        'right': labels(case), 'has': others, 'values': values, 'version': of, 'laws': [],
        'causes': [],
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        model, bags = written(robot, secret, bare_urdf(robot), case.seed, Path(folder))
        began = time.monotonic()
        try:
            found = said(model, bags)
            row['laws'] = [law.label for law in found.laws]
            row['sizes'] = {
                law.label: {n: v[:2] for n, v in law.parameters.items()} for law in found.laws
            }
            row['torques_s'] = round(time.monotonic() - began, 1)
            extended = Path(folder) / 'extended.yaml'
            found.model.save(extended)
            began = time.monotonic()
            row |= answer(extended, bags, limit, os.cpu_count() or 1)
        except Exception:  # what it dies of is a wrong answer, not the bench's end
            row |= {'verdict': 'failed', 'why': traceback.format_exc(limit=-4)}
    row['diagnosis_s'] = round(time.monotonic() - began, 1)
    parallel.stop()
    for worker in multiprocessing.active_children():
        worker.join()
    return row


def named(row: dict[str, Any]) -> list[str]:
    """All that is said to be wrong, laws of the torques first."""
    return [*row['laws'], *row['causes']]


def untrue(row: dict[str, Any]) -> list[str]:
    """What is named and the machine does not have."""
    return [label for label in named(row) if label not in (*row['right'], *row['has'])]


def is_told(row: dict[str, Any]) -> bool:
    """Whether the secret is named."""
    return bool({*named(row)} & {*row['right']})


def is_right(row: dict[str, Any]) -> bool:
    """As the head of this file says."""
    return is_told(row) and not untrue(row)


def table_of(rows: list[dict[str, Any]]) -> list[str]:
    """By robot, then by case."""
    lines = [
        '| robot | cases | secret named | by the torques | right | others that it has | named '
        '| s on 2 cores: torques | diagnosis, median | longest |',
        '|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|',
    ]
    for title in (*ROBOTS_OF, 'all'):
        own = [row for row in rows if title in (row['robot'], 'all')]
        if not own:
            continue
        early = sum(bool({*row['laws']} & {*row['right']}) for row in own)
        laws = sum(len({*named(row)} & {*row['has']}) for row in own)
        torques = np.median([row.get('torques_s', np.nan) for row in own])
        spent = [row['diagnosis_s'] for row in own]
        lines.append(
            f'| {title} | {len(own)} | {sum(map(is_told, own))} | {early} '
            f'| {sum(map(is_right, own))} | {sum(len(row["has"]) for row in own)} | {laws} '
            f'| {torques:.0f} | {np.median(spent):.0f} | {max(spent):.0f} |'
        )
    lines += [
        '',
        '| case | where | verdict | secret named | first by | others that the machine has: named '
        '| untrue | chi2/N before, after | s |',
        '|---|---|---|---|---|---:|---|---:|---:|',
    ]
    for row in rows:
        by = next((w for w in ('laws', 'causes') if {*row[w]} & {*row['right']}), '')
        errors = f'{row["before"]:.4g}, {row["after"]:.4g}' if 'before' in row else ''
        laws = len({*named(row)} & {*row['has']})
        lines.append(
            f'| {row["case"]} | {row["site"]} | {row["verdict"]} '
            f'| {"yes" if is_told(row) else "**no**"} '
            f'| {dict(laws="torques", causes="diagnosis").get(by, "")} '
            f'| {laws} of {len(row["has"])} | {", ".join(untrue(row))} | {errors} '
            f'| {row.get("torques_s", 0) + row["diagnosis_s"]:.0f} |'
        )
    return lines


def in_words(row: dict[str, Any]) -> str:
    """A row for the screen."""
    right = '' if is_right(row) else 'WRONG'
    seconds = f'{row.get("torques_s", 0)} + {row["diagnosis_s"]} s'
    return ' '.join([row['case'], row['site'], '->', *row['laws'], '|', row['verdict'],
                     *row['causes'], right, seconds])  # fmt: skip


def main() -> int:
    """Run the cases that are missing, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('patterns', nargs='*', default=['*'], help="such as 'arm2:*'")
    parser.add_argument('--limit', type=float, default=LIMIT, help=f's, diagnosis [{LIMIT:g}]')
    parser.add_argument('--raw', type=Path, default=ROOT / 'build/robots_bare_secret.jsonl')
    parser.add_argument('--table-only', action='store_true', help='of the last version in --raw')
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    of = version()
    cases = [c for c in programme() if any(fnmatch(c.name, p) for p in options.patterns)]
    rows = known_rows(options.raw, None if options.table_only else of)
    if not options.table_only:
        rows = with_missing(rows, cases, run, of, options.raw, 1, options.limit, in_words)
    shown = [rows[case.name] for case in cases if case.name in rows]
    if not shown:
        print('no rows of these sources', file=sys.stderr)
        return 1
    lines = table_of(shown)
    print('\n'.join(lines))
    if options.write:
        options.write.write_text('\n'.join([
            '# Robots of which the URDF knows the bodies alone, with a secret', '',
            'Command: `./cg exec python bench/robots_bare_secret.py '
            f'{" ".join(map(repr, options.patterns))} --limit {options.limit:g}`; this table of '
            f'its rows: the same with `--table-only --write FILE`. Sources {shown[0]["version"]}; '
            f'{len(shown)} of {len(programme())} cases run.',
            'What is right is written at the head of the bench, and was settled before any case '
            'was run.', '', *lines, '',
        ]))  # fmt: skip
    return 0


if __name__ == '__main__':
    sys.exit(main())
