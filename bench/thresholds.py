"""Which thresholds of the search decide answers: each moved by +-30 %, one at a time.

    ./cg exec python bench/thresholds.py [--stages NOISE,SELECTION] [--cases 6] [--write FILE]

The recordings are those of hidden_effects.py, one machine a case: an effect, two, one among small
faults, nothing, nothing but small faults. For each threshold of search/settings.py both values are
tried, and the cases are told whose verdict or causes (rivals included) change. A threshold that
changes none in many cases is there for speed, or goes. Integers move by at least one. Each process
takes one value; --workers of them run side by side.
"""

import argparse
import dataclasses
import os
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from hidden_effects import PROGRAMME, SPRING_ERROR, hide, records_of, with_small_faults

from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_sysid import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.search import settings

CASES = (
    (('stribeck_friction',), False),
    ((), True),
    (('payload',), True),
    (('torque_bias', 'encoder_scale'), False),
    ((), False),
    (('actuator_delay',), False),
)
SECONDS = 4.0
FACTORS = (0.7, 1.3)
STAGES = ('SCREENING', 'NOISE', 'PRIOR', 'HALVING', 'SELECTION', 'DOUBT')


def moved(stage: str, field: str, factor: float):
    """The stage's thresholds with one of them moved."""
    now = getattr(settings, stage)
    value = getattr(now, field)
    if isinstance(value, tuple):
        new = tuple(type(v)(_times(v, factor)) for v in value)
    else:
        new = _times(value, factor)
    return dataclasses.replace(now, **{field: new})


def _times(value, factor):
    if isinstance(value, int):
        return max(1, min(value - 1, round(value * factor)) if factor < 1
                   else max(value + 1, round(value * factor)))  # fmt: skip
    return value * factor


def answers(stage: str | None, field: str, factor: float, count: int) -> tuple[list, float]:
    """Verdict and causes of every case with one threshold moved, and the CPU time."""
    if stage:
        setattr(settings, stage, moved(stage, field, factor))
    found, began = [], time.process_time()
    for seed, (effects, faults) in enumerate(CASES[:count], 701):
        nominal, machine, _ = hide(Model.load(model_path(NOMINAL_MODEL)), effects, 1.0, seed)
        machine = with_small_faults(machine) if faults else machine
        records = records_of(machine, seed, SPRING_ERROR * faults, PROGRAMME[:4], SECONDS)
        answer = diagnose(nominal, records, Options(workers=1))
        found.append((str(answer.verdict), sorted((c.label, *c.rivals) for c in answer.causes)))
    return found, time.process_time() - began


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--stages', default=','.join(STAGES), help='comma-separated')
    parser.add_argument('--cases', type=int, default=len(CASES))
    parser.add_argument('--workers', type=int, default=os.cpu_count())
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    wanted = [
        (stage, field.name, factor)
        for stage in options.stages.split(',')
        for field in dataclasses.fields(getattr(settings, stage))
        for factor in FACTORS
    ]
    lines = []
    with ProcessPoolExecutor(options.workers, max_tasks_per_child=1) as pool:
        usual, took = pool.submit(answers, None, '', 1.0, options.cases).result()
        futures = {w: pool.submit(answers, *w, options.cases) for w in wanted}
        for (stage, field, factor), future in futures.items():
            found, cpu = future.result()
            changed = [
                f'{" + ".join(effects) or "nothing"}{", small faults" * faults}: {new[0]} '
                f'{"; ".join(" or ".join(c) for c in new[1])}'
                for (effects, faults), old, new in zip(CASES, usual, found, strict=False)
                if old != new
            ]
            told = '<br>'.join(changed) or 'none'
            lines.append(f'| {stage.lower()}.{field} | {factor:g} | {told} | {cpu / took:.2f} |')
            print(lines[-1], flush=True)
    if options.write:
        options.write.write_text('\n'.join([
            '# What thresholds decide', '',
            'Command: `./cg exec python bench/thresholds.py`. Each threshold times 0.7 and 1.3, '
            f'one at a time, on {options.cases} machines; usual answers: '
            + ', '.join(f'{v} {"; ".join(" or ".join(c) for c in cs)}' for v, cs in usual)
            + '.', '',
            '| threshold | times | answers that change | CPU time, ratio |',
            '|---|---:|---|---:|', *lines, '',
        ]))  # fmt: skip


if __name__ == '__main__':
    main()
