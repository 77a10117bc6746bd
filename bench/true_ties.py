"""Are rivals that were named beside a hidden effect true ones? Asked of the machine itself.

    ./cg exec python bench/true_ties.py [--raw bench/results/hidden_effects.jsonl]

For every case of bench/hidden_effects.py in which more was named than was hidden, the machine is
recorded once more in the same experiments, but with sensors that neither err nor round. To these
records the true structure is fitted, and the same with the rival in place of the hidden effect;
both may have small faults, as in a diagnosis. What they differ by, in units of the noise that the
sensors had, is what the data of that case can be expected to say: chi2/2 in nats. Below the margin
of the diagnosis no method could have told the two apart, and the rival belongs to the answer. The
row in `--raw` gets `ties`: rival -> nats.
"""

import argparse
import itertools
import json
from dataclasses import replace
from pathlib import Path

from hidden_effects import SPRING_ERROR, THE_SAME, hide, records_of, with_small_faults

from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid.diagnosis.diagnose import split
from cg_sysid.errors import Failure
from cg_sysid.identification.data_set import led_in, prepare
from cg_sysid.parallel import run_all
from cg_sysid.search import settings
from cg_sysid.search.nuisance import with_nuisances
from cg_sysid.search.outcome import chi2
from cg_sysid.search.task import Task
from cg_sysid.search.whole_fit import try_candidate

parser = argparse.ArgumentParser(
    description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
)
parser.add_argument('--raw', type=Path, default=Path('bench/results/hidden_effects.jsonl'))
parser.add_argument('--workers', type=int, help='processes')


def exact_sensors(machine):
    """The machine with sensors that report what is there."""
    sensors = {
        channel: {name: q for name, q in sensor.items() if name not in ('noise', 'resolution')}
        for channel, sensor in machine.sensors.items()
    }
    return replace(machine, sensors=sensors)


def structures(nominal, hidden, rival, setups):
    """Tasks with the rival in place of one of the hidden effects, at each place and at all."""
    places = LIBRARY[rival].sites(nominal.mechanism)
    for gone in hidden:
        others = with_effects(nominal, [name for name in hidden if name != gone])
        base, bounds = with_nuisances(others, setups)
        for at in places:
            yield Task(base, (rival, at), bounds=bounds)
        for at in places[1:]:
            label = LIBRARY[rival](nominal.mechanism, at).label
            if label in {e.label for e in base.effects}:  # as a small fault
                base = base.without_effect(label)
                bounds = {n: b for n, b in bounds.items() if not n.startswith(f'{label}.')}
            base = base.with_effect(rival, at)
        if places[1:]:
            yield Task(base, (rival, places[0]), bounds=bounds)


def with_effects(model, names):
    for name in names:
        model = model.with_effect(name, None)
    return model


def least(tasks, train, held, workers):
    """Cost of the best of these structures: chi2, and distance from what is believed."""
    thorough = [
        replace(t, thorough=True, iterations=settings.FITTING.thorough_iterations) for t in tasks
    ]
    found = run_all(try_candidate, [(t, train, held) for t in thorough], workers)
    return min(chi2(o) + o.train.belief for o in found if not isinstance(o, Failure))


def ties_of(row, workers=None):
    """Rival -> nats by which exact sensors would tell it from what is hidden."""
    hidden, faults = row['hidden'], row['faults']
    nominal, machine, _ = hide(
        Model.load(model_path(NOMINAL_MODEL)), hidden, row['size'], row['seed']
    )
    machine = with_small_faults(machine) if faults else machine
    records = records_of(exact_sensors(machine), row['seed'], SPRING_ERROR * faults)
    train, held = split([led_in(data_set) for data_set in prepare(nominal, records)])
    setups = [data_set.setup for data_set in (*train, *held)]
    others, bounds = with_nuisances(with_effects(nominal, hidden[1:]), setups)
    truth = least([Task(others, (hidden[0], None), bounds=bounds)], train, held, workers)
    same = set(itertools.chain.from_iterable(s for s in THE_SAME if s & set(hidden)))
    rivals = [name for name in row['named'] if name not in hidden and name not in same]
    costs = [
        least(structures(nominal, hidden, rival, setups), train, held, workers) for rival in rivals
    ]
    return {rival: (cost - truth) / 2 for rival, cost in zip(rivals, costs, strict=True)}


def main():
    options = parser.parse_args()
    rows = [json.loads(line) for line in options.raw.read_text().splitlines()]
    for row in rows:
        more = row['hidden'] and set(row['hidden']) < set(row['named'])
        if more and 'ties' not in row:
            row['ties'] = {k: round(float(v), 1) for k, v in ties_of(row, options.workers).items()}
            print(row['hidden'], row['seed'], row['ties'], flush=True)
    options.raw.write_text(''.join(json.dumps(row) + '\n' for row in rows))


if __name__ == '__main__':
    main()
