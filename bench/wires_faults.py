"""Faults of a robot on wires, seen from its drive: how long torque acts, and that it stays off.

    ./cg exec python bench/wires_faults.py [--times 100] [--only NAME ...] [--rate 500] [--write]
    ./cg exec python bench/wires_faults.py --table-only --write

One robot serves many trials: a person brings it back (wires_rig.py), and what cannot be brought
back is started anew. In each trial the robot stands, is pushed, so that there is torque, and a
moment later gets the fault (wires_classes.py); instants and sizes are drawn. `--times` counts the
trials of each kind of fault, shared out among the faults that are of it, and in turn, so that a
campaign that is broken off has some of each. Torque is read from
the emulated drive, on the clock of the host. Where it is to be off, somebody catches the robot
0.3 s later, the fault is undone, dead nodes are started again, and for another second nobody
resets anything: torque that comes back then is counted.

A trial is one line of bench/results/wires_faults.jsonl, with the version of the sources; one that
is there in this version is not run again. A trial in which the host held the emulation up by more
than 10 ms says nothing: its line says so, and it is done again, with other draws.

`--first` gives robot and devices real-time priority, for a host that has other work. Where they
need most of all processors it does harm: Linux lets real-time work have 95 % of a second, and then
stops it. `--rate` is that of the robot's loop. What was run in another way is kept apart.
"""

import argparse
import hashlib
import itertools
import json
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, nullcontext
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from wires_classes import FAULTS, KINDS, SETUPS, Fault
from wires_rig import ROOT, Lost, Rig, rig

from cg_description.model_file import write_atomically

RAW = ROOT / 'bench/results/wires_faults.jsonl'
TABLE = ROOT / 'bench/results/wires_faults.md'
LOG = ROOT / 'build/wires_faults.log'
HELD_UP = 0.01  # s
ATTEMPTS = 8  # for each trial that is to count
AT_MOST = 20.0  # ms
QUIET = 0.02  # s without torque that are no crossing of zero
FALLEN = 0.2  # rad of lean beyond which it does not stand
WATCH = 1.0  # s in which nothing may come back
EARLIER = 0.5  # s before the fault from which torques that stay are looked at
LIMIT = 1000  # per mille of rated torque, at which a good torque may stay as well
SOURCES = 'hardware', 'control', 'estimation', 'interfaces', 'bringup', 'dynamics'


def trial(it: Rig, fault: Fault, random: Random) -> dict[str, Any]:
    """One fault; what is said of it in its line. The robot stands, and is left as it then is."""
    person = it.person
    person.wait(random.uniform(0.2, 0.6))
    it.report()
    it.robot.ask(f'push {random.choice((-1, 1)) * random.uniform(0.25, 0.5):.3f}')
    person.wait(random.uniform(0.02, 0.08))
    before = it.report()
    sizes = fault.draw(random)
    row: dict[str, Any] = {'sizes': sizes, 'counts': False}
    if before['acting'] == 0 and fault.expects in ('zero', 'rule'):
        return row | {'why': 'no torque'}
    at = time.time_ns()
    at = fault.inflict(it, *sizes) or at
    person.wait(fault.lasts)
    if fault.expects == 'zero' or (fault.expects == 'rule' and 'held up' not in fault.name):
        it.robot.ask('hold')
    after = it.report()
    instant = (at - after['epoch_ns']) * 1e-9
    changes = [*before['changes'], *after['changes']]
    zero, back = torque_off(changes, instant, after['time'])
    row |= {
        'zero_ms': round(1e3 * (zero - instant), 2) if zero is not None else None,
        'back': back,
        'longest_without_ms': round(1e3 * longest_zero(changes, instant, after['time']), 1),
        'stands': after['state'] == 'operation enabled' and abs(after['lean']) < FALLEN,
        'acting': after['acting'],
        'lean': round(after['lean'], 4),
        'held_ms': round(1e3 * longest_held(changes, instant - EARLIER, after['time']), 2),
        'late_ms': round(1e3 * after['late'], 2),
        'stage': person.stage,
        **fault.examine(it),
    }
    fault.undo(it)
    if fault.expects in ('zero', 'rule'):
        person.wait(WATCH)
        row['back'] = row['back'] or any(torque for _, torque in it.report()['changes'])
    row['counts'] = after['late'] <= HELD_UP
    return row if row['counts'] else row | {'why': 'held up'}


Changes = list[tuple[float, int]]


def torque_off(changes: Changes, since: float, until: float) -> tuple[float | None, bool]:
    """When the torque went off after an instant, and whether any came back until another one."""
    acting = [torque for at, torque in changes if at <= since]
    rows = [(since, acting[-1] if acting else 1)]
    rows += [(at, torque) for at, torque in changes if since < at <= until]
    ends = [at for at, _ in rows[1:]] + [until + QUIET]
    for (at, torque), end in zip(rows, ends, strict=True):
        if torque == 0 and end - at >= QUIET:
            return at, any(t for later, t in rows if later > at)
    return None, False


def longest_zero(changes: Changes, since: float, until: float) -> float:
    """Longest time without torque between two instants, s."""
    rows = [(max(at, since), torque) for at, torque in changes] + [(until, 1)]
    spans = itertools.pairwise(rows)
    return max((b[0] - a[0] for a, b in spans if a[1] == 0), default=0.0)


def longest_held(changes: Changes, since: float, until: float) -> float:
    """Longest time in s for which one torque acted unchanged between two instants.

    A loop that lives asks for another torque in nearly every cycle. One that stays is old,
    whatever its stamp says.
    """
    spans = itertools.pairwise([*changes, (until, 0)])
    return max(
        (b - max(a, since) for (a, torque), (b, _) in spans if 0 < abs(torque) < LIMIT),
        default=0.0,
    )


def is_right(fault: Fault, row: dict[str, Any]) -> bool:
    """Whether all is as the class has it."""
    off = row['zero_ms'] is not None and row['zero_ms'] <= AT_MOST
    fresh = row['held_ms'] <= AT_MOST
    if fault.expects == 'zero':
        return off and not row['back']
    if fault.expects == 'rule':
        return off
    if 'recovered' in row:
        one = len(row['errors']) == 1 and not row['traceback']
        return row['stands'] and one and row['status'] == 1 and row['recovered'] > 0
    if fault.expects == 'either':
        return fresh and (row['stands'] or row['acting'] == 0)
    return bool(row['stands'])


# A campaign


def campaign(
    faults: list[Fault], times: int, seed: int, done: set[tuple[str, int]], **how: Any
) -> Iterator[dict[str, Any]]:
    """Rows as they come; `how` the robot is run is told to the rig."""
    for setup, prepare in SETUPS.items():
        missing = [
            (fault, k) for k in range(times) for fault in faults
            if fault.setup == setup and k < share(fault, times) and (fault.name, k) not in done
        ]  # fmt: skip
        if missing:
            with prepare() as needs:
                yield from served(missing, seed, how | needs)


def share(fault: Fault, times: int) -> int:
    """How many of the trials of its kind are of this fault."""
    return max(-(-times // len(own)) for own in KINDS.values() if fault.name in own)


def served(
    missing: list[tuple[Fault, int]], seed: int, needs: dict[str, Any]
) -> Iterator[dict[str, Any]]:
    """Trials by one robot, or as many as it takes."""
    with ExitStack() as stack:
        it: Rig | None = None
        for fault, k in missing:
            for attempt in range(ATTEMPTS):
                began = time.monotonic()
                row: dict[str, Any] = {'class': fault.name, 'trial': k, 'attempt': attempt}
                random = Random(f'{seed}:{fault.name}:{k}:{attempt}')
                try:
                    if it is None:
                        devices = random.randrange(1 << 30)
                        it = stack.enter_context(rig(LOG, devices, **needs))
                        row['robots'] = 1
                        began = time.monotonic()
                    with it.devices_first() if fault.crowds else nullcontext():
                        row |= trial(it, fault, random)
                    for name in row.setdefault('died', it.dead()):
                        it.start(name)
                    row['tries'] = 0 if it.stands() else it.bring_back()
                except (Lost, OSError) as error:
                    row |= {'lost': str(error), 'robots': row.get('robots', 0) + 1}
                    row.setdefault('counts', False)
                    stack.close()
                    it = None
                row['took_s'] = round(time.monotonic() - began, 2)
                yield row
                if row['counts']:
                    break


def version_of_sources(first: bool, rate: float) -> str:
    """A hash of all sources that a trial depends on, and how the robot is run."""
    files = [
        *(f for p in SOURCES for f in ROOT.glob(f'src/cg_{p}/cg_{p}/**/*.py')),
        *ROOT.glob('src/cg_sysid/cg_sysid/records/*.py'),
        ROOT / 'src/cg_sysid/cg_sysid/recorder_node.py',
        *ROOT.glob('src/cg_description/models/*.yaml'),
        *(ROOT / f'bench/wires_{name}.py' for name in ('rig', 'classes', 'rivals', 'faults')),
    ]
    digest = hashlib.sha256()
    for file in sorted(files):
        digest.update(str(file.relative_to(ROOT)).encode() + file.read_bytes())
    return f'{digest.hexdigest()[:12]}-{rate:g}Hz{"-first" * first}'


def known_rows(raw: Path, version: str | None, seed: int | None) -> list[dict[str, Any]]:
    """Rows of a version and a seed, by default of the last there."""
    rows = [json.loads(line) for line in raw.read_text().splitlines()] if raw.exists() else []
    if rows and version is None:
        version, seed = rows[-1]['version'], rows[-1]['seed']
    return [row for row in rows if (row['version'], row['seed']) == (version, seed)]


# Tables


def kinds(rows: list[dict[str, Any]]) -> Iterator[str]:
    """One line for each kind of fault."""
    yield from ('', '| kind | faults | trials | as it should be | torque off after, ms: worst |',
                '|---|---:|---:|---:|---:|')  # fmt: skip
    for kind, names in KINDS.items():
        own = [row for row in rows if row['class'] in names and row['counts']]
        if not own:
            continue
        right = sum(is_right(FAULTS[row['class']], row) for row in own)
        off = [r['zero_ms'] for r in own if FAULTS[r['class']].expects in ('zero', 'rule')]
        worst = '' if not off else 'never' if None in off else f'{max(off):.1f}'
        yield f'| {kind} | {len(names)} | {len(own)} | {right} | {worst} |'


def tables(rows: list[dict[str, Any]]) -> Iterator[str]:
    """By what is expected."""
    titles = {
        ('zero', 'rule'): 'The torque goes off, and stays off',
        ('balance',): 'Balance goes on',
        ('either',): 'No torque, or balance; never an old torque',
    }
    for expected, title in titles.items():
        own = {n: f for n, f in FAULTS.items() if f.expects in expected}
        lines = list(lines_of(own, rows, expected))
        if lines:
            heads = HEADS[expected[0]]
            rule = '|'.join(['---', *(['---:'] * (len(heads) - 1))])
            yield from ('', f'## {title}', '', f'| {" | ".join(heads)} |', f'|{rule}|', *lines)


COMMON = ('trials', 'as it should be')
LAST = ('thrown away', 'new robots', '100 trials, min')
HEADS = {
    'zero': ('fault', *COMMON, 'zero after, ms: median', '95 %', 'worst', 'later than 20 ms',
             'came back', *LAST),
    'balance': ('fault', *COMMON, 'fell', 'longest without torque, ms', *LAST),
    'either': ('fault', *COMMON, 'stands', 'torque is zero', 'one torque stays, ms', *LAST),
}  # fmt: skip


def lines_of(
    faults: dict[str, Fault], rows: list[dict[str, Any]], expected: tuple[str, ...]
) -> Iterator[str]:
    """One for each class of which there are trials."""
    for name, fault in faults.items():
        every = [row for row in rows if row['class'] == name]
        own = [row for row in every if row['counts']]
        if not every:
            continue
        cells: list[Any] = [len(own), sum(is_right(fault, row) for row in own)]
        if not own:
            cells += [''] * (len(HEADS[expected[0]]) - len(COMMON) - len(LAST) - 1)
        elif expected[0] == 'zero':
            spent = np.array([np.inf if r['zero_ms'] is None else r['zero_ms'] for r in own])
            back = sum(r['back'] for r in own)
            cells += [
                *(f'{x:.1f}' for x in (np.median(spent), np.quantile(spent, 0.95), spent.max())),
                np.sum(spent > AT_MOST),
                f'{back} by the rule' if fault.expects == 'rule' else back,
            ]  # fmt: skip
        elif expected[0] == 'balance':
            cells += [
                sum(not r['stands'] for r in own),
                f'{max(r["longest_without_ms"] for r in own):.0f}',
            ]
        else:
            longest = max(r['held_ms'] for r in own)
            stands = sum(r['stands'] for r in own)
            cells += [stands, sum(r['acting'] == 0 for r in own), f'{longest:.1f}']
        spent_s = sum(row['took_s'] for row in every)
        cells += [
            len(every) - len(own), sum(row.get('robots', 0) for row in every),
            f'{100 * spent_s / max(1, len(own)) / 60:.0f}',
        ]  # fmt: skip
        yield f'| {name} | {" | ".join(map(str, cells))} |'


def wrong_ones(rows: list[dict[str, Any]]) -> Iterator[str]:
    """What is not as it should be, trial by trial, and what was thrown away, by reason."""
    said = ('zero_ms', 'back', 'stands', 'acting', 'held_ms', 'stage', 'status', 'errors',
            'sizes')  # fmt: skip
    wrong = [row for row in rows if row['counts'] and not is_right(FAULTS[row['class']], row)]
    for row in wrong:
        told = ', '.join(f'{key} {row[key]}' for key in said if row.get(key) not in (None, [], ''))
        yield f'- {row["class"]}, trial {row["trial"]}: {told}'
    if not wrong:
        yield 'None.'


def text_of(rows: list[dict[str, Any]]) -> str:
    """The page."""
    thrown = [row for row in rows if not row['counts']]
    reasons = {why: sum(row.get('why', 'lost') == why for row in thrown)
               for why in ('held up', 'no torque', 'lost')}  # fmt: skip
    version, seed = rows[-1]['version'], rows[-1]['seed']
    first = version.endswith('-first')
    rate = rows[-1].get('rate', 500.0)
    priority = ' Robot and devices had real-time priority on a host with other work.' * first
    times = rows[-1]['times']
    hours = sum(row['took_s'] for row in rows) / 3600
    return '\n'.join([
        '# Faults of a robot on wires', '',
        f'Command: `./cg exec python bench/wires_faults.py --times {times}'
        f' --seed {seed} --rate {rate:g}{" --first" * first}`; this page: the same with '
        f'`--table-only --write`. Sources {version}. The loop of the robot runs at {rate:g} Hz. '
        f'Drive, IMU and body are emulated in another process.{priority}', '',
        f'{len(rows) - len(thrown)} trials in {hours:.1f} h. Thrown away: {reasons["held up"]} in '
        f'which the host held the emulation up by more than {1e3 * HELD_UP:.0f} ms, '
        f'{reasons["no torque"]} without torque at the instant of the fault, {reasons["lost"]} in '
        'which the robot did not get as far.',
        *kinds(rows), *tables(rows), '', '## Not as it should be', '', *wrong_ones(rows), '',
    ])  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--times', type=int, default=100, help='trials of each kind [100]')
    parser.add_argument('--only', nargs='*', default=[], help='classes whose names hold this')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--first', action='store_true', help='with real-time priority')
    parser.add_argument('--rate', type=float, default=500.0, help='of the loop, Hz [500]')
    parser.add_argument('--raw', type=Path, default=RAW)
    parser.add_argument('--table-only', action='store_true', help='of the last version in --raw')
    parser.add_argument('--write', action='store_true', help='store the table')
    options = parser.parse_args()
    version = version_of_sources(options.first, options.rate)
    faults = [
        f for f in FAULTS.values()
        if not options.only or any(words in f.name for words in options.only)
    ]  # fmt: skip
    rows = known_rows(options.raw, None if options.table_only else version, options.seed)
    if not options.table_only:
        done = {(row['class'], row['trial']) for row in rows if row['counts']}
        options.raw.parent.mkdir(parents=True, exist_ok=True)
        how = {'first': options.first, 'rate': options.rate}
        for row in campaign(faults, options.times, options.seed, done, **how):
            row |= {'version': version, 'seed': options.seed, 'times': options.times, **how}
            rows.append(row)
            with options.raw.open('a') as raw:
                raw.write(json.dumps(row) + '\n')
            right = row['counts'] and is_right(FAULTS[row['class']], row)
            print(
                row['class'], row['trial'], row.get('zero_ms'), row.get('back'),
                row.get('lost', ''),
                row.get('why', ''), '' if right or not row['counts'] else 'WRONG', flush=True,
            )  # fmt: skip
    if not rows:
        print('no trials of these sources', file=sys.stderr)
        return 1
    text = text_of(rows)
    print(text)
    if options.write:
        write_atomically(TABLE, text)
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
