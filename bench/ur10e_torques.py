"""What the torques of a real arm lack: the friction of its joints, and a load.

    ./cg exec python bench/ur10e_torques.py DATA_DIR [--write bench/results/ur10e_torques.md]
        [--picture FILE]

The UR10e of ur10e.py, by torques alone (search/torque_selection.py): nothing is simulated. Laws
are chosen on half of the training recordings and the other half; those held out here take no part
in that. Relative residual errors are as there, with the same smoothed motion for every model.

    train       20_02_05-20sec_8harm, 20_02_06-20sec_5harm and 10harm, 20_02_10-20sec_7harm
    held out    20_02_05-20sec_12harm, 20_02_10-30sec_12harm
    load        numbers from 20_01_31-unload; the halves of 20_01_31-load, which has a load that
                the model does not know
"""

import argparse
import io
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

from base_parameters import least_squares
from ur10e import HELD, LOADED, TRAIN, TURNING, UNLOADED, bare, nominal, read, relative

from cg_sysid import parallel
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.joint_friction import friction_of
from cg_sysid.identification.torque_error import fit_by_torque
from cg_sysid.report import friction_picture
from cg_sysid.search.torque_judging import Law
from cg_sysid.search.torque_selection import TorqueSelection, select
from cg_sysid.text import listed, measured


def carry_out(function: Callable, arguments: list[tuple], what: str) -> list:
    """On all cores."""
    return parallel.run_all(function, arguments)


def row(name: str, values) -> str:
    """Of a table."""
    return f'| {name} | ' + ' | '.join(f'{v:.3f}' for v in values) + ' |'


def shares(found: TorqueSelection, law: Law) -> str:
    """What a law takes of the squared error, by joint."""
    return listed([
        f'{share:.0%} {joint.removesuffix("_joint")}'
        for joint, share in found.shares(law).items()
    ])  # fmt: skip


def laws_of(found: TorqueSelection) -> list[str]:
    """A row for each law."""
    rows = []
    for law in found.laws:
        sizes = ', '.join(f'{n} {measured(*told)}' for n, told in law.parameters.items())
        rivals = ', '.join(law.rivals)
        rows.append(
            f'| {law.label} | {sizes} | {law.nats:.0f} | {shares(found, law)} | {rivals} |'
        )
    return rows


def main() -> None:
    """Print the tables, and write them if asked to."""
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('data', type=Path)
    parser.add_argument('--write', type=Path)
    parser.add_argument('--picture', type=Path, help='PNG of the friction of all joints')
    options = parser.parse_args()
    model = nominal(options.data)
    body = model.mechanism
    out = io.StringIO()

    def say(line: str = '') -> None:
        print(line, flush=True)
        out.write(line + '\n')

    recorded = {
        name: read(options.data, name, body) for name in (*TRAIN, *HELD, *UNLOADED, *LOADED)
    }
    train, held = (prepare(model, [recorded[n] for n in names]) for names in (TRAIN, HELD))
    began = time.monotonic()
    found = select(model, train[0::2], train[1::2], carry_out=carry_out)
    seconds = time.monotonic() - began
    say('# The friction of a UR10e, by torques alone\n')
    say('Command: `./cg exec python bench/ur10e_torques.py DATA_DIR`. Relative residual error on '
        'held-out motions, by joint:\n')  # fmt: skip
    joints = [j.removesuffix('_joint') for j in body.coordinates]
    say('| | ' + ' | '.join(joints) + ' |')
    say('|---|' + '---:|' * len(joints))
    say(row('URDF, no friction', relative(bare(model), held)))
    say(row('least squares of base parameters', least_squares(model, train, held, TURNING).left))
    plain = fit_by_torque(model, train)
    assert plain is not None
    say(row('ours, plain friction', relative(model.with_values(plain.values), held)))
    say(row('ours, with the laws', relative(found.model, held)))
    say(f'\nWhat was taken up, in {seconds:.0f} s on {os.cpu_count()} cores:\n')
    say('| law | numbers | nats | takes of the squared error | or |')
    say('|---|---|---:|---|---|')
    for line in laws_of(found):
        say(line)
    say('\nNot taken up, the best three:\n')
    say('| law | takes of the squared error | why not |')
    say('|---|---|---|')
    for law in found.turned_down[:3]:
        say(f'| {law.label} | {shares(found, law)} | {law.reason} |')
    say('\nAll friction of each joint, with these laws:\n')
    say('| joint | law | numbers |')
    say('|---|---|---|')
    for joint in body.coordinates:
        for effect in found.model.effects:
            if effect.site == joint:
                values = found.model.values_of(effect)
                numbers = ', '.join(f'{k} {v:.3g}' for k, v in values.items())
                say(f'| {joint} | {effect.name} | {numbers} |')
    unloaded = prepare(found.model, [recorded[n] for n in UNLOADED])
    known = fit_by_torque(found.model, unloaded)
    assert known is not None
    halves = [piece for n in LOADED for piece in recorded[n].segments(recorded[n].duration / 2)]
    pieces = prepare(found.model, halves)
    began = time.monotonic()
    loaded = select(
        found.model.with_values(known.values), pieces[0::2], pieces[1::2], carry_out=carry_out
    )
    seconds = time.monotonic() - began
    say(f'\nWith the load that the model does not know ({seconds:.0f} s), by joint of the half '
        'held out:\n')  # fmt: skip
    say('| | ' + ' | '.join(joints) + ' |')
    say('|---|' + '---:|' * len(joints))
    say(row('numbers of the unloaded arm', loaded.stated))
    say(row('identified anew', loaded.identified))
    say(row('with the laws', loaded.extended))
    say('\n| law | numbers | nats | takes of the squared error | or |')
    say('|---|---|---:|---|---|')
    for line in laws_of(loaded):
        say(line)
    if options.picture:
        friction_picture.draw(friction_of(found.model, held), options.picture)
    if options.write:
        options.write.write_text(out.getvalue())


if __name__ == '__main__':
    sys.exit(main())
