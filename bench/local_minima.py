"""Whether fits find the bottom: the true structure, hidden numbers, on records of 8 and of 20 s.

    ./cg exec python bench/local_minima.py [--effects a,b] [--seeds 851,852,853] [--long 854,855]

Each effect of cg_bringup/config/hidden_effects.yaml is hidden (half, full or twice its size) in a
robot whose numbers are 10 to 20 % off, and the analysis is told which. What it fits then has to
reach the noise (chi2/N < 1.2); where it does not, the search stopped in a local minimum, and a
diagnosis would look for another cause. The long records sweep slowly: their first seconds say
little about a resonance. Prints what was missed, and how many.
"""

import argparse
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace

import yaml
from hidden_effects import PROGRAMME, SECONDS, hide, records_of

from cg_bringup.hidden import hidden_effects_file
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_sysid.diagnosis.diagnose import split
from cg_sysid.identification.data_set import prepare
from cg_sysid.search import settings
from cg_sysid.search.look import Screening, screen
from cg_sysid.search.outcome import Outcome, own_parameters
from cg_sysid.search.task import Task
from cg_sysid.search.whole_fit import try_candidate

LONG_S, SIX = 20.0, PROGRAMME[:6]
SIZES = (0.5, 1.0, 2.0)
AT_NOISE = 1.2


def attempt(effect, seed, long):
    """Hidden values, fitted values, chi2/N on training records, and seconds."""
    nominal, machine, values = hide(
        Model.load(model_path(NOMINAL_MODEL)), (effect,), SIZES[seed % len(SIZES)], seed
    )
    programme, seconds = (SIX, LONG_S) if long else (PROGRAMME, SECONDS)
    records = records_of(machine, seed, programme=programme, seconds=seconds)
    train, held = split(prepare(nominal, records))
    began = time.monotonic()
    screening = screen(Task(nominal, (effect, None)), train)
    assert isinstance(screening, Screening), screening
    found = try_candidate(
        replace(screening.task, iterations=sum(settings.HALVING.rungs)), train, held
    )
    took = time.monotonic() - began
    if not isinstance(found, Outcome):
        return values[effect], found, float('inf'), took
    fitted = {name: value for name, (value, _, _) in own_parameters(found).items()}
    return values[effect], fitted, found.train.normalised_error, took


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--effects', help='comma-separated; by default all')
    parser.add_argument('--seeds', default='851,852,853', help='of records of 8 s')
    parser.add_argument('--long', default='854,855', help='of records of 20 s')
    options = parser.parse_args()
    every = yaml.safe_load(hidden_effects_file().read_text(encoding='utf-8'))
    effects = options.effects.split(',') if options.effects else list(every)
    cases = [
        (effect, int(seed), long)
        for effect in effects
        for seeds, long in ((options.seeds, False), (options.long, True))
        for seed in seeds.split(',')
        if seed
    ]
    missed, total = 0, 0.0
    with ProcessPoolExecutor() as pool:
        for case, result in zip(cases, pool.map(attempt, *zip(*cases, strict=True)), strict=True):
            hidden, fitted, error, took = result
            total += took
            if not error < AT_NOISE:
                missed += 1
                print(f'missed {case}: hidden {hidden}, fitted {fitted}, chi2/N {error:.3g}')
    print(f'{len(cases) - missed} of {len(cases)} reach the noise; {total:.0f} s of fits')


if __name__ == '__main__':
    main()
