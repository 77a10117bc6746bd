"""What the command lines share: one-line errors, options, tables."""

import argparse
import fnmatch
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape
from rich.table import Table

from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_sysid import parallel
from cg_sysid.checks.loading import Loaded
from cg_sysid.checks.recordings import use_anyway_option
from cg_sysid.deadline import OutOfTime
from cg_sysid.errors import RecordingError
from cg_sysid.records import bags
from cg_sysid.records.record import Record
from cg_sysid.report.wording import (
    event_words,
    left_words,
    replaced_words,
    undetermined_words,
    value_words,
)
from cg_sysid.text import effect_name, number, plain_unit

BAD_INPUT = 2
UNUSABLE = 1
INTERRUPTED = 130

Facts = dict[str, Any]


def run(program: str, work: Callable[[argparse.Namespace], int], options) -> int:
    """Do the work; turn what a user can cause into one line on stderr.

    Args:
        program: Name of the program.
        work: Takes the options, returns the exit code.
        options: Parsed options.
    """
    try:
        return work(options)
    except (ValueError, OSError) as error:
        print(f'{program}: error: {one_line(error)}', file=sys.stderr)
        return BAD_INPUT
    except OutOfTime as early:
        print(f'{program}: {early} before the model was fitted once: there is no answer yet; give '
              'it more time', file=sys.stderr)  # fmt: skip
        return INTERRUPTED
    except KeyboardInterrupt:
        parallel.stop()
        print(f'{program}: interrupted', file=sys.stderr)
        return INTERRUPTED


def one_line(error: BaseException) -> str:
    """The message of an error without line breaks."""
    if isinstance(error, OSError) and error.strerror and error.filename:
        return f'{error.filename}: {error.strerror}'
    return ' '.join(str(error).split()) or type(error).__name__


def common_options(parser: argparse.ArgumentParser) -> None:
    """Options of every program that analyses bags."""
    parser.add_argument('bags', nargs='+', metavar='BAG', help='recordings: bag directories')
    parser.add_argument(
        '--model', required=True, metavar='MODEL',
        help='model: a YAML file, or the name of one that comes along, such as compass_gait_mit',
    )  # fmt: skip
    parser.add_argument(
        '--out', required=True, type=Path, metavar='DIR',
        help='directory for the results; files of an earlier run in it are replaced',
    )  # fmt: skip
    parser.add_argument(
        '--note', metavar='FILE', help='recording note (YAML) for bags that carry none'
    )
    parser.add_argument(
        '--input', choices=('applied', 'command'), dest='torque',
        help='torque that the model is driven with [applied, or the command where there is none]',
    )  # fmt: skip
    use_anyway_option(parser)
    parser.add_argument('--date', help='ISO 8601 date to put into the results [now]')
    parser.add_argument('--quiet', action='store_true', help='no progress, no tables')


def window_option(parser: argparse.ArgumentParser) -> None:
    """Of programs that simulate."""
    parser.add_argument(
        '--window', type=float, metavar='SECONDS',
        help='cut every record into windows [only where the whole cannot be followed]',
    )  # fmt: skip


def search_options(parser: argparse.ArgumentParser) -> None:
    """Of programs that search the library of effects."""
    parser.add_argument(
        '--effects', metavar='A,B', help='try only these effects [the whole library]'
    )
    parser.add_argument('--workers', type=int, help='local processes [one per core]')
    parser.add_argument(
        '--held', '--hold-out', metavar='GLOB',
        help="records to judge on, by name, such as 'spring*_2' [every second recording of a "
        'set-up]',
    )  # fmt: skip


def chosen_effects(text: str | None, model: Model) -> tuple[str, ...] | None:
    """The effects that were asked for; None for the whole library."""
    if text is None:
        return None
    names = tuple(name.strip() for name in text.split(',') if name.strip())
    body = model.mechanism
    known = {effect(body, at).label for effect in LIBRARY.values() for at in effect.sites(body)}
    known |= set(LIBRARY)
    for name in names or ('',):
        if name not in known:
            raise ValueError(
                f'--effects: no effect {name!r}; the library has: {", ".join(sorted(LIBRARY))}'
            )
    return names


def chosen_workers(count: int | None) -> int | None:
    """The number of processes that was asked for."""
    if count is not None and count < 0:
        raise ValueError(f'--workers is {count}; it must not be negative')
    return count


def records_held(pattern: str | None, loaded: Loaded) -> tuple[str, ...] | None:
    """Names of the records that judge, if somebody says which."""
    if not pattern:
        return None
    names = [record.name for record in loaded.records]
    held = tuple(
        n for n in names
        if any(fnmatch.fnmatchcase(x, pattern) for x in (n, loaded.origin[n]))
    )  # fmt: skip
    if not held or len(held) == len(names):
        raise ValueError(
            f'--held {pattern!r} matches {"no" if not held else "every"} record; '
            f'there are: {", ".join(names)}'
        )
    return held


def usable(loaded: Loaded) -> tuple[Record, ...]:
    """The records of what was loaded.

    Raises:
        RecordingError: if no recording is usable, with the reason of the first.
    """
    if not loaded.records:
        first = loaded.left_out[0]
        raise RecordingError(f'no usable recording; {first.path}: {first.reason}')
    return tuple(loaded.records)


def command_words(options: argparse.Namespace, named: Mapping[str, object]) -> list[str]:
    """Arguments that do the same again.

    Args:
        options: The common options.
        named: Option -> value, of one program; None where it was not given.
    """
    words = ['--model', options.model, '--out', str(options.out)]
    for name, value in {**named, '--note': options.note, '--input': options.torque}.items():
        words += [] if value is None else [name, str(value)]
    for finding in options.use_anyway:
        words += ['--use-anyway', finding]
    return [*words, *options.bags]


def load_note(path: str | None) -> dict[str, Any] | None:
    """The recording note of a file; None if no file is named."""
    return bags.load_note(path) if path else None


def print_gain(console: Console, facts: Facts) -> None:
    """Table of the error before and after, beside the noise."""
    if not facts['gain']:
        return
    table = Table('output', 'before', 'after', 'noise floor', 'unit', 'better by', box=None,
                  pad_edge=False, header_style='bold')  # fmt: skip
    for column in table.columns[1:4]:
        column.justify = 'right'
    landings = facts.get('landings') or {'gain': {}}
    after = {f'{channel} after touchdowns': gain for channel, gain in landings['gain'].items()}
    for channel, gain in (facts['gain'] | after).items():
        table.add_row(
            channel, *(number(gain[k]) for k in ('before', 'after', 'noise_floor')),
            plain_unit(gain['unit']), f'{gain["ratio"]:.3g} x' if gain['ratio'] else '',
        )  # fmt: skip
    console.print(table)
    measured = facts.get('gain_from_measured_start')
    if measured and measured['helps']:
        console.print(f'  [bold]also[/] {measured["text"]}', highlight=False)


def print_leftover(console: Console, facts: Facts) -> None:
    """What an error above the noise looks like."""
    for channel, words in left_words(facts).items():
        console.print(f'  [bold]left in {channel}[/]: {words}', highlight=False)
    if facts.get('unmodelled'):
        console.print(f'  [bold]learned[/] {facts["unmodelled"]["label"]}', highlight=False)


def print_causes(console: Console, facts: Facts) -> None:
    """The named causes with their numbers."""
    for cause in facts['causes']:
        numbers = ', '.join(
            f'{name} = {value_words(p)}' for name, p in cause['parameters'].items()
        )
        strength = cause['evidence_nats']
        strength = f'  (evidence {strength:.0f} nats)' if strength is not None else ''
        console.print(f'  [bold]{effect_name(cause["label"])}[/]: {numbers}{strength}')
        for words in (*event_words(cause), *replaced_words(cause), *undetermined_words(cause)):
            console.print(f'    {words}', highlight=False, markup=False)
        for rival in cause['rivals']:
            console.print(f'    or: {effect_name(rival["label"])}')
        if cause['places']:
            console.print(f'    or elsewhere: {", ".join(cause["places"])}')


def print_next(console: Console, facts: Facts) -> None:
    """What to do next."""
    console.print(f'[bold]next[/]  {escape(facts["next"])}', highlight=False)


def print_left_out(facts: Facts) -> None:
    """One line on stderr for each bag that is not used."""
    for entry in facts['unusable']:
        print(f'left out {entry["source"]}: {one_line(ValueError(entry["reason"]))}',
              file=sys.stderr)  # fmt: skip


def print_windows(console: Console, facts: Facts) -> None:
    """One line where records are not integrated whole."""
    if facts['windows']['how'] != 'whole':
        console.print(facts['windows']['text'], highlight=False, markup=False)


def print_steps(console: Console, steps: Mapping[str, int], phases: int) -> None:
    """One line on the steps of a walking robot, where there are any."""
    if steps:
        total = sum(steps.values())
        console.print(
            f'{total} step{"s" * (total != 1)} in {", ".join(steps)}: cut into '
            f'{phases} stance phases', highlight=False,
        )  # fmt: skip


def print_findings(console: Console, findings: Sequence[str], most: int = 8) -> None:
    """Warnings, the first few."""
    for finding in findings[:most]:
        console.print(f'  [yellow]note[/] {finding}')
    if len(findings) > most:
        console.print(f'  [yellow]note[/] and {len(findings) - most} more in the report')
