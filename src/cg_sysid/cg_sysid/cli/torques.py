"""Command line: what do the torques of my robot lack?

    cg torques --model MODEL --out DIR BAG [BAG ...]

For a robot of a URDF. Nothing is simulated, so an arm of six joints has an answer in a minute or
two: how large the torque error of recordings held out is at each joint, and which laws lower it.
Writes DIR/torques.json, DIR/friction.png, and DIR/model.yaml, the model with those laws and with
the numbers that the torques say; `cg diagnose` judges them in simulation.
"""

import argparse
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from cg_description.model_file import write_atomically
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_sysid.checks.loading import Loaded, load_bags
from cg_sysid.cli import common as cli
from cg_sysid.diagnosis.diagnose import split
from cg_sysid.diagnosis.summary import is_determined
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.joint_friction import friction_of
from cg_sysid.parallel import run_all
from cg_sysid.progress import Bars
from cg_sysid.provenance import of_model, provenance
from cg_sysid.report import friction_picture
from cg_sysid.report.diagnosis_file import plain
from cg_sysid.search.torque_judging import MATERIAL, Law
from cg_sysid.search.torque_selection import TorqueSelection, select
from cg_sysid.text import effect_name, listed, measured, number

FORMAT = 'cg_torques/1'
TURNED_DOWN = 3  # that are named, the best of those with any evidence

Facts = dict[str, Any]


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(
        prog='cg torques',
        description='Say which laws the torques of a robot lack, without a simulation.',
        epilog='exit code 0 with an answer, 2 for a wrong argument or recordings that cannot '
        'be used',
    )
    cli.common_options(made)
    cli.search_options(made)
    return made


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run('cg torques', work, parser().parse_args(args))


def work(options: argparse.Namespace) -> int:
    """Read, check, select, write."""
    if options.out.is_file():
        raise ValueError(f'--out {options.out}: a file is in the way; name a directory')
    model_file = model_path(options.model)
    model = Model.load(model_file)
    effects = cli.chosen_effects(options.effects, model)
    workers = cli.chosen_workers(options.workers)
    with Bars('cg torques', options.quiet) as bars:
        loaded = load_bags(
            options.bags, model_file, cli.load_note(options.note), options.torque, None, bars,
            options.use_anyway, whole=True,
        )  # fmt: skip
        records = cli.usable(loaded)
        if len(records) == 1:  # nothing has to be followed from the start of a half
            records = tuple(records[0].segments(records[0].duration / 2))
        train, held = split(prepare(model, records), cli.records_held(options.held, loaded))

        def carry_out(function: Callable, arguments: list[tuple], what: str) -> list:
            return run_all(
                function, arguments, workers, None,
                lambda done, total, _: bars(what, done, total),
            )  # fmt: skip

        found = select(model, train, held, effects, carry_out)
        friction = friction_of(found.model, held)
    origin = provenance(
        model_file,
        ['cg', 'torques', *cli.command_words(options, {
            '--effects': options.effects, '--held': options.held, '--workers': options.workers,
        })],
        {
            'effects': options.effects or 'all', 'held': options.held or 'automatic',
            'input': options.torque or 'automatic', 'note': options.note,
        },
        options.date,
    )  # fmt: skip
    facts = facts_of(found, loaded, [t.name for t in train], [t.name for t in held], origin)
    options.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(facts, indent=1, allow_nan=False, ensure_ascii=False)
    write_atomically(options.out / 'torques.json', text + '\n')
    extended_model(found, model, facts).save(options.out / 'model.yaml')
    friction_picture.draw(friction, options.out / 'friction.png')
    cli.print_left_out(facts)
    show(Console(), found, options.out, options.quiet)
    return 0


def facts_of(
    found: TorqueSelection,
    loaded: Loaded,
    train: Sequence[str],
    held: Sequence[str],
    origin: Facts,
) -> Facts:
    """What torques.json says (diagnosis_json.md)."""
    errors = zip(found.stated, found.identified, found.extended, strict=True)
    return plain({
        'format': FORMAT,
        'joints': {
            joint: {'stated': stated, 'identified': identified, 'extended': extended}
            for joint, (stated, identified, extended) in zip(
                found.coordinates, errors, strict=True
            )
        },
        'laws': [_law_facts(law, found.coordinates) for law in found.laws],
        'turned_down': [_law_facts(law, found.coordinates) for law in found.turned_down],
        'train': train,
        'held': held,
        'unusable': [{'source': s.path, 'reason': s.reason} for s in loaded.left_out],
        'sources': [
            {'name': s.name, 'sha256': s.sha256, 'used': not s.reason} for s in loaded.sources
        ],
        'provenance': origin,
    })  # fmt: skip


def _law_facts(law: Law, joints: Sequence[str]) -> Facts:
    return {
        'label': law.label,
        'evidence_nats': law.nats,
        'significance': law.significance,
        'taken': dict(zip(joints, law.taken, strict=True)),
        'parameters': {
            name: {'value': value, 'sigma': sigma, 'unit': unit}
            for name, (value, sigma, unit) in law.parameters.items()
        },
        'relieves': law.relieves,
        'rivals': law.rivals,
        'reason': law.reason,
    }


def extended_model(found: TorqueSelection, model: Model, facts: Facts) -> Model:
    """The model with the laws in it; its provenance says where it comes from."""
    used = [source for source in facts['sources'] if source['used']]
    laws = [law.label for law in found.laws]
    return replace(
        found.model,
        provenance=of_model('torques', facts['provenance'], model.provenance, used, laws=laws),
    )


def show(console: Console, found: TorqueSelection, directory: Path, quiet: bool) -> None:
    """Print the answer for people."""
    count = len(found.laws)
    said = (
        f'{count} law{"s" * (count > 1)} that the model lacks lower{"s" * (count == 1)}'
        if count else 'no law of the library lowers'
    )  # fmt: skip
    console.print(f'[bold]torques[/]  {said} the torque error of recordings held out',
                  highlight=False)  # fmt: skip
    if not quiet:
        for law in found.laws:
            _show_law(console, law, found.shares(law))
        for law in [law for law in found.turned_down if law.nats > 0][:TURNED_DOWN]:
            console.print(
                f'  not taken up: {effect_name(law.label)}: {law.reason}', highlight=False
            )
        console.print(_table(found), highlight=False)
    console.print(
        f'[bold]next[/]  judge this in simulation: cg diagnose --model {directory / "model.yaml"} '
        'with the same recordings', highlight=False, soft_wrap=True,
    )  # fmt: skip
    console.print(f'picture: {directory / "friction.png"}', highlight=False, soft_wrap=True)


def _show_law(console: Console, law: Law, shares: Mapping[str, float]) -> None:
    numbers = ', '.join(
        f'{name} = {measured(*told)}'
        if is_determined(law.label, name, told[1]) else f'{name} not determined'
        for name, told in law.parameters.items()
    )  # fmt: skip
    console.print(
        f'  [bold]{effect_name(law.label)}[/]: {numbers}  (evidence {law.nats:.0f} nats)',
        highlight=False,
    )
    at = [f'{share:.0%} at {joint}' for joint, share in shares.items()]
    if at:
        takes = f'of the squared error: {listed(at)}'
    elif law.relieves:
        takes = 'the place of numbers off belief'
    else:
        takes = f'less than {MATERIAL:.0%} of the squared error, as every joint has some'
    console.print(f'    takes {takes}', highlight=False)
    for rival in law.rivals:
        console.print(f'    or: {effect_name(rival)}', highlight=False)


def _table(found: TorqueSelection) -> Table:
    table = Table('torque error over torque', 'file', 'identified', 'with the laws', box=None,
                  pad_edge=False, header_style='bold')  # fmt: skip
    for column in table.columns[1:]:
        column.justify = 'right'
    errors = zip(found.stated, found.identified, found.extended, strict=True)
    for joint, values in zip(found.coordinates, errors, strict=True):
        table.add_row(joint, *(number(float(v)) for v in values))
    return table


if __name__ == '__main__':
    sys.exit(main())
