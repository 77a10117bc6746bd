"""How often a diagnosis is right about robots of a URDF that share no code with its models.

    ./cg exec python bench/robots.py                           the whole programme
    ./cg exec python bench/robots.py --robot arm2              one robot
    ./cg exec python bench/robots.py 'arm2:*friction' '*:sound*' those that fit, in this order
    ./cg exec python bench/robots.py --sample 20               a share of all, drawn once
    ./cg exec python bench/robots.py --case arm2:payload       one of them, in words
    ./cg exec python bench/robots.py --table-only --write bench/results/robots.md

The robots are MuJoCo's, their laws are in robots_machines.py. What a case does is what somebody
does who has a robot: the model file is what `cg new-robot` makes of a URDF and of bags with
positions and efforts on /joint_states; then the bags are checked, cut where they have to be, and
diagnosed. In that URDF masses, centres and inertias are 5 to 12 % off, friction is 15 % off. A
third of the machines has small faults: a delay of 1 ms, encoders 0.3 mrad off, dry friction that
turns twice as fast.

    single     one effect, at one joint, link, sensor, or of all
    sound      nothing; some with small faults, some with the hard dry friction of MuJoCo

What is right was settled before any was run. single: the first cause is that effect at that place,
or another that robots_machines.right says is the same in these recordings. sound: no cause. A
recording that the check refuses, and a case without an answer within --limit, count as wrong.

Every case is one line of --raw, with the version of the sources that made it; a case that is
there in this version is not run again. By default a case has all cores, as a user's diagnosis has,
and its time is that of a clock; with `--cores 1` it is CPU time.
"""

import argparse
import hashlib
import json
import multiprocessing
import os
import re
import sys
import tempfile
import time
import traceback
from dataclasses import dataclass, replace
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from case_rows import known_rows, with_missing
from outside import cpu_seconds, version_of_sources, wilson
from robots_machines import EFFECTS, ROBOTS, Robot, Secret, record, right, sites, with_small_faults
from rosbags.typesys import Stores, get_typestore

from cg_description.robot_description import Inertial, parse, with_inertials
from cg_dynamics.effects import LIBRARY
from cg_dynamics.mechanisms.urdf import Urdf
from cg_dynamics.model import Model
from cg_interfaces import channels
from cg_interfaces.stamps import NS_PER_S
from cg_sysid import parallel
from cg_sysid.checks.loading import load_bags
from cg_sysid.cli.new_robot import template
from cg_sysid.deadline import Deadline
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.records.bag_file import BagWriter
from cg_sysid.records.bags import read_bag
from cg_sysid.records.record import Record

SOUND = 4  # machines of each robot with nothing hidden
PAUSE = 2.0  # s between two recordings
START = 1_750_000_000 * NS_PER_S
OFF = 0.05, 0.12  # share by which a mass, a centre, an inertia is off
FRICTION_OFF = 0.15
LIMIT = 900.0  # s of one diagnosis
ROOT = Path(__file__).parents[1]
STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = 'sensor_msgs/msg/JointState'


@dataclass(frozen=True)
class Case:
    """One machine.

    Attributes:
        robot: Name of the robot.
        effect: What is hidden; `sound` for nothing.
        number: Among those of the same robot and effect.
        site: Where, of `robots_machines.sites`.
        faults: Whether it has small faults.
        hard: Whether all its dry friction is hard.
    """

    robot: str
    effect: str
    number: int
    site: str
    faults: bool
    hard: bool = False

    @property
    def name(self) -> str:
        """As --case takes it."""
        return f'{self.robot}:{self.effect}' + (f':{self.number}' if self.number else '')

    @property
    def seed(self) -> int:
        """Of everything that is random in it."""
        return int(hashlib.sha256(self.name.encode()).hexdigest()[:7], 16)


def programme() -> list[Case]:
    """All cases: every effect once for each robot, where it can be seen there."""
    cases = []
    for name, robot in ROBOTS.items():
        rng = np.random.default_rng([2026, list(ROBOTS).index(name)])
        for k, effect in enumerate(EFFECTS):
            places = sites(robot, effect)
            if places:
                cases.append(Case(name, effect, 0, str(rng.choice(places)), k % 3 == 2))
        cases += [Case(name, 'sound', k, '', k % 2 == 1, k % 4 == 2) for k in range(SOUND)]
    return cases


def sampled(cases: list[Case], count: int) -> list[Case]:
    """So many cases, drawn once: a smaller sample is part of a larger."""
    return [cases[i] for i in np.random.default_rng(3).permutation(len(cases))[:count]]


def machine(case: Case) -> tuple[Secret, dict[str, float]]:
    """What is wrong with it."""
    robot, random = ROBOTS[case.robot], np.random.default_rng(case.seed)
    secret, values = Secret(), {}
    if case.effect != 'sound':
        secret, values = EFFECTS[case.effect](robot, case.site, random)
    if case.hard:
        secret = replace(secret, turns=0.0)
    if case.faults:
        secret = with_small_faults(robot, secret, random)
    return secret, {name: float(value) for name, value in values.items()}


def known_urdf(case: Case) -> str:
    """The URDF as its owner has it: numbers are off, and a hidden friction is not stated."""
    random = np.random.default_rng([case.seed, 7])
    text = ROBOTS[case.robot].urdf

    def factor(low: float = OFF[0], high: float = OFF[1]) -> float:
        return float(1 + random.choice([-1, 1]) * random.uniform(low, high))

    off = {}
    for link, own in parse(text).inertials.items():
        centre = tuple(x * factor() for x in own.centre)
        heavier = factor()
        wider = heavier * factor()
        off[link] = Inertial(own.mass * heavier, centre, tuple(i * wider for i in own.inertia))
    text = with_inertials(text, off)

    def friction(found: re.Match) -> str:
        joint, between, damping, dry = found.groups()
        values = [float(x) * factor(FRICTION_OFF, FRICTION_OFF) for x in (damping, dry)]
        hidden = {'viscous_friction': 0, 'coulomb_friction': 1}.get(case.effect)
        if hidden is not None and joint == case.site:
            values[hidden] = 0.0
        return f'<joint name="{joint}"{between}damping="{values[0]}" friction="{values[1]}"'

    pattern = r'<joint name="(\w+)"((?:(?!</joint>).)*?)damping="([^"]*)" friction="([^"]*)"'
    return re.sub(pattern, friction, text, flags=re.DOTALL)


def write_bag(path: Path, robot: Robot, recording, first: int) -> None:
    """A bag as `ros2 bag record /joint_states` leaves it.

    A joint without a drive has no effort: NaN, as joint_state_broadcaster says it.
    """
    types = STORE.types
    driven = [joint in robot.driven for joint in robot.joints]
    effort = np.where(driven, recording.effort, np.nan)
    none = np.array([])
    with BagWriter(path) as bag:
        topic = bag.add_connection('/joint_states', JOINT_STATE, typestore=STORE)
        for t, q, tau in zip(recording.time, recording.position, effort, strict=True):
            stamp = first + round(t * NS_PER_S)
            at = types['builtin_interfaces/msg/Time'](*divmod(stamp, NS_PER_S))
            header = types['std_msgs/msg/Header'](stamp=at, frame_id='')
            state = types[JOINT_STATE](header, list(robot.joints), q, none, tau)
            bag.write(topic, stamp, STORE.serialize_cdr(state, JOINT_STATE))


def in_memory(body: Urdf, robot: Robot, recording, first: int, name: str) -> Record:
    """The same recording as a record."""
    return Record(
        name=name,
        stamp_ns=first + (recording.time * NS_PER_S).round().astype(np.int64),
        inputs={f'{j}_effort': recording.effort[:, robot.place(j)] for j in robot.driven},
        outputs={f'{j}_position': recording.position[:, k] for k, j in enumerate(robot.joints)},
        mechanism=channels.interface(body),
    )


def same_either_way(a: Record, b: Record) -> bool:
    """Whether two records hold the same."""
    pairs = [(a.inputs, b.inputs), (a.outputs, b.outputs)]
    return np.array_equal(a.stamp_ns, b.stamp_ns) and all(
        x.keys() == y.keys() and all(np.array_equal(x[n], y[n]) for n in x) for x, y in pairs
    )


def made(case: Case, folder: Path) -> tuple[Path, list[Path], dict[str, float]]:
    """Model file and bags of a case, and what is hidden.

    Raises:
        RuntimeError: A bag does not hold what was recorded.
    """
    secret, values = machine(case)
    return *written(ROBOTS[case.robot], secret, known_urdf(case), case.seed, folder), values


def written(
    robot: Robot, secret: Secret, text: str, seed: int, folder: Path
) -> tuple[Path, list[Path]]:
    """Model file of a URDF, and bags of a robot with a secret.

    Raises:
        RuntimeError: A bag does not hold what was recorded.
    """
    body = Urdf(parse(text), robot.driven)
    bags, records = [], []
    for k in range(robot.records):
        recording = record(robot, secret, 100 * seed + k, k)
        first = START + round(k * (robot.seconds + PAUSE) * NS_PER_S)
        bags.append(folder / f'moves_{k}')
        write_bag(bags[-1], robot, recording, first)
        records.append(read_bag(bags[-1], mechanism=channels.interface(body)))
        if not same_either_way(records[-1], in_memory(body, robot, recording, first, 'memory')):
            raise RuntimeError(f'{bags[-1]} does not hold what was recorded')
    model = folder / 'model.yaml'
    model.write_text(template(parse(text), robot.driven, records, f'{robot.name}.urdf'))
    return model, bags


def labels(case: Case) -> list[str]:
    """Labels of causes that are right."""
    robot = ROBOTS[case.robot]
    body = Urdf(parse(robot.urdf), robot.driven)
    every = right(robot, case.effect, case.site) if case.effect != 'sound' else ()
    found = []
    for name, site in every:
        kind = LIBRARY[name]
        found.append(kind(body, site).label if site in kind.sites(body) else f'{name}@{site}')
    return found


def run(case: Case, version: str, limit: float, cores: int) -> dict[str, Any]:
    """One line of the raw results."""
    robot = ROBOTS[case.robot]
    about = {
        'case': case.name, 'robot': case.robot, 'effect': case.effect, 'site': case.site,
        'faults': case.faults, 'hard': case.hard, 'joints': len(robot.joints),
        'right': labels(case), 'version': version, 'causes': [], 'rivals': [], 'places': [],
        'cores': cores,
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        model, bags, about['values'] = made(case, Path(folder))
        cpu, wall = cpu_seconds(), time.monotonic()
        try:
            about |= answer(model, bags, limit, cores)
        except Exception:  # what a diagnosis dies of is a wrong answer, not the bench's end
            about |= {'verdict': 'failed', 'why': traceback.format_exc(limit=-4)}
    wall = time.monotonic() - wall
    parallel.stop()
    for worker in multiprocessing.active_children():
        worker.join()  # what it spent counts from then on
    return about | {'cpu_s': round(cpu_seconds() - cpu, 1), 'wall_s': round(wall, 1)}


def answer(model: Path, bags: list[Path], limit: float, cores: int) -> dict[str, Any]:
    """What `cg diagnose` would say."""
    loaded = load_bags(bags, model)
    warned = sorted({f.code for s in loaded.sources for f in s.check.findings
                     if f.severity == 'warning'})  # fmt: skip
    told = {'warnings': warned, 'windows': len(loaded.records)}
    if loaded.left_out:
        return told | {
            'verdict': 'unusable',
            'why': '; '.join(f'{s.name}: {s.reason}' for s in loaded.left_out),
        }  # fmt: skip
    found = diagnose(
        Model.load(model), loaded.records, Options(workers=cores), landings=loaded.landings,
        deadline=Deadline(limit, cpu_seconds if cores == 1 else time.monotonic),
    )  # fmt: skip
    return told | {
        'verdict': str(found.verdict),
        'causes': [c.label for c in found.causes],
        'rivals': [list(c.rivals) for c in found.causes],
        'places': [list(c.places) for c in found.causes],
        'parameters': {
            c.label: {n: v[:2] for n, v in c.parameters.items()} for c in found.causes
        },
        'before': found.baseline.held.normalised_error,
        'after': found.extended.held.normalised_error,
        'rounds': [
            {'base': r.base, 'accepted': r.accepted,
             'first': [[c.label, round(c.evidence, 1), round(c.held.normalised_error, 3), c.reason]
                       for c in r.candidates[:6]]}
            for r in found.rounds
        ],
        'findings': list(found.findings),
        'summary': found.summary,
    }  # fmt: skip


def is_right(row: dict[str, Any]) -> bool:
    """As the head of this file says."""
    if row['verdict'] in ('failed', 'unfinished', 'unusable'):
        return False
    if row['effect'] == 'sound':
        return not row['causes']
    return bool(row['causes']) and row['causes'][0] in row['right']


def is_among(row: dict[str, Any]) -> bool:
    """Whether what was hidden is among causes, their rivals and their other places."""
    named = {*row['causes'], *(x for key in ('rivals', 'places') for xs in row[key] for x in xs)}
    return bool(named & set(row['right']))


def table_of(rows: list[dict[str, Any]]) -> list[str]:
    """By robot."""
    cores = rows[0].get('cores', 1)
    took, unit = ('cpu_s', 'CPU s') if cores == 1 else ('wall_s', f's on {cores} cores')
    lines = [
        '| robot | joints | hidden | cases | right | 95 % interval | truth among rivals too '
        f'| {unit}: median | 95 % | longest |',
        '|---|---:|---|---:|---:|---:|---:|---:|---:|---:|',
    ]
    groups = [(title, kind) for title in (*ROBOTS, 'all') for kind in ('one effect', 'nothing')]
    for title, kind in groups:
        own = [row for row in rows if title in (row['robot'], 'all')
               and (row['effect'] == 'sound') == (kind == 'nothing')]  # fmt: skip
        if not own:
            continue
        correct = sum(map(is_right, own))
        low, high = wilson(correct, len(own))
        spent = [row[took] for row in own]
        among = f'{sum(map(is_among, own))}' if kind != 'nothing' else ''
        joints = f'{own[0]["joints"]}' if title != 'all' else ''
        lines.append(
            f'| {title} | {joints} | {kind} | {len(own)} | {correct} | {low:.0%} to {high:.0%} '
            f'| {among} | {np.median(spent):.0f} | {np.quantile(spent, 0.95):.0f} '
            f'| {max(spent):.0f} |'
        )
    return lines


def every_one(rows: list[dict[str, Any]]) -> list[str]:
    """A line for each case."""
    lines = [
        '| case | where | small faults | verdict | causes (rivals) | right | chi2/N before, after '
        '| CPU s | wall s |',
        '|---|---|---|---|---|---|---:|---:|---:|',
    ]
    for row in rows:
        causes = '; '.join(
            f'{cause} ({", ".join([*rivals, *places])})' if rivals or places else cause
            for cause, rivals, places in zip(
                row['causes'], row['rivals'], row['places'], strict=True)
        )  # fmt: skip
        errors = f'{row["before"]:.4g}, {row["after"]:.4g}' if 'before' in row else ''
        why = row.get('why', '').strip().splitlines()
        where = 'hard friction' if row['hard'] else row['site']
        lines.append(
            f'| {row["case"]} | {where} | {"yes" if row["faults"] else ""} '
            f'| {row["verdict"]} | {causes or (why[-1][:90] if why else "")} '
            f'| {"yes" if is_right(row) else "**no**"} | {errors} | {row["cpu_s"]:.0f} '
            f'| {row["wall_s"]:.0f} |'
        )
    return lines


def version() -> str:
    """A hash of all sources that an answer depends on."""
    own = [*Path(__file__).parent.glob('robots_urdf/*.urdf'), Path(__file__).with_name(
        'robots_machines.py')]  # fmt: skip
    digest = hashlib.sha256(version_of_sources().encode())
    for file in sorted(own):
        digest.update(file.read_bytes())
    return digest.hexdigest()[:12]


def told(row: dict[str, Any]) -> str:
    """A row for the screen."""
    words = row['case'], row['site'], '->', row['verdict'], *row['causes']
    return ' '.join([*words, '' if is_right(row) else 'WRONG', f'{row["wall_s"]} s'])


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('patterns', nargs='*', help="names of cases, such as '*:payload'")
    parser.add_argument('--case', help='ROBOT:EFFECT, run and told in words')
    parser.add_argument('--robot', choices=list(ROBOTS), help='only this one')
    parser.add_argument('--sample', type=int, help='so many of all cases')
    parser.add_argument(
        '--cores', type=int, default=os.cpu_count() or 1,
        help='of a case, as many cases side by side as there are cores for [all]',
    )  # fmt: skip
    parser.add_argument(
        '--limit', type=float, default=LIMIT,
        help=f's a case; CPU time where it has one core [{LIMIT:g}]',
    )  # fmt: skip
    parser.add_argument('--raw', type=Path, default=ROOT / 'bench/results/robots.jsonl')
    parser.add_argument('--write', type=Path)
    parser.add_argument('--table-only', action='store_true', help='of the last version in --raw')
    options = parser.parse_args()
    of, cases = f'{version()}-{options.cores}', programme()
    if options.case:
        wanted = [case for case in cases if case.name == options.case]
        if not wanted:
            there = ', '.join(case.name for case in cases)
            print(f'no case {options.case}; there are {there}', file=sys.stderr)
            return 2
        row = run(wanted[0], of, options.limit, options.cores)
        print(json.dumps(row, indent=1), 'right' if is_right(row) else 'wrong', sep='\n')
        return 0
    if options.patterns:
        cases = list(dict.fromkeys(
            case for pattern in options.patterns for case in cases if fnmatch(case.name, pattern)
        ))  # fmt: skip
    if options.robot:
        cases = [case for case in cases if case.robot == options.robot]
    chosen = sampled(cases, options.sample) if options.sample else cases
    rows = known_rows(options.raw, None if options.table_only else of)
    if not options.table_only:
        rows = with_missing(
            rows, chosen, partial(run, cores=options.cores), of, options.raw,
            max(1, (os.cpu_count() or 1) // options.cores), options.limit, told,
        )  # fmt: skip
    shown = [rows[case.name] for case in chosen if case.name in rows]
    if not shown:
        print('no rows of these sources', file=sys.stderr)
        return 1
    lines = [*table_of(shown), '', *every_one(shown)]
    print('\n'.join(lines))
    if options.write:
        every = len(programme())
        drawn = f', {len(shown)} of them run' if len(shown) < every else ''
        options.write.write_text('\n'.join([
            '# Robots of a URDF that share no code with the models', '',
            'Command: `./cg exec python bench/robots.py --cores '
            f'{shown[0].get("cores", 1)}`; this table of its rows: the same with '
            f'`--table-only --write FILE`. Sources {shown[0]["version"]}.',
            f'The programme: {every} cases{drawn}. What is right is written at the head of '
            'the bench, and was settled before any case was run.', '', *lines, '',
        ]))  # fmt: skip
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
