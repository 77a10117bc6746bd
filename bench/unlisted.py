"""What a diagnosis says of machines with a law that no library has, when it may try everything.

    ./cg exec python bench/unlisted.py [--first 0] [--laws a,b] [--workers N] [--write FILE]

The laws and the machines are those of cg_sysid/test/unlisted.py: four records of 6 s on springs.
There the diagnosis may try what comes nearest; here it has the whole library, any two or three
effects of which could together pass for the law. *Right* is `unexplained`, with the law at its
place and as a function of its variable, or undescribed where it is no function of one variable.
Causes that come with it take less than half of the error.
"""

import argparse
import sys
import time
from pathlib import Path

from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options

sys.path.insert(0, str(Path(__file__).parents[1] / 'src/cg_sysid/test'))
from unlisted import CASES, MORE, hide, records


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--first', type=int, default=0, help='of the records')
    parser.add_argument('--laws', help='comma-separated')
    parser.add_argument('--workers', type=int)
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    cases = {case.hidden.name.removeprefix('hidden_'): case for case in (*CASES, *MORE)}
    wanted = options.laws.split(',') if options.laws else list(cases)
    if unknown := set(wanted) - set(cases):
        parser.error(f'no law {", ".join(sorted(unknown))} here; there are {", ".join(cases)}')
    nominal = Model.load(model_path(NOMINAL_MODEL))
    lines = [
        '# Laws that no library has', '',
        f'Command: `./cg exec python bench/unlisted.py --first {options.first}`', '',
        '| law | verdict | causes | described as | explained | right | s |',
        '|---|---|---|---|---:|---|---:|',
    ]  # fmt: skip
    for name in wanted:
        case, began = cases[name], time.monotonic()
        machine = hide(nominal, case.hidden)
        answer = diagnose(
            nominal, records(machine, options.first), Options(workers=options.workers)
        )
        found = answer.unmodelled
        described = (found.where, found.effect.follows) if found else ('', '')
        right = (answer.verdict, *described) == ('unexplained', case.where, case.follows)
        lines.append(
            f'| {name} | {answer.verdict} '
            f'| {", ".join(cause.label for cause in answer.causes)} '
            f'| {found.label if found else ""} | {100 * found.explained if found else 0:.1f} % '
            f'| {"yes" if right else "**no**"} | {time.monotonic() - began:.0f} |'
        )
        print(lines[-1], flush=True)
    if options.write:
        options.write.write_text('\n'.join(lines) + '\n', encoding='utf-8')


if __name__ == '__main__':
    main()
