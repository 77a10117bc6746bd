"""Command line: the parameters of a model from recordings.

    cg identify --model MODEL --out DIR BAG [BAG ...]

Writes DIR/identification.json, DIR/model.yaml, DIR/report.html and DIR/curves.npz.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console
from rich.table import Table

from cg_description.paths import model_path
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_sysid.checks.loading import Loaded, load_bags
from cg_sysid.cli import common as cli
from cg_sysid.identification.data_set import DataSet, prepare
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.identify import fit, predict, score
from cg_sysid.identification.nelder_mead import nelder_mead
from cg_sysid.identification.unknowns import IdentificationError
from cg_sysid.progress import Bars
from cg_sysid.provenance import of_model, provenance
from cg_sysid.report import curves, write_report
from cg_sysid.report.diagnosis_file import Facts, write_facts
from cg_sysid.report.facts import identification_facts
from cg_sysid.text import measured, number, plain_unit

METHODS: dict[str, Callable[..., Fit]] = {'gauss_newton': fit, 'nelder_mead': nelder_mead}


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(
        prog='cg identify',
        description='Identify the parameters of a model from recordings, by simulation error.',
        epilog='exit code 0 with an answer, 2 for a wrong argument or recordings that cannot '
        'be used',
    )
    cli.common_options(made)
    cli.window_option(made)
    made.add_argument(
        '--only', metavar='A,B', help='full names of the parameters to identify [all free ones]'
    )
    made.add_argument(
        '--method', choices=tuple(METHODS), default='gauss_newton',
        help='gauss_newton (default), or the simplex search that it is compared with',
    )  # fmt: skip
    return made


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run('cg identify', work, parser().parse_args(args))


def work(options: argparse.Namespace) -> int:
    """Read, check, identify, write."""
    if options.out.is_file():
        raise ValueError(f'--out {options.out}: a file is in the way; name a directory')
    model_file = model_path(options.model)
    model = Model.load(model_file)
    note = cli.load_note(options.note)
    only = tuple(n.strip() for n in options.only.split(',')) if options.only else None
    with Bars('cg identify', options.quiet) as bars:
        loaded = load_bags(
            options.bags,
            model_file,
            note,
            options.torque,
            options.window,
            bars,
            options.use_anyway,
        )
        data_sets = prepare(model, cli.usable(loaded))
        found = METHODS[options.method](model, data_sets, only=only, progress=bars)
        bars('writing the report', 0, 1)
        before = _score(model, data_sets)
        origin = provenance(
            model_file,
            ['cg', 'identify', *cli.command_words(options, {
                '--method': options.method, '--only': options.only, '--window': options.window,
            })],
            {
                'method': options.method, 'only': list(only) if only else 'all free',
                'window_s': options.window, 'input': options.torque or 'automatic',
                'note': options.note,
            },
            options.date,
        )  # fmt: skip
        lines = _curves(model, before, found, data_sets)
        facts = identification_facts(
            model, found, before, data_sets, loaded, options.method, origin, lines
        )
        options.out.mkdir(parents=True, exist_ok=True)
        write_facts(facts, options.out)
        faults = [signal for source in loaded.sources for signal in source.signals]
        curves.save(lines, options.out, faults)
        identified_model(model, found, facts, loaded).save(options.out / 'model.yaml')
        write_report(options.out)
        bars('writing the report', 1, 1)
    cli.print_left_out(facts)
    cli.print_steps(Console(), loaded.steps, loaded.phases)
    cli.print_windows(Console(), facts)
    show(Console(), facts, options.out, options.quiet)
    return 0


def _score(model: Model, data_sets: Sequence[DataSet]) -> Fit | None:
    """How well the model as given simulates the records; None where it runs away."""
    try:
        found = score(model, data_sets)
        for data_set, motion in zip(data_sets, found.motions, strict=True):
            predict(model, data_set, motion)
    except (IdentificationError, DynamicsError):
        return None
    return found


def _curves(
    model: Model, before: Fit | None, found: Fit, data_sets: Sequence[DataSet]
) -> list[curves.Curve]:
    start, base = (model, before) if before else (found.model, found)
    return [
        curves.make_curve(data_set, 'all', start, base.motions[k], found.model, found.motions[k])
        for k, data_set in enumerate(data_sets)
    ]


def identified_model(model: Model, found: Fit, facts: Facts, loaded: Loaded) -> Model:
    """The model with the identified values; its provenance says where it comes from."""
    used = [{'name': s.name, 'sha256': s.sha256} for s in loaded.sources if not s.reason]
    return replace(
        found.model,
        provenance=of_model(
            'identify', facts['provenance'], model.provenance, used, method=facts['method']
        ),
    )


def show(console: Console, facts: Facts, directory: Path, quiet: bool) -> None:
    """Print the answer for people."""
    console.print(f'[bold green]identified[/]  {facts["summary"]}', highlight=False)
    if not quiet:
        table = Table('parameter', 'file', 'identified', 'unit', 'from data', box=None,
                      pad_edge=False, header_style='bold')  # fmt: skip
        for p in facts['parameters']:
            if p['fixed']:
                continue
            share = p['information']
            share = '' if share is None or share != share else f'{100 * share:.0f} %'
            table.add_row(
                p['name'], number(p['nominal'], 4), measured(p['identified'], p['sigma']),
                plain_unit(p['unit']), share,
            )  # fmt: skip
        console.print(table, highlight=False)
        cli.print_gain(console, facts)
        cli.print_findings(console, facts['findings'])
    cli.print_next(console, facts)
    console.print(f'report: {directory / "report.html"}', highlight=False, soft_wrap=True)


if __name__ == '__main__':
    sys.exit(main())
