"""Carry out an experiment on the live system: `ros2 run cg_bringup experiment NAME --out DIR`.

Starts the simulated hardware, the excitation and the recorder as processes of their own, waits
for the machine to finish, shuts the others down, checks the bag and prints its path. With
`--mode wired` the machine is a real robot that is running (`ros2 run cg_bringup robot`): you are
asked to hold it as the experiment wants it, and an experimenter arms, excites and disarms it.
"""

import argparse
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from cg_bringup.runs import CHECKLISTS, MODES, PATIENCE, WIRED, Run, experiment_nodes
from cg_bringup.supervisor import ProcessDied, supervised
from cg_bringup.wired_experiment import EXPERIMENTER, pose_in_words
from cg_description.reading import parse_yaml, read_text
from cg_dynamics.stop_request import Stopped
from cg_interfaces import topics
from cg_sysid.experiments.catalogue import ExperimentError, experiment_names, load_experiment
from cg_sysid.progress import Bars
from cg_sysid.records.bags import read_raw

RATE_HZ = 500.0  # of a simulated robot
ENOUGH = 0.95  # of the samples of a real robot, whose host misses some


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
            _carry_out(run, _relaying(log, on_wait), log)
            counts = check_counts(run)
        except ExperimentError as error:
            _forget_empty(run.bag)
            log.seek(0)
            said = log.read().strip()
            raise ExperimentError(f'{run.experiment.name}: {error}\n{said}') from None
    return Recorded(run.bag, counts, time.monotonic() - start)


def _carry_out(run: Run, on_wait: Callable[[], None], log: IO) -> None:
    def progress() -> tuple[int, int]:
        return os.fstat(log.fileno()).st_size, _size(run.bag)

    try:
        nodes = experiment_nodes(run)
        machine = next(iter(nodes))
        with supervised(nodes, log) as supervisor:
            status = supervisor.wait(machine, PATIENCE, on_wait, progress)
            statuses = supervisor.end()
    except (ProcessDied, TimeoutError) as error:
        raise ExperimentError(str(error)) from None
    if status != 0:
        raise ExperimentError(f'{machine} gave up with status {status}')
    for name, status in statuses.items():
        if status != 0:
            raise ExperimentError(f'{name} ended with status {status}')


def _relaying(log: IO, on_wait: Callable[[], None]) -> Callable[[], None]:
    """`on_wait`, which also tells the person what the experimenter says meanwhile."""
    told = 0

    def relay() -> None:
        nonlocal told
        # Not by the handle's own place, which is that of the writers.
        text = os.pread(log.fileno(), 65536, told)
        lines = text[: text.rfind(b'\n') + 1]
        told += len(lines)
        for line in lines.decode(errors='replace').splitlines():
            if line.startswith(EXPERIMENTER):
                print(line.removeprefix(EXPERIMENTER), flush=True)
        on_wait()

    return relay


def _forget_empty(bag: Path) -> None:
    """Remove a bag with no experiment in it, or with nothing else: nothing was recorded."""
    metadata = bag / 'metadata.yaml'
    if metadata.is_file():
        heard = {topic for topic, count in _counts_in(metadata).items() if count > 0}
        if topics.EXPERIMENT not in heard or heard == {topics.EXPERIMENT}:
            shutil.rmtree(bag)


def _counts_in(metadata: Path) -> dict[str, int]:
    """Messages per topic, as the metadata of a bag have them."""
    tree = parse_yaml(read_text(metadata), str(metadata))['rosbag2_bagfile_information']
    return {
        topic['topic_metadata']['name']: topic['message_count']
        for topic in tree['topics_with_message_count']
    }


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
    counts = _counts_in(metadata)
    expected = round(run.length * RATE_HZ)
    if run.mode == WIRED:
        rate = read_raw(run.bag).note.get('nominal_rate_hz', RATE_HZ)
        expected = round(ENOUGH * run.length * rate)
    commands = expected if run.mode == 'lockstep' else 0
    sparing = {topics.TORQUE_COMMAND: commands, topics.EXPERIMENT: 1, topics.DRIVE_ENABLED: 0}
    for topic in (topics.EXPERIMENT, topics.APPLIED_TORQUE, *counts):
        needed = sparing.get(topic, expected)
        if counts.get(topic, 0) < needed:
            raise ExperimentError(
                f'{run.bag}: {counts.get(topic, 0)} messages of {topic}, expected {needed}'
            )
    return counts


def ask_for_pose(run: Run, yes: bool) -> None:
    """Have a person hold the robot as the experiment wants it.

    Raises:
        ExperimentError: Nobody answers.
    """
    print('\n'.join(pose_in_words(run.experiment)), flush=True)
    if yes:
        return
    print('Is it so, and is nobody near the legs? [Enter, Ctrl-C: no] ', end='', flush=True)
    if not sys.stdin.readline():
        raise ExperimentError('nobody answers; --yes asks nobody')


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_bringup experiment`."""
    parser = argparse.ArgumentParser(prog='experiment', description=__doc__)
    parser.add_argument('name', help=f'one of {", ".join(experiment_names())}; or a .yaml file')
    parser.add_argument(
        '--model', type=Path,
        help='simulated, or what a real robot is believed to be: a file or a name [nominal]',
    )  # fmt: skip
    parser.add_argument('--seed', type=int, default=1, help='of noise and excitation [1]')
    parser.add_argument(
        '--out', type=Path, default=Path('bags'), help='directory that gets the bag [bags]'
    )
    parser.add_argument(
        '--mode', choices=(*MODES, WIRED), default='lockstep',
        help='clock of the simulated robot; wired: a real robot that is running [lockstep]',
    )  # fmt: skip
    parser.add_argument(
        '--yes', action='store_true', help='wired: the robot is held as it must be'
    )
    parser.add_argument(
        '--checklists', type=Path, default=CHECKLISTS,
        help=f'wired: folder of the records of checklists, which the bag names [{CHECKLISTS}]',
    )  # fmt: skip
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
            checklists=options.checklists.resolve(),
        )
        what = f'{experiment.name}, {run.length:g} s'
        kind = 'real' if run.mode == WIRED else 'simulated'
        print(f'{kind} robot {run.model_path.stem}: {what}', flush=True)
        if run.mode == WIRED:
            ask_for_pose(run, options.yes)
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
