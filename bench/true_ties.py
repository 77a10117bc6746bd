"""Are rivals that were named beside a hidden effect true ones? Asked of the machine itself.

    ./cg exec python bench/true_ties.py [--raw bench/results/hidden_effects.jsonl]

For every case of bench/hidden_effects.py in which more was named than was hidden (without small
faults), the machine is recorded once more in the same experiments, but with sensors that neither
err nor round. To these records the true structure is fitted, and the same with the rival in place
of the hidden effect. What they differ by, in units of the noise that the sensors had, is what the
data of that case can be expected to say: chi2/2 in nats. Below the margin of the diagnosis no
method could have told the two apart, and the rival belongs to the answer. The row in `--raw` gets
`ties`: rival -> nats.
"""

import argparse
import itertools
import json
from dataclasses import replace
from pathlib import Path

from hidden_effects import THE_SAME, hide, records_of

from cg_bringup.runs import NOMINAL_MODEL
from cg_description.paths import model_path
from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid.candidates import Task, chi2, try_candidate
from cg_sysid.diagnose import THOROUGH_ITERATIONS, led_in, split
from cg_sysid.parallel import run_all
from cg_sysid.trial import prepare

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


def structures(nominal, hidden, rival):
    """Tasks with the rival in place of one of the hidden effects, at each place and at all."""
    places = LIBRARY[rival].sites(nominal.mechanism)
    for gone in hidden:
        base = nominal
        for name in hidden:
            base = base.with_effect(name, None) if name != gone else base
        for at in places:
            yield Task(base, (rival, at))
        for at in places[1:]:
            base = base.with_effect(rival, at)
        if places[1:]:
            yield Task(base, (rival, places[0]))


def least(tasks, train, held, workers):
    """chi2 of the best of these structures."""
    thorough = [replace(t, thorough=True, iterations=THOROUGH_ITERATIONS) for t in tasks]
    found = run_all(try_candidate, [(t, train, held) for t in thorough], workers)
    return min(chi2(o) for o in found if not isinstance(o, str))


def ties_of(row, workers=None):
    """Rival -> nats by which exact sensors would tell it from what is hidden."""
    hidden = row['hidden']
    nominal, machine, _ = hide(
        Model.load(model_path(NOMINAL_MODEL)), hidden, row['size'], row['seed']
    )
    records = records_of(exact_sensors(machine), row['seed'])
    train, held = split([led_in(trial) for trial in prepare(nominal, records)])
    others = nominal
    for name in hidden[1:]:
        others = others.with_effect(name, None)
    truth = least([Task(others, (hidden[0], None))], train, held, workers)
    same = set(itertools.chain.from_iterable(s for s in THE_SAME if s & set(hidden)))
    return {
        rival: 0.5 * (least(structures(nominal, hidden, rival), train, held, workers) - truth)
        for rival in row['named'] if rival not in hidden and rival not in same
    }  # fmt: skip


def main():
    options = parser.parse_args()
    rows = [json.loads(line) for line in options.raw.read_text().splitlines()]
    for row in rows:
        more = row['hidden'] and set(row['hidden']) < set(row['named'])
        if more and not row['faults'] and 'ties' not in row:
            row['ties'] = {k: round(v, 1) for k, v in ties_of(row, options.workers).items()}
            print(row['hidden'], row['seed'], row['ties'], flush=True)
    options.raw.write_text(''.join(json.dumps(row) + '\n' for row in rows))


if __name__ == '__main__':
    main()
