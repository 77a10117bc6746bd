"""How often the right cause is named: effects hidden in simulated machines, many sizes and seeds.

    ./cg exec python bench/hidden_effects.py [--first 101] [--seeds 1] [--effects a,b]
        [--sizes 1,0.3] [--faults] [--pairs N] [--workers N] [--raw FILE]
        [--write FILE] [--picture FILE]

Each case: an effect of a size drawn from cg_bringup/config/hidden_effects.yaml, times one of
`--sizes`, is put into a robot whose numbers are 10 to 20 % off the nominal file; the four
identification set-ups are recorded twice with different excitations (8 s at 500 Hz, sensor noise
and encoder counts), and the analysis gets the records and the nominal file. `healthy` cases hide
nothing. With `--faults` what every real robot has stays in, unmodelled: a delay of 1 ms, friction
that turns twice as fast, springs 1 % off, an encoder 0.3 mrad off. `--pairs` hides two effects.

Of an effect is said how much of the simulation error is its own share, in standard deviations of
the noise: how much worse than the true structure the same without it does on held-out records,
both fitted; among small faults both may have them. What explains less than three is not counted.

A case is *exact* if causes and rivals together are what was hidden (a delay of the torques and one
of all readings are one and the same and have to come together) and, at most, rivals that the data
of that case cannot tell from it, as bench/true_ties.py asked the machine itself; *top* if the
causes are what was hidden, and *found* if that is among causes and rivals. Every case is one line
of `--raw`, and the table is made from all lines there: long runs can be done in pieces, and beside
each other with `--workers 1` each.
"""

import argparse
import json
import math
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml

from cg_bringup.hidden import draw_values, hidden_effects_file, hideable_effects, perturb
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid.diagnosis.diagnose import diagnose, split
from cg_sysid.diagnosis.result import Options
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import led_in, prepare
from cg_sysid.identification.identify import fit, score
from cg_sysid.identification.unknowns import own_unknowns
from cg_sysid.search.nuisance import with_nuisances
from cg_sysid.search.ranking import effect_name, per_output

PROGRAMME = (
    'spring_stabilised_inner',
    'spring_stabilised_outer',
    'swing_inner_fixed',
    'swing_outer_fixed',
) * 2
SECONDS = 8.0
# To torques late and all readings late by one time only the first moments of a record differ.
THE_SAME = ({'actuator_delay', 'sensor_delay'},)
UNTOLD = 6.0  # nats: what differs by less, all records together, is not told apart
SPRING_ERROR = 0.01  # relative, of all springs, among small faults
# Hidden here besides what the demonstration hides, alone and after all others: the seeds and the
# pairs of earlier sweeps stay what they were.
ALSO = {
    'boom_mass': {'weight': [0.3, 1.0], 'signed': ['weight']},  # kg
    'rotor_inertia': {'inertia': [0.05, 0.2]},  # kg m^2
}
SHARE = 3.0  # of the noise: causes that explain less are not counted as hidden


def records_of(machine, seed, spring_error=0.0, programme=PROGRAMME, seconds=SECONDS):
    """The records of one machine; their notes do not know of the springs' error."""
    found = []
    for i, name in enumerate(programme):
        e = load_experiment(name)
        settings = ExcitationSettings(**e.excitation, duration=seconds, seed=100 * seed + i)
        true = replace(
            e.setup,
            springs=tuple(
                replace(s, stiffness=s.stiffness * (1 + spring_error)) for s in e.setup.springs
            ),
        )
        record = rehearse(
            f'{i}_{name}',
            machine,
            true,
            e.initial_state,
            [make_signal(settings)],
            seconds,
            seed=1000 * seed + i,
        )
        found.append(replace(record, setup=e.setup))
    return found


def with_small_faults(machine):
    """What every real robot has, less the springs."""
    faults = {'actuator_delay': {'delay': 0.001}, 'encoder_offset': {'offset': 3e-4}}
    for name, values in faults.items():
        if all(name != e.label for e in machine.effects):
            machine = machine.with_effect(name, None, **values)
    key = 'coulomb_friction.transition_rate'
    return (
        machine.with_values({key: 0.5 * machine.values[key]})
        if key in machine.values
        else (machine)
    )


def hide(nominal, effects, size, seed):
    """Nominal model, machine and the hidden values; effects of the model are left out of it."""
    table = yaml.safe_load(hidden_effects_file().read_text(encoding='utf-8')) | ALSO
    rng = np.random.default_rng(seed)
    machine, values = perturb(nominal, rng)[0], {}
    for name in effects:
        if name in table:
            drawn = draw_values(table[name], rng)
            first = LIBRARY[name].parameters[0]
            # A stiffness is the smaller effect the larger it is.
            stiff = first.neutral is not None and np.isinf(first.neutral)
            drawn[first.name] *= 1 / size if stiff else size
            machine = machine.with_effect(name, None, **drawn)
            values[name] = drawn
        else:
            nominal, values[name] = nominal.without_effect(name), {}
    return nominal, machine, values


def case(effects, size, seed, faults, workers=None):
    """One line of the raw results."""
    nominal, machine, values = hide(Model.load(model_path(NOMINAL_MODEL)), effects, size, seed)
    if faults:
        machine = with_small_faults(machine)
    records = records_of(machine, seed, SPRING_ERROR * faults)
    about = {'size': size, 'seed': seed, 'faults': faults}
    return about | row_of(nominal, records, values, workers, faults)


def share_of(nominal, records, hidden, faults):
    """What the least of these effects explains, whatever a diagnosis says, in noise sigmas."""
    train, held = split([led_in(data_set) for data_set in prepare(nominal, records)])

    def left(names):
        """chi2/N of each output on held-out records with these effects."""
        model, bounds = nominal, {}
        for name in names:
            model = model.with_effect(name, None, **hidden[name])
        if faults:
            model, bounds = with_nuisances(model, [t.setup for t in (*train, *held)])
        happened = {u.name: u.prior for u in own_unknowns(model)}
        own = {data_set.name: happened for data_set in (*train, *held)}
        found = fit(model, train, own=own, bounds=bounds)
        return per_output(score(found.model, held, own=own))

    whole = left(hidden)
    return min((
        float(np.sqrt(max(0.0, (left([n for n in hidden if n != name]) - whole).max())))
        for name in hidden
    ), default=0.0)  # fmt: skip


def row_of(nominal, records, hidden, workers=None, faults=False):
    """What a diagnosis says of records, beside what was hidden in them: effect -> its values."""
    began = time.monotonic()
    found = diagnose(nominal, records, Options(workers=workers))
    causes = sorted({effect_name(c.label) for c in found.causes})
    named = sorted({*causes, *(effect_name(r) for c in found.causes for r in c.rivals)})
    before, after = found.baseline.held, found.extended.held
    return {
        'hidden': list(hidden), 'verdict': found.verdict, 'causes': causes, 'named': named,
        'share': share_of(nominal, records, hidden, faults),
        'before': before.normalised_error, 'after': after.normalised_error,
        'inside': [
            bool(abs(off) < 1.96 * sigma)
            for c in found.causes
            for off, sigma in errors_of(c.parameters, hidden.get(effect_name(c.label), {}))
        ],
        'seconds': round(time.monotonic() - began, 1),
    }  # fmt: skip


def errors_of(found, hidden):
    """Error and stated standard deviation of each parameter of a cause."""
    # A sin(x) and -A sin(x + pi) are the same wave.
    turned = 'phase' in hidden and found['amplitude'][0] * hidden['amplitude'] < 0
    for name, true in hidden.items():
        if name not in found:
            continue
        value, sigma, _ = found[name]
        if name == 'amplitude' and turned:
            value = -value
        if name == 'phase':
            value += np.pi * turned
            value = true + math.remainder(value - true, 2 * math.pi)
        yield value - true, sigma


def verdict_of(row):
    hidden, causes, named = (set(row[k]) for k in ('hidden', 'causes', 'named'))
    whole = hidden.union(*(same for same in THE_SAME if hidden & same))
    untold = {name for name, nats in row.get('ties', {}).items() if nats < UNTOLD}
    return {
        'exact': whole <= named <= whole | untold, 'top': causes == hidden,
        'found': hidden <= named,
    }  # fmt: skip


def table_of(rows):
    """The rows of one kind of case, by hidden effect."""
    lines = [
        '| hidden | cases | exact | top | found | chi2/N before | after | also or instead | s |',
        '|---|---:|---:|---:|---:|---:|---:|---|---:|',
    ]
    kinds = sorted({tuple(sorted(r['hidden'])) for r in rows})
    for kind in kinds:
        own = [r for r in rows if tuple(sorted(r['hidden'])) == kind]
        seen = [verdict_of(r) for r in own]
        others = sorted({o for r in own for o in set(r['named']) - set(kind)})
        lines.append(
            f'| {" + ".join(kind) or "nothing"} | {len(own)} '
            f'| {sum(s["exact"] for s in seen)} | {sum(s["top"] for s in seen)} '
            f'| {sum(s["found"] for s in seen)} | {np.median([r["before"] for r in own]):.3g} '
            f'| {np.median([r["after"] for r in own]):.3g} | {", ".join(others)} '
            f'| {np.median([r["seconds"] for r in own]):.0f} |'
        )
    return lines


def summary_of(rows):
    """Rates over all rows of one kind of case."""
    hidden = [r for r in rows if r['hidden']]
    healthy = [r for r in rows if not r['hidden']]
    strong = [r for r in hidden if r['share'] >= SHARE]
    lines = []
    if hidden:
        seen = [verdict_of(r) for r in strong]
        inside = [x for r in strong for x in r['inside']]
        lines.append(
            f'{len(strong)} of {len(hidden)} cases explain at least {SHARE:g} noise standard '
            f'deviations. Of these {sum(s["exact"] for s in seen)} exact, '
            f'{sum(s["top"] for s in seen)} top, {sum(s["found"] for s in seen)} found; '
            f'{sum(inside)} of {len(inside)} parameters inside their 95 % interval.'
        )
    if healthy:
        alarms = sum(bool(r['causes']) for r in healthy)
        lines.append(f'{alarms} false alarms in {len(healthy)} healthy cases.')
    return lines


def picture(rows, file):
    """Confusion of single hidden effects with what was named."""
    import matplotlib

    matplotlib.use('Agg')
    from matplotlib import pyplot as plt

    single = [r for r in rows if len(r['hidden']) <= 1]
    hidden = sorted({(r['hidden'] or ['nothing'])[0] for r in single})
    named = sorted({n for r in single for n in (r['named'] or ['nothing'])} | set(hidden))
    counts = Counter(
        ((r['hidden'] or ['nothing'])[0], n) for r in single for n in (r['named'] or ['nothing'])
    )
    total = Counter((r['hidden'] or ['nothing'])[0] for r in single)
    shares = np.array([[counts[h, n] / total[h] for n in named] for h in hidden])
    figure, axes = plt.subplots(figsize=(0.24 * len(named) + 2.5, 0.24 * len(hidden) + 2.5))
    image = axes.imshow(np.where(shares > 0, shares, np.nan), cmap='viridis_r', vmin=0, vmax=1)
    axes.set_xticks(range(len(named)), named, rotation=90, fontsize=7)
    axes.set_yticks(range(len(hidden)), hidden, fontsize=7)
    axes.set_xlabel('named as cause or rival')
    axes.set_ylabel('hidden')
    axes.set_xticks(np.arange(len(named)) + 0.5, minor=True)
    axes.set_yticks(np.arange(len(hidden)) + 0.5, minor=True)
    axes.grid(which='minor', color='0.9', linewidth=0.5)
    axes.tick_params(which='minor', length=0)
    figure.colorbar(image, shrink=0.3, label='share of the cases')
    figure.savefig(file, bbox_inches='tight', metadata={'Date': None})


def write(rows, file, command):
    """The tables, one part for each kind of case."""
    parts = ['# Hidden effects', '', f'Command: `{command}`', '']
    for title, keep in (
        ('One effect, nothing else wrong', lambda r: len(r['hidden']) < 2 and not r['faults']),
        ('One effect among small faults', lambda r: len(r['hidden']) < 2 and r['faults']),
        ('Two effects', lambda r: len(r['hidden']) == 2 and not r['faults']),
        ('Two effects among small faults', lambda r: len(r['hidden']) == 2 and r['faults']),
    ):
        own = [r for r in rows if keep(r)]
        if own:
            parts += [f'## {title}', '', *summary_of(own), '', *table_of(own), '']
    file.write_text('\n'.join(parts))


def cases_of(options, known):
    """(effects, size, seed, faults) of each case that was asked for."""
    rng = np.random.default_rng(options.first)
    sizes = [float(s) for s in options.sizes.split(',')]
    for k in range(options.seeds):
        if options.pairs:
            for j in range(options.pairs):
                pair = tuple(str(x) for x in rng.choice(known, 2, replace=False))
                yield pair, float(rng.choice(sizes)), options.first + 1000 * k + j, options.faults
            continue
        for j, name in enumerate(('none', *known, *ALSO)):
            effects = () if name == 'none' else (name,)
            yield effects, float(rng.choice(sizes)), options.first + 1000 * k + j, options.faults


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seeds', type=int, default=1)
    parser.add_argument('--first', type=int, default=101)
    parser.add_argument('--effects', help='comma-separated; none is a healthy machine')
    parser.add_argument('--sizes', default='1', help='factors of the sizes, drawn for each case')
    parser.add_argument('--pairs', type=int, default=0, help='hide two effects, this many times')
    parser.add_argument('--faults', action='store_true', help='leave in small faults')
    parser.add_argument('--workers', type=int, help='processes of each diagnosis')
    parser.add_argument('--raw', type=Path, default=Path('bench/results/hidden_effects.jsonl'))
    parser.add_argument('--write', type=Path)
    parser.add_argument('--picture', type=Path)
    parser.add_argument('--table-only', action='store_true', help='run nothing')
    options = parser.parse_args()
    known = hideable_effects(Model.load(model_path(NOMINAL_MODEL)))
    wanted = None if options.effects is None else set(options.effects.split(','))
    for effects, size, seed, faults in () if options.table_only else cases_of(options, known):
        if wanted is not None and not wanted & set(effects or ('none',)):
            continue
        row = case(effects, size, seed, faults, options.workers)
        seen = verdict_of(row)
        print(*(k for k, v in seen.items() if v), row, flush=True)
        with options.raw.open('a') as raw:
            raw.write(json.dumps(row) + '\n')
    rows = [json.loads(line) for line in options.raw.read_text().splitlines()]
    print('\n'.join(summary_of(rows)))
    if options.write:
        write(rows, options.write, 'python bench/hidden_effects.py --table-only --write FILE')
    if options.picture:
        picture(rows, options.picture)


if __name__ == '__main__':
    main()
