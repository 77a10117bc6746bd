"""How often the right cause is named: effects hidden in simulated machines, many sizes and seeds.

    ./cg exec python bench/hidden_effects.py [--seeds 3] [--effects a,b] [--faults] [--write FILE]

Each case: an effect of a size drawn from cg_bringup/config/hidden_effects.yaml is put into a robot
whose numbers are 10 to 20 % off the nominal file, the four identification set-ups are recorded
twice with different excitations (8 s at 500 Hz, sensor noise and encoder counts), and the analysis
gets the records and the nominal file. `healthy` cases hide nothing; `small faults` cases leave in
what every real robot has: a delay of 1 ms, friction that turns twice as fast, springs 1 % off, an
encoder 0.3 mrad off.

A case counts as *named* if causes and rivals are exactly the hidden effect and what physics makes
the same (a delay of torque and of all sensors), as *found* if the hidden effect is among them.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from cg_bringup.hidden import hide, hideable_effects, perturb
from cg_bringup.runs import NOMINAL_MODEL
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_sysid.diagnose import diagnose
from cg_sysid.diagnosis import Options
from cg_sysid.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments import load_experiment
from cg_sysid.rehearse import rehearse

PROGRAMME = (
    'spring_stabilised_inner',
    'spring_stabilised_outer',
    'swing_inner_fixed',
    'swing_outer_fixed',
) * 2
SECONDS = 8.0
SAME = ({'actuator_delay', 'sensor_delay'},)


def records_of(machine, seed, spring_error=0.0):
    found = []
    for i, name in enumerate(PROGRAMME):
        e = load_experiment(name)
        settings = ExcitationSettings(**e.excitation, duration=SECONDS, seed=100 * seed + i)
        true = replace(
            e.setup,
            springs=tuple(
                replace(s, stiffness=s.stiffness * (1 + spring_error)) for s in e.setup.springs
            ),
        )
        record = rehearse(f'{i}_{name}', machine, true, e.initial_state,
                          [make_signal(settings)], SECONDS, seed=1000 * seed + i)
        found.append(replace(record, setup=e.setup))
    return found


def with_small_faults(machine):
    faulty = machine
    faults = {'actuator_delay': {'delay': 0.001}, 'encoder_offset': {'offset': 3e-4}}
    for name, values in faults.items():
        if all(name != e.label for e in faulty.effects):
            faulty = faulty.with_effect(name, None, **values)
    key = 'coulomb_friction.transition_rate'
    return faulty.with_values({key: 0.5 * faulty.values[key]}) if key in faulty.values else faulty


def case(effect, seed, faults):
    nominal = Model.load(model_path(NOMINAL_MODEL))
    if effect is None:
        machine, values = perturb(nominal, np.random.default_rng(seed))[0], {}
    else:
        hidden = hide(nominal, effect, seed)
        nominal, machine, values = hidden.nominal, hidden.model, hidden.values
    if faults:
        machine = with_small_faults(machine)
    began = time.monotonic()
    found = diagnose(nominal, records_of(machine, seed, 0.01 if faults else 0.0),
                     Options(workers=2))
    named = {c.label.partition('@')[0] for c in found.causes}
    named |= {r.partition('@')[0] for c in found.causes for r in c.rivals}
    expected = {effect} if effect else set()
    for same in SAME:
        if effect in same:
            expected = same
    inside = [
        abs(c.parameters[n][0] - v) < 1.96 * c.parameters[n][1] + 2e-3 * abs(v)
        for c in found.causes
        if c.label == effect
        for n, v in values.items()
        if n in c.parameters
    ]
    return {
        'exact': named == expected,
        'found': effect in named if effect else not named,
        'verdict': found.verdict,
        'named': ', '.join(sorted(named)) or '-',
        'before': found.baseline.held.normalised_error,
        'after': found.extended.held.normalised_error,
        'inside': inside,
        'seconds': time.monotonic() - began,
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seeds', type=int, default=3)
    parser.add_argument('--first', type=int, default=101)
    parser.add_argument('--effects')
    parser.add_argument('--faults', action='store_true', help='leave in small faults')
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    nominal = Model.load(model_path(NOMINAL_MODEL))
    effects = options.effects.split(',') if options.effects else hideable_effects(nominal)
    lines = [
        '| hidden | cases | named exactly | found | chi2/N before | after '
        '| inside 95 % interval | also or instead | s each |',
        '|---|---:|---:|---:|---:|---:|---:|---|---:|',
    ]
    total = {'exact': 0, 'found': 0, 'cases': 0}
    for effect in ('none', *effects):
        rows = []
        for k in range(options.seeds * (3 if effect == 'none' else 1)):
            row = case(None if effect == 'none' else effect, options.first + k, options.faults)
            rows.append(row)
            print(effect, options.first + k, row, flush=True)
        inside = [x for r in rows for x in r['inside']]
        others = sorted({r['named'] for r in rows if not r['exact']})
        lines.append(
            f'| {effect} | {len(rows)} | {sum(r["exact"] for r in rows)} '
            f'| {sum(r["found"] for r in rows)} | {np.median([r["before"] for r in rows]):.3g} '
            f'| {np.median([r["after"] for r in rows]):.3g} '
            f'| {f"{sum(inside)} of {len(inside)}" if inside else "-"} '
            f'| {"; ".join(others)} | {np.median([r["seconds"] for r in rows]):.0f} |'
        )
        if effect != 'none':
            total['cases'] += len(rows)
            total['exact'] += sum(r['exact'] for r in rows)
            total['found'] += sum(r['found'] for r in rows)
    lines.append('')
    lines.append(f'{total["exact"]} of {total["cases"]} named exactly, {total["found"]} found.')
    text = '\n'.join(lines) + '\n'
    print(text)
    if options.write:
        faults = ' --faults' if options.faults else ''
        command = f'python bench/hidden_effects.py --seeds {options.seeds}{faults}'
        options.write.write_text(f'# Hidden effects\n\nCommand: `{command}`.\n\n{text}')


if __name__ == '__main__':
    main()
