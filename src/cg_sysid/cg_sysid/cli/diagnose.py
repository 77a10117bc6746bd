"""Command line: what does my simulation get wrong about these recordings, and why?

    cg diagnose --model MODEL --out DIR BAG [BAG ...]

Writes DIR/diagnosis.json, DIR/report.html, DIR/curves.npz and, where records could be used,
DIR/model.yaml: the model with the causes in it. What no cause explains is in DIR/learned.yaml: the
same model with a learned term.

An answer comes within the budget. Until the search is done, DIR/fits holds where its fits came to:
the same command with more time goes on from there.
"""

import argparse
import math
import shutil
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_sysid.checks.faults import FaultSignal
from cg_sysid.checks.loading import Loaded, load_bags
from cg_sysid.cli import common as cli
from cg_sysid.cluster import Cluster
from cg_sysid.deadline import Deadline
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Diagnosis, Options
from cg_sysid.experiments.catalogue import experiments_for
from cg_sysid.identification.joint_friction import drives_without_friction
from cg_sysid.progress import Bars
from cg_sysid.provenance import of_model, provenance
from cg_sysid.report import curves, write_report
from cg_sysid.report.diagnosis_file import Facts, write_facts
from cg_sysid.report.facts import diagnosis_facts, unusable_facts

MODEL = 'model.yaml'
LEARNED = 'learned.yaml'
FITS = 'fits'
BUDGET = 120.0  # s
COLOURS = {
    'consistent': 'green', 'explained': 'green', 'ambiguous': 'yellow', 'unexplained': 'magenta',
    'unfinished': 'magenta', 'unusable': 'red',
}  # fmt: skip
EPILOG = """\
verdicts:
  consistent    the model explains the recordings down to the noise of the sensors
  explained     named causes are missing from the model
  ambiguous     causes that these recordings cannot tell apart
  unexplained   something is missing that no effect of the library explains
  unfinished    the search was broken off before it found what explains most of the error
  unusable      the recordings themselves are broken (exit code 1)

Ctrl-C ends the search with the best answer so far, as the end of the budget does. The same
command with a larger --budget goes on from there.

exit code 0 with an answer, 1 if the recordings are unusable, 2 for a wrong argument
"""


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(
        prog='cg diagnose',
        description='Say what a simulation gets wrong about recordings, name the cause, and '
        'show how much better the model is with that cause in it.',
        epilog=EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    cli.common_options(made)
    cli.window_option(made)
    cli.search_options(made)
    made.add_argument(
        '--rounds', type=int, default=Options.rounds, help='most effects to add [%(default)s]'
    )
    made.add_argument(
        '--budget', type=float, default=BUDGET, metavar='SECONDS',
        help='end the search after this time with the best answer so far; inf for no limit '
        '[%(default)g]',
    )  # fmt: skip
    made.add_argument(
        '--scheduler', metavar='ADDRESS',
        help='fit on the workers of this dask scheduler instead, such as tcp://127.0.0.1:8786',
    )  # fmt: skip
    return made


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run('cg diagnose', work, parser().parse_args(args))


def _print_torques_first(model: Model, quiet: bool) -> None:
    """That another command is quicker where a robot's file knows the bodies and little else."""
    silent = drives_without_friction(model)
    if len(silent) > 1 and not quiet:
        print(
            f'cg diagnose: the model has no friction at {", ".join(silent)}; let `cg torques` say '
            'how much first, as a diagnosis adds one effect at a time', file=sys.stderr,
        )  # fmt: skip


def work(options: argparse.Namespace) -> int:
    """Read, check, diagnose, write."""
    if options.rounds < 1:
        raise ValueError(f'--rounds is {options.rounds}; at least 1 is needed')
    if not options.budget > 0:
        raise ValueError(
            f'--budget is {options.budget:g}; it must be positive (s), inf is allowed'
        )
    deadline = Deadline(options.budget)
    if cli.chosen_workers(options.workers) is not None and options.scheduler is not None:
        raise ValueError('--workers are local processes; leave it out where --scheduler is given')
    if options.out.is_file():
        raise ValueError(f'--out {options.out}: a file is in the way; name a directory')
    model_file = model_path(options.model)
    model = Model.load(model_file)
    effects = cli.chosen_effects(options.effects, model)
    note = cli.load_note(options.note)
    _print_torques_first(model, options.quiet)
    fitters = Cluster(options.scheduler) if options.scheduler is not None else nullcontext()
    with fitters as executor, Bars('cg diagnose', options.quiet) as bars:
        loaded = load_bags(
            options.bags,
            model_file,
            note,
            options.torque,
            options.window,
            bars,
            options.use_anyway,
        )
        origin = provenance(
            model_file,
            ['cg', 'diagnose', *cli.command_words(options, _own_options(options))],
            {
                'effects': options.effects or 'all', 'rounds': options.rounds,
                'budget_s': options.budget if math.isfinite(options.budget) else None,
                'window_s': options.window, 'held': options.held or 'automatic',
                'input': options.torque or 'automatic', 'note': options.note,
            },
            options.date,
        )  # fmt: skip
        if _too_few(loaded):
            facts, lines = unusable_facts(model, loaded, _why(loaded), origin), []
            answer = None
        else:
            with deadline.interruptible('cg diagnose'):
                answer = diagnose(
                    model,
                    loaded.records,
                    _options(options, effects, loaded, model),
                    bars,
                    executor,
                    loaded.landings,
                    deadline,
                )
            lines = diagnosis_curves(answer)
            facts = diagnosis_facts(answer, loaded, origin, lines)
        options.out.mkdir(parents=True, exist_ok=True)
        bars('writing the report', 0, 1)
        faults = [signal for source in loaded.sources for signal in source.signals]
        write_results(options.out, facts, lines, faults, answer)
        bars('writing the report', 1, 1)
    if answer is not None and answer.unfinished is None:
        shutil.rmtree(options.out / FITS, ignore_errors=True)
    cli.print_left_out(facts)
    cli.print_steps(Console(), loaded.steps, loaded.phases)
    cli.print_windows(Console(), facts)
    show(Console(), facts, options.out, options.quiet)
    return cli.UNUSABLE if facts['verdict'] == 'unusable' else 0


def _own_options(options: argparse.Namespace) -> dict[str, object]:
    default = options.rounds == Options.rounds
    return {
        '--effects': options.effects, '--held': options.held, '--window': options.window,
        '--workers': options.workers, '--scheduler': options.scheduler,
        '--rounds': None if default else options.rounds,
        '--budget': None if options.budget == BUDGET else f'{options.budget:g}',
    }  # fmt: skip


def _too_few(loaded: Loaded) -> bool:
    # One good record alone is not enough either, but then it is not the recordings' fault.
    return not loaded.records or (len(loaded.records) == 1 and bool(loaded.left_out))


def _why(loaded: Loaded) -> str:
    total, bad = len(loaded.sources), len(loaded.left_out)
    if bad == total:
        which = 'The recording is' if total == 1 else f'All {total} recordings are'
    else:
        which = f'{bad} of {total} recordings {"is" if bad == 1 else "are"}'
    first = loaded.left_out[0]
    return f'{which} broken, and nothing was fitted. {first.name}: {first.reason}.'


def _options(
    options: argparse.Namespace, effects: tuple[str, ...] | None, loaded: Loaded, model: Model
) -> Options:
    return Options(
        effects=effects, rounds=options.rounds, workers=options.workers,
        held=cli.records_held(options.held, loaded), experiments=tuple(experiments_for(model)),
        kept=options.out / FITS, wholes=loaded.wholes,
    )  # fmt: skip


def diagnosis_curves(answer: Diagnosis) -> list[curves.Curve]:
    """Measured and simulated signals of every record, those held out first."""
    before, after = answer.baseline, answer.extended
    found = []
    for role, data_sets, a, b in (
        ('held', answer.held, before.held, after.held),
        ('train', answer.train, before.train, after.train),
    ):
        for k, data_set in enumerate(data_sets):
            found.append(
                curves.make_curve(
                    data_set, role, before.model, a.motions[k], after.model, b.motions[k]
                )
            )
    return found


def write_results(
    directory: Path,
    facts: Facts,
    lines: list[curves.Curve],
    faults: list[FaultSignal],
    answer: Diagnosis | None,
) -> None:
    """Everything that a diagnosis leaves behind."""
    write_facts(facts, directory)
    curves.save(lines, directory, faults)
    models = {} if answer is None else {MODEL: extended_model(answer, facts)}
    if answer is not None and answer.unmodelled is not None:
        learned = answer.unmodelled.fit.model
        models[LEARNED] = replace(learned, provenance=models[MODEL].provenance)
    for name in (MODEL, LEARNED):
        if name in models:
            models[name].save(directory / name)
        else:
            (directory / name).unlink(missing_ok=True)
    write_report(directory)


def extended_model(answer: Diagnosis, facts: Facts) -> Model:
    """The model with the causes in it; its provenance says where it comes from."""
    used = [source for source in facts['sources'] if source['used']]
    return replace(
        answer.model,
        provenance=of_model(
            'diagnose', facts['provenance'], answer.nominal.provenance, used,
            verdict=str(answer.verdict),
            numbers_from='all records' if answer.from_all else 'the training records',
            causes=[cause.label for cause in answer.causes],
        ),
    )  # fmt: skip


def show(console: Console, facts: Facts, directory: Path, quiet: bool) -> None:
    """Print the answer for people."""
    verdict = facts['verdict']
    so_far = ' so far' if facts['unfinished'] and verdict != 'unfinished' else ''
    console.print(
        f'[bold {COLOURS[verdict]}]{verdict}{so_far}[/]  {facts["summary"]}', highlight=False
    )
    if not quiet:
        cli.print_causes(console, facts)
        cli.print_gain(console, facts)
        cli.print_leftover(console, facts)
        cli.print_findings(console, facts['findings'])
    if facts['unfinished']:
        console.print(
            '  [yellow]note[/] the same command with a larger --budget goes on from here'
        )
    cli.print_next(console, facts)
    console.print(f'report: {directory / "report.html"}', highlight=False, soft_wrap=True)


if __name__ == '__main__':
    sys.exit(main())
