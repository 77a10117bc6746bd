"""Damaged journals and bags by the hundred thousand: what recover keeps, what readers say.

    ./cg exec python bench/mutated_bags.py [--mutants 100000] [--write]

Every mutant is looked through and all that is intact is taken out of it, as `recover` does; one
in fifty goes the whole way to a bag on disk, which the mcap library then reads. One in five of
the mutants of bags with metadata.yaml also goes to `read_bag`. The files and damages are those
of the fuzz test (src/cg_sysid/test/mutated_files.py). `--write` stores the table as
bench/results/mutated_bags.md.
"""

import argparse
import random
import resource
import sys
import tempfile
import time
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path

from cg_description.model_file import write_atomically
from cg_sysid.errors import RecordingError
from cg_sysid.records.bags import read_bag
from cg_sysid.records.recover import RecoveryError, contents_of, entries, recover

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / 'src/cg_sysid/test'))
from mutated_files import (  # noqa: E402
    DAMAGES,
    FILES,
    content_of,
    intact,
    make_original,
    place,
)

RESULT = ROOT / 'bench/results/mutated_bags.md'
SAMPLES = 10
WHOLE_WAY, READ_TOO = 50, 5  # one in so many
WITH_METADATA = ('own bag', 'bag by rosbags')
READ = 'read_bag'


@dataclass
class Row:
    """What became of the mutants of one kind of file and damage."""

    mutants: int = 0
    crashes: dict[str, int] = field(default_factory=lambda: defaultdict(int))
    there: int = 0
    kept: int = 0
    false: int = 0
    whole: int = 0
    nothing: int = 0
    read: int = 0
    refused: int = 0
    worst: float = 0.0


def peak() -> float:
    """Largest resident memory of this process in MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def take_out(bag: Path) -> set:
    contents = contents_of(sorted(bag.glob('*.mcap')))
    return {(entry.topic, entry.log_ns, entry.data) for entry in entries(contents)}


def whole_way(bag: Path) -> set:
    try:
        recover(bag)
    except RecoveryError:
        return set()
    return set(content_of(bag))


def judge(row: Row, original, changed: bytes, folder: Path, whole: bool) -> None:
    row.mutants += 1
    bag = place(folder, original, changed)
    wanted = intact(original, changed)
    row.there += len(wanted)
    tasks = [('taking out', take_out), *([('recover', whole_way)] if whole else [])]
    first: set = set()
    for name, task in tasks:
        began = time.process_time()
        try:
            found = task(bag)
        except Exception as error:
            row.crashes[f'{name}: {type(error).__name__} {error}'[:200]] += 1
            continue
        finally:
            row.worst = max(row.worst, time.process_time() - began)
        if name == 'recover':
            row.whole += 1
            if found != first:
                row.crashes['recover gives other messages than taking out'] += 1
        else:
            first = found
            row.kept += len(wanted & found)
            row.false += len(found - original.messages)
            row.nothing += not found


def judge_reader(row: Row, bag: Path) -> None:
    row.read += 1
    began = time.process_time()
    try:
        read_bag(bag)
    except RecordingError as error:
        row.refused += 1
        if '\n' in str(error) or str(bag) not in str(error):
            row.crashes[f'{READ}: no clear error: {error}'[:200]] += 1
    except Exception as error:
        row.crashes[f'{READ}: {type(error).__name__} {error}'[:200]] += 1
    row.worst = max(row.worst, time.process_time() - began)


def campaign(count: int, folder: Path) -> dict[tuple[str, str], Row]:
    rows = {}
    each = max(1, round(count / len(FILES) / len(DAMAGES)))
    for kind in FILES:
        original = make_original(kind, folder, SAMPLES)
        bag = folder / kind.replace(' ', '_')
        for damage, change in DAMAGES.items():
            row = rows[kind, damage] = Row()
            rng = random.Random(f'{kind} {damage}')
            for k in range(each):
                changed = change(original.data, rng)
                judge(row, original, changed, folder / 'mutant', k % WHOLE_WAY == 0)
                if kind in WITH_METADATA and k % READ_TOO == 0:
                    (bag / f'{bag.name}.mcap').write_bytes(changed)
                    judge_reader(row, bag)
            print(kind, damage, row, f'{peak():.0f} MB', flush=True)
    return rows


def table(rows: dict[tuple[str, str], Row], mutants: int, before: float) -> str:
    total = sum(row.mutants for row in rows.values())
    crashes = sum(sum(row.crashes.values()) for row in rows.values())
    lines = [
        '# Damaged journals and bags', '',
        f'Command: `./cg exec python bench/mutated_bags.py --mutants {mutants} --write`. {total} '
        f'files of {2 * SAMPLES + 1} messages, damaged with fixed seeds. *Intact*: messages whose '
        'bytes, with those of the CRC that vouches for them, are all there after the damage; '
        '*kept*: of those, taken out. *False*: messages taken out that were never in the file; '
        'where there is no CRC nothing can tell. *Refused*: by `read_bag`, with one line. '
        f'*Worst*: CPU time of one file. **{crashes} tracebacks**; memory grew from {before:.0f} '
        f'to {peak():.0f} MB at most.', '',
        '| file | damage | mutants | tracebacks | intact | kept | false | with nothing left '
        '| refused | worst, ms |',
        '|---|---|---:|---:|---:|---:|---:|---:|---:|---:|',
    ]  # fmt: skip
    for (kind, damage), row in rows.items():
        kept = f'{100 * row.kept / row.there:.2f} %' if row.there else ''
        refused = f'{row.refused} of {row.read}' if kind in WITH_METADATA else ''
        lines.append(
            f'| {kind} | {damage} | {row.mutants} | {sum(row.crashes.values())} | {row.there} '
            f'| {kept} | {row.false} | {row.nothing} | {refused} | {1e3 * row.worst:.0f} |'
        )
    for (kind, damage), row in rows.items():
        for what, count in row.crashes.items():
            lines.append(f'\n{kind}, {damage}: {count} x {what}')
    return '\n'.join(lines) + '\n'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--mutants', type=int, default=100_000)
    parser.add_argument('--write', action='store_true')
    options = parser.parse_args()
    before = peak()
    with tempfile.TemporaryDirectory() as folder:
        rows = campaign(options.mutants, Path(folder))
    text = table(rows, options.mutants, before)
    print(text)
    if options.write:
        write_atomically(RESULT, text)


if __name__ == '__main__':
    main()
