"""Carry out an experiment on the live system: `ros2 run cg_bringup experiment NAME --out DIR`.

Starts the simulated hardware, the excitation and the recorder as processes of their own, waits
for the machine to finish, shuts the others down, checks the bag and prints its path.
"""

import argparse
import os
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from cg_bringup.runs import MODES, PATIENCE, Run, experiment_nodes
from cg_bringup.supervisor import ProcessDied, supervised
from cg_description.reading import parse_yaml, read_text
from cg_dynamics.stop_request import Stopped
from cg_interfaces import topics
from cg_sysid.experiments.catalogue import ExperimentError, experiment_names, load_experiment
from cg_sysid.progress import Bars

RATE_HZ = 500.0


@dataclass(frozen=True)
class Recorded:
    """What an experiment left.

    Attributes:
        path: The bag directory.
        counts: Topic -> number of messages.
        seconds: How long the run took.
    """

    path: Path
    counts: dict[str, int]
    seconds: float


def run_experiment(run: Run, on_wait: Callable[[], None] = lambda: None) -> Recorded:
    """Carry out an experiment in processes of their own.

    Args:
        run: What to do.
        on_wait: Called some times a second while waiting.

    Raises:
        ExperimentError: A node failed or the bag is not what it should be; the message ends
            with what the nodes said.
        Stopped: A signal came; the nodes have ended, and the bag holds what there was until then.
    """
    if run.bag.exists():
        raise ExperimentError(f'{run.bag} exists already; recordings are never overwritten')
    run.bag.parent.mkdir(parents=True, exist_ok=True)
    start = time.monotonic()
    with tempfile.TemporaryFile('w+') as log:
        try:
            _carry_out(run, on_wait, log)
            counts = check_counts(run)
        except ExperimentError as error:
            log.seek(0)
            said = log.read().strip()
            raise ExperimentError(f'{run.experiment.name}: {error}\n{said}') from None
    return Recorded(run.bag, counts, time.monotonic() - start)


def _carry_out(run: Run, on_wait: Callable[[], None], log: IO) -> None:
    def progress() -> tuple[int, int]:
        return os.fstat(log.fileno()).st_size, _size(run.bag)

    try:
        with supervised(experiment_nodes(run), log) as supervisor:
            status = supervisor.wait('simulation_node', PATIENCE, on_wait, progress)
            statuses = supervisor.end()
    except (ProcessDied, TimeoutError) as error:
        raise ExperimentError(str(error)) from None
    if status != 0:
        raise ExperimentError(f'the machine gave up with status {status}')
    for name, status in statuses.items():
        if status != 0:
            raise ExperimentError(f'{name} ended with status {status}')


def _size(bag: Path) -> int:
    """Bytes in the files of a bag, which may be on their way."""
    try:
        with os.scandir(bag) as entries:
            return sum(entry.stat().st_size for entry in entries)
    except FileNotFoundError:
        return 0


def check_counts(run: Run) -> dict[str, int]:
    """Messages per topic of the finished bag.

    Raises:
        ExperimentError: There is no complete bag, or samples are missing in it.
    """
    metadata = run.bag / 'metadata.yaml'
    if not metadata.is_file():
        raise ExperimentError(f'{run.bag} was not closed; `recover` makes a bag of it')
    tree = parse_yaml(read_text(metadata), str(metadata))['rosbag2_bagfile_information']
    counts = {
        topic['topic_metadata']['name']: topic['message_count']
        for topic in tree['topics_with_message_count']
    }
    expected = round(run.length * RATE_HZ)
    commands = 0 if run.mode == 'real_time' else expected
    sparing = {topics.TORQUE_COMMAND: commands, topics.EXPERIMENT: 1}
    for topic in (topics.EXPERIMENT, topics.APPLIED_TORQUE, *counts):
        needed = sparing.get(topic, expected)
        if counts.get(topic, 0) < needed:
            raise ExperimentError(
                f'{run.bag}: {counts.get(topic, 0)} messages of {topic}, expected {needed}'
            )
    return counts


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_bringup experiment`."""
    parser = argparse.ArgumentParser(prog='experiment', description=__doc__)
    parser.add_argument('name', help=f'one of {", ".join(experiment_names())}; or a .yaml file')
    parser.add_argument('--model', type=Path, help='simulated: a file or a name [nominal]')
    parser.add_argument('--seed', type=int, default=1, help='of noise and excitation [1]')
    parser.add_argument(
        '--out', type=Path, default=Path('bags'), help='directory that gets the bag [bags]'
    )
    parser.add_argument('--mode', choices=MODES, default='lockstep', help='[lockstep]')
    parser.add_argument('--duration', type=float, help='in s [that of the experiment]')
    options = parser.parse_args(args)
    try:
        experiment = load_experiment(options.name)
        run = Run(
            experiment,
            bag=options.out / f'{experiment.name}_seed{options.seed}',
            model_file=options.model,
            seed=options.seed,
            mode=options.mode,
            duration=options.duration,
        )
        what = f'{experiment.name}, {run.length:g} s'
        print(f'simulated robot {run.model_path.stem}: {what}', flush=True)
        with Bars('experiment') as bars:
            bars(f'recording {run.length:g} s of {experiment.name}', 0, 1)
            recorded = run_experiment(run)
    except ValueError as error:
        print(f'error: {error}', file=sys.stderr)
        return 1
    except Stopped as stopped:
        left = f'; {run.bag} holds what was recorded until then' if run.bag.exists() else ''
        print(f'{stopped}{left}', file=sys.stderr)
        return stopped.status
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        return 130
    messages = sum(recorded.counts.values())
    print(f'{messages} messages, {run.length:g} s recorded in {recorded.seconds:.1f} s')
    print(recorded.path)
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
