"""Command line: record an experiment on a simulated robot, in this process and without ROS.

    cg rehearse EXPERIMENT [--model MODEL] [--out BAGS] [--seed N] [--duration SECONDS]

The signals are those that the live system records in lock-step with the same model and seed
(`./cg run cg_bringup experiment`), less the foot contacts.
"""

import argparse
import hashlib
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_sysid.cli import common as cli
from cg_sysid.experiments.catalogue import (
    Experiment,
    ExperimentError,
    experiment_names,
    load_experiment,
)
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.progress import Bars
from cg_sysid.provenance import software
from cg_sysid.records.bag_writer import write_bag
from cg_sysid.records.record import Record

JOINT_SEEDS = 1000  # between the excitations of the joints of one machine, as in excitation_node
ZEROED_AT = '1970-01-01T00:00:00Z'  # simulated time begins then


def parser() -> argparse.ArgumentParser:
    """The options."""
    made = argparse.ArgumentParser(
        prog='cg rehearse',
        description='Record an experiment on a simulated robot, without ROS and without a robot.',
    )
    made.add_argument('name', help=f'one of {", ".join(experiment_names())}; or a .yaml file')
    made.add_argument(
        '--model', default=NOMINAL_MODEL, help='simulated: a model file or a name [%(default)s]'
    )
    made.add_argument('--seed', type=int, default=1, help='of noise and excitation [1]')
    made.add_argument(
        '--out', type=Path, default=Path('bags'), help='directory that gets the bag [bags]'
    )
    made.add_argument('--duration', type=float, help='in s [that of the experiment]')
    return made


def main(args: Sequence[str] | None = None) -> int:
    """Entry point; returns the exit code."""
    return cli.run('cg rehearse', work, parser().parse_args(args))


def work(options: argparse.Namespace) -> int:
    """Simulate and write."""
    experiment = load_experiment(options.name)
    if options.duration is not None:
        experiment = replace(experiment, duration=options.duration)
    path = options.out / f'{experiment.name}_seed{options.seed}'
    if path.exists():
        raise ExperimentError(f'{path} exists already; recordings are never overwritten')
    with Bars('cg rehearse') as bars:
        bars(f'simulating {experiment.duration:g} s of {experiment.name}', 0, 1)
        record = rehearsal(experiment, model_path(options.model), options.seed)
        write_bag(path, record)
    print(f'{path}: {len(record)} rows, {record.duration:.2f} s, simulated')
    return 0


def rehearsal(experiment: Experiment, model_file: Path, seed: int) -> Record:
    """The record of an experiment on the simulated robot of a model file.

    Args:
        experiment: What is done.
        model_file: Of the robot.
        seed: Of noise and excitation.

    Raises:
        ValueError: The robot cannot be put to this experiment, or a setting is out of range.
    """
    model = Model.load(model_file)
    signals = [
        make_signal(
            ExcitationSettings(
                **experiment.excitation,
                duration=experiment.duration,
                seed=seed + JOINT_SEEDS * index,
            )
        )
        for index in range(len(model.mechanism.inputs))
    ]
    record = rehearse(
        experiment.name, model, experiment.setup, experiment.initial_state, signals,
        experiment.duration, seed=seed,
    )  # fmt: skip
    rates = experiment.initial_state[len(experiment.initial_state) // 2 :]
    note = {
        **record.note,
        'initial_state': 'moving' if any(rates) else 'rest',
        'sensor_zeros': {
            name: 0.0
            for name in record.outputs
            if model.mechanism.output_unit(name) in ('rad', 'm')
        },
        'zeroed_at': ZEROED_AT,
        'model_file': model_file.name,
        'model_sha256': hashlib.sha256(model_file.read_bytes()).hexdigest(),
        'software': f'cg_sysid {software()["cg_sysid"]}',
        'notes': 'simulated by cg rehearse',
    }
    return replace(record, note=note)


if __name__ == '__main__':
    sys.exit(main())
