"""Twelve recordings, and whether two versions of this software say the same about them.

    ./cg exec python bench/same_answers.py record FOLDER [--data DATA_DIR]
    ./cg exec python bench/same_answers.py answer FOLDER NAME [--checkout DIR]
    ./cg exec python bench/same_answers.py compare FOLDER BEFORE AFTER [--write FILE]

`record` makes them: six effects, two sound robots (one with small faults), a law that no library
has, two effects at once, a walk, and with --data a real pendulum. `answer` diagnoses each with the
command `cg diagnose` of a checkout, without a limit of time and on one core, and keeps
diagnosis.json and the CPU time under NAME. `compare` tells every field that differs; what names
the run itself (times, versions, paths) is left out, and fields that were renamed are compared
under the new name.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / 'src' / p / 'test') for p in ('cg_dynamics', 'cg_sysid')]
SIX = ('payload', 'stribeck_friction', 'actuator_delay', 'torque_constant', 'gyro_bias',
       'joint_flexibility')  # fmt: skip
EFFECTS = {
    **{name: ((name,), False) for name in SIX},
    'healthy': ((), False),
    'small_faults': ((), True),
    'pair': (('torque_bias', 'encoder_scale'), False),
}
SECONDS = 6.0
LONG, FEW = ('unlisted', 'walk'), 'torque_constant,payload,torque_bias,foot_slip'  # minutes else
RENAMED: dict[str, str] = {}  # field of an older diagnosis.json -> today's name
OF_THE_RUN = {'provenance', 'seconds', 'evaluations', 'made', 'created', 'elapsed', 'version'}


def record(folder: Path, data: Path | None) -> None:
    """Make the recordings; simulated ones need the packages on the path."""
    from hidden_effects import PROGRAMME, SPRING_ERROR, hide, records_of, with_small_faults
    from unlisted import StiffeningSpring
    from unlisted import hide as hide_unlisted
    from unlisted import records as records_of_unlisted
    from walking import walking
    from walking_records import as_record

    from cg_description.paths import NOMINAL_MODEL, model_path
    from cg_dynamics.model import Model

    nominal = Model.load(model_path(NOMINAL_MODEL))
    sets = {}
    for seed, (name, (effects, faults)) in enumerate(EFFECTS.items(), 501):
        _, machine, _ = hide(nominal, effects, 1.0, seed)
        machine = with_small_faults(machine) if faults else machine
        sets[name] = records_of(machine, seed, SPRING_ERROR * faults, PROGRAMME, SECONDS)
    sets['unlisted'] = records_of_unlisted(hide_unlisted(nominal, StiffeningSpring))
    slippery = nominal.with_effect('foot_slip', None, friction=0.35)
    sets['walk'] = [
        as_record(f'walk_{seed}', done, done.arcs[0].stance, seed)
        for seed in (1, 2)
        for done in [walking(slippery, seed)]
    ]
    for name, records in sets.items():
        _write(folder / name, records)
    if data is not None:
        _import(folder / 'real', data)


def _write(folder: Path, records) -> None:
    from cg_sysid.records.bag_writer import write_bag

    for r in records:
        write_bag(folder / r.name, r)


def _import(folder: Path, data: Path) -> None:
    command = [str(ROOT / 'cg'), 'import', 'sydney_pendulum', str(data / 'sydney_compass_gait'),
               '--out', str(folder)]  # fmt: skip
    subprocess.run(command, check=True)


def answer(folder: Path, name: str, checkout: Path) -> None:
    """Diagnose every recording with the packages of a checkout."""
    env = os.environ | {'CG_DEV': '1', 'PYTHONPATH': ''}
    for place in sorted(p for p in folder.iterdir() if p.is_dir()):
        out = folder.parent / name / place.name
        if (out / 'time.json').exists():
            continue
        bags = sorted(str(p) for p in place.iterdir() if p.is_dir())
        model = 'sydney_pendulum' if place.name == 'real' else 'compass_gait_mit'
        command = [str(checkout / 'cg'), 'diagnose', '--model', model, '--out', str(out),
                   '--workers', '1', '--budget', 'inf', '--quiet',
                   *(['--effects', FEW] if place.name in LONG else []), *bags]  # fmt: skip
        wall, used = time.monotonic(), _cpu()
        done = subprocess.run(command, env=env, capture_output=True, text=True, check=False)
        took = {'wall': time.monotonic() - wall, 'cpu': _cpu() - used, 'exit': done.returncode}
        out.mkdir(parents=True, exist_ok=True)
        (out / 'time.json').write_text(json.dumps(took))
        print(place.name, took, done.stderr.strip()[-300:], flush=True)


def _cpu() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def differences(before, after, path: str = ''):
    """Every leaf that differs: (where, before, after)."""
    if isinstance(before, dict) and isinstance(after, dict):
        before = {RENAMED.get(k, k): v for k, v in before.items()}
        for key in sorted({*before, *after} - OF_THE_RUN):
            yield from differences(before.get(key), after.get(key), f'{path}.{key}')
    elif isinstance(before, list) and isinstance(after, list) and len(before) == len(after):
        for i, (a, b) in enumerate(zip(before, after, strict=True)):
            yield from differences(a, b, f'{path}[{i}]')
    elif before != after and not (before != before and after != after):
        yield path, before, after


def compare(folder: Path, first: str, second: str, write: Path | None) -> int:
    """A line for each recording; 1 if any answer differs."""
    lines, wrong = [], 0
    for place in sorted(p for p in folder.iterdir() if p.is_dir()):
        a, b = (folder.parent / name / place.name for name in (first, second))
        one, other = (json.loads((d / 'diagnosis.json').read_text()) for d in (a, b))
        times = [json.loads((d / 'time.json').read_text())['cpu'] for d in (a, b)]
        found = list(differences(one, other))
        wrong += bool(found)
        said = 'the same' if not found else f'{len(found)} fields differ, as {found[0]}'
        causes = ', '.join(c['label'] for c in other['causes'])
        lines.append(f'| {place.name} | {other["verdict"]} | {causes} | {said} '
                     f'| {times[0]:.1f} | {times[1] / times[0]:.2f} |')  # fmt: skip
        print(lines[-1], flush=True)
        for where, was, is_ in found[1:12]:
            print('   ', where, str(was)[:60], str(is_)[:60])
    if write:
        write.write_text('\n'.join([
            '# The same answers', '',
            'Twelve recordings diagnosed by two versions (bench/same_answers.py).', '',
            '| recording | verdict | causes | diagnosis.json | CPU s before | ratio |',
            '|---|---|---|---|---:|---:|', *lines, '',
        ]))  # fmt: skip
    return int(bool(wrong))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('what', choices=('record', 'answer', 'compare'))
    parser.add_argument('folder', type=Path)
    parser.add_argument('names', nargs='*')
    parser.add_argument('--data', type=Path)
    parser.add_argument('--checkout', type=Path, default=ROOT)
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    if options.what == 'record':
        record(options.folder, options.data)
    elif options.what == 'answer':
        answer(options.folder, options.names[0], options.checkout.resolve())
    else:
        return compare(options.folder, *options.names[:2], options.write)
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
