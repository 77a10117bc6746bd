"""How long a diagnosis takes: the whole library on six records of 20 s at 500 Hz.

    ./cg exec python bench/diagnosis_speed.py [--effects a,b,c] [--first 801] [--write FILE]

Machines and effects are those of hidden_effects.py; the records are longer, and so is the sweep
of the excitation: the first seconds say less about what is fast.
"""

import argparse
import os
import platform
import time
from pathlib import Path

from hidden_effects import PROGRAMME, hide, records_of

from cg_bringup.runs import NOMINAL_MODEL
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_sysid.diagnose import diagnose

SECONDS = 20.0
SIX = PROGRAMME[:6]
EFFECTS = (
    'none', 'joint_flexibility', 'backlash', 'payload', 'stribeck_friction', 'quadratic_friction',
    'actuator_delay', 'external_push', 'foot_radius', 'gyro_bias',
)  # fmt: skip


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--effects', default=','.join(EFFECTS), help='comma-separated')
    parser.add_argument('--first', type=int, default=801)
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    cores = len(os.sched_getaffinity(0))
    lines = [
        '# Speed of a diagnosis', '',
        f'Six records of {SECONDS:g} s at 500 Hz, the whole library, {cores} cores '
        f'({platform.machine()}). Command: `./cg exec python bench/diagnosis_speed.py`', '',
        '| hidden | verdict | causes | wall time, s | load of the machine before |',
        '|---|---|---|---:|---:|',
    ]  # fmt: skip
    for k, name in enumerate(options.effects.split(',')):
        effects = () if name == 'none' else (name,)
        nominal, machine, _ = hide(
            Model.load(model_path(NOMINAL_MODEL)), effects, 1.0, options.first + k
        )
        records = records_of(machine, options.first + k, programme=SIX, seconds=SECONDS)
        load, began = os.getloadavg()[0], time.monotonic()
        found = diagnose(nominal, records)
        lines.append(
            f'| {name} | {found.verdict} | {", ".join(c.label for c in found.causes)} '
            f'| {time.monotonic() - began:.1f} | {load:.1f} |'
        )
        print(lines[-1], flush=True)
    if options.write:
        options.write.write_text('\n'.join(lines) + '\n')


if __name__ == '__main__':
    main()
