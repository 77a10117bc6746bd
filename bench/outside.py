"""How often a diagnosis is right about machines that share no code with its models.

    ./cg exec python bench/outside.py                          the whole programme, 190 cases
    ./cg exec python bench/outside.py --sample 60              of every kind its share, drawn once
    ./cg exec python bench/outside.py --sample 60 --after 28   the others of these
    ./cg exec python bench/outside.py --case single:17         one of them, in words
    ./cg exec python bench/outside.py --table-only --write bench/results/outside.md

The machines are MuJoCo's, what is wrong with them is written in foreign_laws.py: effects of the
library, for half of the cases by other laws than the library's. Numbers are 10 to 15 % off the
nominal file, sizes are drawn as in bench/hidden_effects.py, with the same experiments, noise and
counts: eight records of 8 s at 500 Hz. The hip body is left out, which a plain link cannot be. A
third of the machines has small faults: a delay of 1 ms, springs 1 % off, an encoder 0.3 mrad off,
dry friction that turns twice as fast.

    single     one effect                                       100 cases
    pair       two of them                                       30
    sound      nothing; a third each with nothing else, with     40
               small faults, with friction by another law
    unlisted   something that no effect of the library is        20

What is right was settled before any was run. single: the first cause is the effect, or one that
foreign_laws.RIGHT has for that law. pair: the causes are the two, and no third. sound: no cause
(how many are told `unexplained` all the same stands below the table).
unlisted: no cause, or those that are named are not all (`unexplained`).

Every case is one line of --raw, with the version of the sources that made it; a case that is
there in this version is not run again. Cases that fail, or have no answer within --limit, count
as wrong.
"""

import argparse
import hashlib
import json
import math
import multiprocessing
import os
import resource
import sys
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from case_rows import known_rows, with_missing
from foreign_laws import (
    FINE,
    FRICTIONS,
    LAWS,
    RIGHT,
    SAMPLE,
    TURN,
    UNLISTED,
    Machine,
    Secret,
    at_hip,
    beside,
)
from hidden_effects import PROGRAMME, SECONDS, SPRING_ERROR, errors_of
from mujoco_robot import Hidden, simulate_mujoco, two_links

from cg_bringup.hidden import draw_values, hidden_effects_file
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_sysid import parallel
from cg_sysid.deadline import Deadline
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.records.record import Record
from cg_sysid.search.ranking import effect_name

OFF = ('c1', 'c2', 'c4', 'c5', 'coulomb_friction.torque', 'viscous_friction.coefficient')
PAUSE = 2.0  # s between two recordings
CHANNELS = ('imu_angle', 'imu_rate', 'hip_angle')
KINDS = {'single': 100, 'pair': 30, 'sound': 40, 'unlisted': 20}
LATE, ZERO = 1e-3, 3e-4  # s and rad, of small faults
LIMIT = 600.0  # s of one diagnosis on one core
CONFIDENCE = 1.96
ROOT = Path(__file__).parents[1]


@dataclass(frozen=True)
class Case:
    """One machine.

    Attributes:
        kind: Of KINDS.
        number: Among its kind, from 0.
        laws: What is hidden: names in LAWS, one in UNLISTED, or none.
        friction: Law of the machine's own dry friction, of FRICTIONS.
        faults: Whether it has small faults.
    """

    kind: str
    number: int
    laws: tuple[str, ...]
    friction: str = 'tanh'
    faults: bool = False

    @property
    def name(self) -> str:
        """As --case takes it."""
        return f'{self.kind}:{self.number}'

    @property
    def seed(self) -> int:
        """Of everything that is random in it."""
        return 1000 * list(KINDS).index(self.kind) + self.number + 1

    @property
    def group(self) -> str:
        """The row of the table that it counts in."""
        if self.kind == 'single':
            return 'single, by another law' if '/' in self.laws[0] else 'single'
        if self.kind == 'sound':
            if self.friction != 'tanh':
                return 'sound, other friction'
            return 'sound, small faults' if self.faults else 'sound, nothing else'
        return self.kind


def programme() -> list[Case]:
    """All cases."""
    rng = np.random.default_rng(2026)
    own = [name for name in LAWS if '/' not in name]
    other = [name for name in LAWS if '/' in name]
    cases = []
    for kind, laws in (('single', own), ('single', other)):
        order = [str(x) for x in rng.permutation(laws)]
        for k in range(KINDS[kind] // 2):
            number = len(cases)
            cases.append(Case(kind, number, (order[k % len(order)],), faults=number % 3 == 2))
    while len(cases) < KINDS['single'] + KINDS['pair']:
        pair = tuple(str(x) for x in rng.choice([*own, *other], 2, replace=False))
        if _compatible(pair):
            number = len(cases) - KINDS['single']
            cases.append(Case('pair', number, pair, faults=number % 3 == 2))
    others = [name for name in FRICTIONS if name != 'tanh']
    for k in range(KINDS['sound']):
        friction = others[k // 3 % len(others)] if k % 3 == 1 else 'tanh'
        cases.append(Case('sound', k, (), friction, k % 3 == 2))
    for k in range(KINDS['unlisted']):
        cases.append(Case('unlisted', k, (list(UNLISTED)[k % len(UNLISTED)],)))
    return cases


def _compatible(pair: tuple[str, ...]) -> bool:
    first, second = (set(right_names(name)) for name in pair)
    parts = {'joint_flexibility', 'backlash'}  # one thing between motor and hip
    return not first & second and not (first & parts and second & parts)


def right_names(law: str) -> tuple[str, ...]:
    """Effects that are right as a name of this law."""
    return (law.partition('/')[0], *RIGHT.get(law, ()))


def sampled(cases: list[Case], count: int) -> list[Case]:
    """Of every kind its share of so many cases, drawn once: a smaller sample is part of a larger.

    In an order in which every beginning has all kinds.
    """
    ranked = []
    for k, kind in enumerate(KINDS):
        own = [case for case in cases if case.kind == kind]
        order = np.random.default_rng([2, k]).permutation(len(own))
        ranked += [((rank + 0.5) / len(own), own[i]) for rank, i in enumerate(order)]
    ranked.sort(key=lambda pair: pair[0])
    return [case for _, case in ranked[:count]]


def records_of(
    case: Case, names: Sequence[str] = PROGRAMME, seconds: float = SECONDS
) -> tuple[Model, list[Record], dict[str, dict[str, float]]]:
    """The nominal model, the records of the machine, and the hidden values by effect.

    Args:
        case: The machine.
        names: Experiments, one for each record.
        seconds: Length of each.
    """
    file = Model.load(model_path(NOMINAL_MODEL))
    nominal = file.with_values(two_links(file.values))
    rng = np.random.default_rng(case.seed)
    truth = dict(nominal.values)
    for name in OFF:
        truth[name] *= float(1 + rng.choice([-1, 1]) * rng.uniform(0.1, 0.15))
    table = yaml.safe_load(hidden_effects_file().read_text(encoding='utf-8'))
    listed = [law for law in case.laws if law in LAWS]
    values = {law: draw_values(table[law.partition('/')[0]], rng) for law in listed}
    # Where the leg that stands is held, a push at the hip does nothing.
    free = [i for i, name in enumerate(names) if load_experiment(name).setup.springs]
    pushed = int(rng.choice(free))
    records = []
    for i, experiment in enumerate(names):
        machine = Machine(
            truth['leg_length'], i, pushed, i * (seconds + PAUSE), np.random.default_rng(
                [case.seed, i]),
        )  # fmt: skip
        secret = own_friction(case, truth)
        for law in case.laws:
            wrong = LAWS[law](values[law], machine) if law in LAWS else UNLISTED[law](machine)
            secret = beside(secret, wrong)
        records.append(record(experiment, truth, secret, nominal, case, machine, seconds))
    return nominal, records, {law.partition('/')[0]: v for law, v in values.items()}


def own_friction(case: Case, truth: dict[str, float]) -> Secret:
    """The dry friction of the machine, by another law than the simulation's."""
    if case.friction == 'tanh':
        return Secret()
    law, level = FRICTIONS[case.friction](), truth['coulomb_friction.torque']
    return at_hip(lambda *at: level * law(*at))


def record(
    experiment: str,
    truth: dict[str, float],
    secret: Secret,
    nominal: Model,
    case: Case,
    machine: Machine,
    seconds: float = SECONDS,
) -> Record:
    """One recording of MuJoCo's robot."""
    e = load_experiment(experiment)
    seed = 100 * case.seed + machine.index
    signal = make_signal(ExcitationSettings(**e.excitation, duration=seconds, seed=seed))
    rows = round(seconds / SAMPLE)
    reported = np.array([signal(k * SAMPLE) for k in range(rows)])
    dt = SAMPLE / FINE
    plain = case.friction == 'tanh'
    hidden = Hidden(
        viscous=truth['viscous_friction.coefficient'],
        coulomb=truth['coulomb_friction.torque'] if plain else 0.0,
        transition_rate=TURN / 2 if case.faults else TURN, **secret.robot,
    )  # fmt: skip
    setup = e.setup
    if case.faults:
        hidden = replace(hidden, torque_delay=hidden.torque_delay + LATE)
        stiffer = [replace(s, stiffness=s.stiffness * (1 + SPRING_ERROR)) for s in setup.springs]
        setup = replace(setup, springs=tuple(stiffer))
    out = simulate_mujoco(
        {n: x for n, x in truth.items() if '.' not in n}, setup,
        secret.command(np.repeat(reported, FINE), dt), dt, np.array(e.initial_state, float),
        hidden, fine_step=secret.step,
    )  # fmt: skip
    shown = secret.read({c: out[c] for c in CHANNELS}, out['time'])
    rng = np.random.default_rng(seed)
    outputs = {}
    for channel in CHANNELS:
        has = {name: q.value for name, q in nominal.sensors[channel].items()}
        values = shown[channel][::FINE] + has.get('noise', 0.0) * rng.standard_normal(rows)
        values = values + ZERO * (case.faults and channel == 'hip_angle')
        count = has.get('resolution')
        outputs[channel] = np.round(values / count) * count if count else values
    return Record(
        name=f'{machine.index}_{experiment}',
        stamp_ns=((machine.begin + np.arange(rows) * SAMPLE) * 1e9).round().astype(np.int64),
        inputs={'hip_torque': reported},
        outputs=outputs,
        mechanism='compass_gait',
        setup=e.setup,
    )


def cpu_seconds() -> float:
    """Of this process and of those that it waited for, as compilers."""
    whole = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(u.ru_utime + u.ru_stime for u in whole)


def run(case: Case, version: str, limit: float, cores: int = 1) -> dict[str, Any]:
    """One line of the raw results."""
    about = {'case': case.name, 'group': case.group, 'version': version, 'laws': case.laws,
             'friction': case.friction, 'faults': case.faults}  # fmt: skip
    nominal, records, values = records_of(case)
    cpu, wall = cpu_seconds(), time.monotonic()
    try:
        found = diagnose(nominal, records, Options(workers=cores), deadline=Deadline(limit))
    except Exception:  # whatever a diagnosis dies of is a wrong answer, and not the bench's end
        return about | {'verdict': 'failed', 'why': traceback.format_exc(limit=-3), 'causes': [],
                        'rivals': [], 'inside': [], 'values': values, 'cores': cores,
                        'cpu_s': round(cpu_seconds() - cpu, 1)}  # fmt: skip
    wall = time.monotonic() - wall
    parallel.stop()
    for worker in multiprocessing.active_children():
        worker.join()  # what it spent counts from then on
    described = found.unmodelled.explained if found.unmodelled else 0.0
    return about | {
        'values': values,
        'verdict': found.verdict,
        'causes': [effect_name(c.label) for c in found.causes],
        'rivals': [sorted({effect_name(r) for r in c.rivals}) for c in found.causes],
        'parameters': {
            c.label: {n: v[:2] for n, v in c.parameters.items()} for c in found.causes
        },
        'before': found.baseline.held.normalised_error,
        'after': found.extended.held.normalised_error,
        'described': described,
        'inside': [
            bool(abs(off) < CONFIDENCE * sigma)
            for c in found.causes for law in case.laws
            if law == effect_name(c.label)
            for off, sigma in errors_of(_told(c), values[law])
        ],
        'summary': found.summary,
        'cores': cores,
        'cpu_s': round(cpu_seconds() - cpu, 1),
        'wall_s': round(wall, 1),
    }  # fmt: skip


def _told(cause) -> dict[str, tuple[float, float, str]]:
    """Parameters of a cause, with the surest of what single records have of their own."""
    surest = max(cause.events.values(), default={}, key=_sureness)
    return {**cause.parameters, **surest}


def _sureness(event) -> float:
    size, sigma, _ = next(iter(event.values()))
    return abs(size) / max(sigma, 1e-300)


def is_right(row: dict[str, Any]) -> bool:
    """As the head of this file says."""
    causes, kind = row['causes'], row['case'].partition(':')[0]
    if row['verdict'] in ('failed', 'unfinished'):
        return False
    if kind == 'sound':
        return not causes
    if kind == 'unlisted':
        return row['verdict'] == 'unexplained'
    if kind == 'single':
        return bool(causes) and causes[0] in right_names(row['laws'][0])
    accepted = [right_names(law) for law in row['laws']]
    return len(causes) == 2 and all(any(c in names for c in causes) for names in accepted)


def is_among(row: dict[str, Any]) -> bool:
    """Whether all that was hidden is among causes and rivals."""
    named = {*row['causes'], *(r for rivals in row['rivals'] for r in rivals)}
    return all(named & set(right_names(law)) for law in row['laws'] if law in LAWS)


def wilson(right: int, count: int) -> tuple[float, float]:
    """95 % interval of a share (Wilson 1927)."""
    z, share = CONFIDENCE, right / count
    middle = (share + z**2 / (2 * count)) / (1 + z**2 / count)
    half = z / (1 + z**2 / count) * math.sqrt(
        share * (1 - share) / count + z**2 / (4 * count**2))  # fmt: skip
    return middle - half, middle + half


def table_of(rows: list[dict[str, Any]]) -> list[str]:
    """By group of cases."""
    took, unit = _time_of(rows)
    lines = [
        '| machines | cases | right | 95 % interval | truth among rivals too '
        f'| {unit}: median | 95 % | longest |',
        '|---|---:|---:|---:|---:|---:|---:|---:|',
    ]
    groups = sorted({row['group'] for row in rows}, key=_order)
    for title, own in [(g, [r for r in rows if r['group'] == g]) for g in groups]:
        right = sum(map(is_right, own))
        low, high = wilson(right, len(own))
        seconds = [row[took] for row in own if took in row] or [math.nan]
        hidden = any(law in LAWS for row in own for law in row['laws'])
        among = f'{sum(map(is_among, own))}' if hidden else ''
        lines.append(
            f'| {title} | {len(own)} | {right} | {low:.0%} to {high:.0%} | {among} '
            f'| {np.median(seconds):.0f} | {np.quantile(seconds, 0.95):.0f} '
            f'| {max(seconds):.0f} |'
        )
    inside = [x for row in rows if is_right(row) for x in row['inside']]
    cpu = [row['cpu_s'] for row in rows if 'cpu_s' in row]
    if inside:
        low, high = wilson(sum(inside), len(inside))
        lines += [
            '',
            f'{sum(inside)} of {len(inside)} parameters of right causes lie inside '
            f'their 95 % interval ({low:.0%} to {high:.0%}), where the law is the '
            "library's.",
        ]
    sound = [row for row in rows if row['case'].startswith('sound')]
    astray = sum(row['verdict'] == 'unexplained' for row in sound)
    described = [row.get('described', 0.0) for row in rows if row['group'] == 'unlisted']
    if sound:
        lines += ['', f'Sound machines told `unexplained` all the same: {astray} of {len(sound)}.']
    if described:
        shares = ', '.join(f'{share:.0%}' for share in described)
        lines += ['', f'Share of the error that a learned term takes, unlisted: {shares}.']
    lines += ['', f'All {len(rows)} cases:', '']
    if took == 'wall_s':
        lines.append(f'- {_spread([row[took] for row in rows if took in row])} {unit[2:]}.')
    endless = sum(row['verdict'] == 'unfinished' for row in rows)
    lines += [
        f'- {_spread(cpu)} of CPU time. Models that no case before had are compiled within it.',
        f'- {endless} without an end.',
    ]
    return lines


def _spread(seconds: Sequence[float]) -> str:
    """Times in words."""
    median, late, longest = np.quantile(seconds, [0.5, 0.95, 1.0])
    return f'Median {median:.0f} s, 95 % {late:.0f} s, longest {longest:.0f} s'


def _time_of(rows: list[dict[str, Any]]) -> tuple[str, str]:
    """What is told of the time that cases took, and its unit in words."""
    cores = {row.get('cores', 1) for row in rows}
    return ('cpu_s', 'CPU s') if cores == {1} else ('wall_s', f's on {max(cores)} cores')


def _order(group: str) -> int:
    return [g.startswith(group.split(',')[0]) for g in KINDS].index(True)


def wrong_ones(rows: list[dict[str, Any]]) -> list[str]:
    """A line for each case that is not right."""
    lines = [
        '| case | hidden | verdict | causes (rivals) | chi2/N before, after | CPU s |',
        '|---|---|---|---|---:|---:|',
    ]
    for row in rows:
        if is_right(row):
            continue
        hidden = ' + '.join(row['laws']) or 'nothing'
        hidden += f', friction: {row["friction"]}' if row['friction'] != 'tanh' else ''
        hidden += ', small faults' if row['faults'] else ''
        causes = '; '.join(
            f'{cause} ({", ".join(rivals)})' if rivals else cause
            for cause, rivals in zip(row['causes'], row['rivals'], strict=True)
        )
        errors = f'{row["before"]:.4g}, {row["after"]:.4g}' if 'before' in row else ''
        lines.append(
            f'| {row["case"]} | {hidden} | {row["verdict"]} | {causes} | {errors} '
            f'| {row.get("cpu_s", "")} |'
        )
    return lines


def version_of_sources() -> str:
    """A hash of all sources that an answer depends on."""
    digest = hashlib.sha256()
    packages = 'dynamics', 'interfaces', 'sysid'
    files = [
        *(
            f
            for p in packages
            for kind in ('py', 'c', 'h')
            for f in ROOT.glob(f'src/cg_{p}/cg_{p}/**/*.{kind}')
        ),
        ROOT / 'src/cg_bringup/cg_bringup/hidden.py',
        *ROOT.glob('src/cg_description/models/*.yaml'),
        ROOT / 'bench/foreign_laws.py',
    ]
    for file in sorted(files):
        digest.update(str(file.relative_to(ROOT)).encode() + file.read_bytes())
    return digest.hexdigest()[:12]


def told(row: dict[str, Any]) -> str:
    """A row for the screen."""
    words = row['case'], *row['laws'], '->', row['verdict'], *row['causes']
    took = (str(row[name]) for name in ('cpu_s', 'wall_s') if name in row)
    return ' '.join([*words, '' if is_right(row) else 'WRONG', *took])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--case', help='KIND:NUMBER, run and told in words')
    parser.add_argument('--sample', type=int, help='so many of all cases')
    parser.add_argument('--after', type=int, default=0, help='less so many of the sample [0]')
    parser.add_argument(
        '--cores', type=int, default=os.cpu_count() or 1,
        help='of a case, as many cases side by side as there are cores for [all]',
    )  # fmt: skip
    parser.add_argument('--limit', type=float, default=LIMIT, help=f's a case [{LIMIT:g}]')
    parser.add_argument('--raw', type=Path, default=ROOT / 'build' / 'outside.jsonl')
    parser.add_argument('--write', type=Path)
    parser.add_argument('--table-only', action='store_true', help='of the last version in --raw')
    options = parser.parse_args()
    version, cases = f'{version_of_sources()}-{options.cores}', programme()
    if options.case:
        wanted = [case for case in cases if case.name == options.case]
        if not wanted:
            there = ', '.join(f'{kind}:0 to {n - 1}' for kind, n in KINDS.items())
            print(f'no case {options.case}; there are {there}', file=sys.stderr)
            return 2
        row = run(wanted[0], version, options.limit, options.cores)
        print(json.dumps(row, indent=1), 'right' if is_right(row) else 'wrong', sep='\n')
        return 0
    chosen = sampled(cases, options.sample or len(cases))[options.after :]
    rows = known_rows(options.raw, None if options.table_only else version)
    if not options.table_only:
        rows = with_missing(
            rows, chosen, partial(run, cores=options.cores), version, options.raw,
            max(1, (os.cpu_count() or 1) // options.cores), options.limit, told,
        )  # fmt: skip
    made = [rows[case.name] for case in chosen if case.name in rows]
    if not made:
        print('no rows of these sources', file=sys.stderr)
        return 1
    lines = [*table_of(made), '', *wrong_ones(made)]
    print('\n'.join(lines))
    if options.write:
        count = Counter(case.kind for case in cases)
        what = ', '.join(f'{n} {kind}' for kind, n in count.items())
        drawn = f', {len(made)} of them run' if len(made) < len(cases) else ''
        sample = f' --sample {options.sample}' if options.sample else ''
        sample += f' --after {options.after}' if options.after else ''
        options.write.write_text('\n'.join([
            '# Machines that share no code with the models', '',
            f'Command: `./cg exec python bench/outside.py{sample} --cores '
            f'{made[0].get("cores", 1)}`; this table of its rows: the same with '
            f'`--table-only --write FILE`. Sources {made[0]["version"]}.',
            f'The programme: {what}{drawn}. What is right is written at the head of the bench, '
            'and was settled before any case was run.', '', *lines, '',
        ]))  # fmt: skip
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
