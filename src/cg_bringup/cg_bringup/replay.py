"""An estimator over a recording: `ros2 run cg_bringup replay BAG --epsilon 0.02 --out states.csv`.

The estimator is the one that the observer node runs, with the same settings by the same names; a
row of the table is what the node would have published for that measurement.
"""

import argparse
import dataclasses
import sys
from pathlib import Path

import numpy as np

from cg_description.model_file import write_atomically
from cg_dynamics.model import Model
from cg_estimation.estimator import replay
from cg_estimation.observer_settings import ObserverSettings, make_estimator
from cg_hardware.simulation import model_file_of
from cg_sysid.records.bags import read_bag
from cg_sysid.records.record import Record


def replay_record(
    record: Record, settings: ObserverSettings
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Stamps in ns (n,), estimated states (n, nx) and their names, for every measurement.

    Raises:
        ValueError: The record is not of a compass gait with both legs free.
    """
    model = Model.load(model_file_of(settings.model_file))
    estimator = make_estimator(settings, model, record.setup)
    measured = ~np.all([np.isnan(values) for values in record.outputs.values()], axis=0)
    states = replay(
        estimator,
        record.stamp_ns[measured],
        record.inputs['hip_torque'][measured],
        {channel: values[measured] for channel, values in record.outputs.items()},
        record.setup.stance,
    )
    return record.stamp_ns[measured], states, estimator.state_names


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_bringup replay`."""
    parser = argparse.ArgumentParser(prog='replay', description=__doc__)
    parser.add_argument('bag')
    parser.add_argument('--out', type=Path, default=Path('states.csv'), help='[states.csv]')
    for field in dataclasses.fields(ObserverSettings):
        kind = type(field.default)
        if kind is bool:
            parser.add_argument(f'--{field.name}', action='store_true')
        else:
            parser.add_argument(f'--{field.name}', type=kind, default=field.default)
    given = vars(parser.parse_args(args))
    bag, out = given.pop('bag'), given.pop('out')
    try:
        stamps, states, names = replay_record(read_bag(bag), ObserverSettings(**given))
    except (ValueError, OSError) as error:
        print(f'replay: error: {error}', file=sys.stderr)
        return 2
    lines = [','.join(['stamp_ns', *names])]
    lines += [
        ','.join([str(stamp), *(f'{value:.9g}' for value in x)])
        for stamp, x in zip(stamps, states, strict=True)
    ]
    write_atomically(out, '\n'.join(lines) + '\n')
    print(out)
    return 0


if __name__ == '__main__':
    raise SystemExit(main())
