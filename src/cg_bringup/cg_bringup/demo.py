"""The demonstration: a machine with a secret, five experiments, one diagnosis.

`ros2 run cg_bringup demo` draws an effect and other lumps, hides them in the simulated hardware,
carries out experiments on the live system, hands the bags and the nominal model, and nothing
else, to the analysis in a process of its own, prints its verdict, and only then what was hidden.
"""

import argparse
import shutil
import tempfile
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from cg_bringup.experiment import run_experiment
from cg_bringup.hidden import Hidden, hide
from cg_bringup.runs import Run
from cg_bringup.supervisor import Supervisor
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_dynamics.stop_request import Stopped, stopped_by_signals
from cg_interfaces.domains import own_domain
from cg_sysid.experiments.catalogue import ExperimentError, load_experiment
from cg_sysid.progress import Bars
from cg_sysid.report.diagnosis_file import read_facts

# The last repeats the first with another excitation.
PROGRAMME = (
    'spring_stabilised_inner',
    'spring_stabilised_outer',
    'swing_inner_fixed',
    'swing_outer_fixed',
    'spring_stabilised_inner',
)
DURATION = 12.0  # s


def record_programme(
    console: Console, machine: Path, nominal: Path, out: Path, seed: int, duration: float
) -> list[Path]:
    """Carry out the experiments; return the bags."""
    bags = []
    # On a terminal the status says the same.
    with own_domain() as domain, Bars('demo', quiet=console.is_terminal) as bars:
        console.print(
            f'[bold]Recording[/] {len(PROGRAMME)} x {duration:g} s (ROS domain {domain})'
        )
        for index, name in enumerate(PROGRAMME, start=1):
            experiment = load_experiment(name)
            bag = out / f'{index}_{name}'
            run = Run(
                experiment,
                bag=bag,
                model_file=machine,
                note_model_file=nominal,
                seed=100 * seed + index,
                duration=duration,
            )
            bars('recording experiments on the simulated robot', index - 1, len(PROGRAMME))
            with console.status(f'{index}/{len(PROGRAMME)} {name}'):
                recorded = run_experiment(run)
            messages = sum(recorded.counts.values())
            console.print(f'  {bag.name}: {messages} messages in {recorded.seconds:.1f} s')
            bags.append(bag)
    return bags


def diagnose(
    console: Console, nominal: Path, bags: list[Path], out: Path, candidates: str = ''
) -> dict[str, Any]:
    """Run the analysis in a process of its own, which says what it finds; return that.

    Raises:
        ExperimentError: It failed.
    """
    analysis = ['cg_sysid.cli.diagnose', '--model', str(nominal), '--out', str(out)]
    analysis += ['--effects', candidates] if candidates else []
    console.print('[bold]Diagnosing[/] from these bags and the nominal model, nothing else')
    start = time.monotonic()
    with Supervisor({'analysis': [*analysis, *map(str, bags)]}) as supervisor:
        status = supervisor.wait('analysis')
    result = out / 'diagnosis.json'
    if status != 0 or not result.is_file():
        raise ExperimentError(f'the analysis ended with status {status}')
    console.print(f'({time.monotonic() - start:.1f} s)')
    return read_facts(out)


def reveal(console: Console, nominal: Model, hidden: Hidden) -> None:
    """Say what had been hidden."""
    units = {p.name: p.unit for p in hidden.model.effect(hidden.effect).parameters}
    values = ', '.join(
        f'{name} {value:.4g} {units[name] if units[name] != "1" else ""}'.rstrip()
        for name, value in hidden.values.items()
    )
    console.print(f'\n[bold]What had been hidden:[/] {hidden.effect} ({values})')
    table = Table('parameter', 'nominal', 'true', 'off by', title='and these numbers were off')
    for name, factor in hidden.factors.items():
        value = nominal.values[name]
        table.add_row(
            name, f'{value:.4g}', f'{value * factor:.4g}', f'{100 * (factor - 1):+.0f} %'
        )
    console.print(table)


def run_demo(
    effect: str | None,
    seed: int,
    out: Path,
    duration: float,
    console: Console,
    candidates: str = '',
) -> dict[str, Any]:
    """The whole demonstration; returns the diagnosis.

    Args:
        effect: To hide; None draws one.
        seed: Of everything that is drawn.
        out: Directory for bags and report.
        duration: Of each record in s.
        console: Takes what is said.
        candidates: Effects that the analysis tries, with commas; empty for the whole library.

    Raises:
        ValueError: Something did not go through; the message says what.
    """
    if out.exists() and any(out.iterdir()):
        raise ExperimentError(f'{out} is not empty; name another directory with --out')
    start = time.monotonic()
    robot = Model.load(model_path(NOMINAL_MODEL))
    hidden = hide(robot, effect, seed)
    out.mkdir(parents=True, exist_ok=True)
    nominal_path = out / 'nominal.yaml'
    hidden.nominal.save(nominal_path)
    # Out of the way of the analysis until it has spoken.
    with tempfile.TemporaryDirectory(prefix='cg_machine_') as directory:
        machine = Path(directory) / 'machine.yaml'
        hidden.model.save(machine)
        bags = record_programme(console, machine, nominal_path, out / 'bags', seed, duration)
        found = diagnose(console, nominal_path, bags, out, candidates)
        shutil.copy(machine, out / 'hidden_machine.yaml')
    reveal(console, robot, hidden)
    console.print(f'\nReport: {out / "report.html"}\nModel:  {out / "model.yaml"}')
    console.print(f'Bags:   {out / "bags"}   ({time.monotonic() - start:.0f} s in all)')
    return found


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_bringup demo`."""
    parser = argparse.ArgumentParser(prog='demo', description=__doc__)
    parser.add_argument('--effect', help='effect to hide [drawn from the seed]')
    parser.add_argument('--seed', type=int, help='of everything that is drawn [from the clock]')
    parser.add_argument('--out', type=Path, help='directory for bags and report [demo_<seed>]')
    parser.add_argument(
        '--duration', type=float, default=DURATION, help=f'of each record in s [{DURATION:g}]'
    )
    parser.add_argument(
        '--candidates', default='', help='effects that the analysis tries [the whole library]'
    )
    options = parser.parse_args(args)
    seed = time.time_ns() % 10000 if options.seed is None else options.seed
    out = options.out or Path(f'demo_{seed}')
    console = Console(highlight=False)
    console.print(f'[bold]Demonstration[/], seed {seed}: a machine with a secret')
    try:
        with stopped_by_signals():
            run_demo(options.effect, seed, out, options.duration, console, options.candidates)
    except (ValueError, RuntimeError, OSError) as error:
        console.print(f'error: {error}', markup=False, style='red')
        return 1
    except Stopped as stopped:
        console.print(str(stopped))
        return stopped.status
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
