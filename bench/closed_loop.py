"""What records of the balancing loop are worth for identification: seed 4.2.3, with numbers.

    python bench/closed_loop.py        writes bench/results/closed_loop.md        (1 min)

The same robot, 20 s of it balancing (pushed every 2 s) and 20 s of it on springs under a
multisine, both cut into windows of 1 s, both identified with the rigid model from the same wrong
start. The robot is once exactly the rigid model with real sensors, once the flexible, late one.
"""

import dataclasses
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cg_bringup.balancing import balance, record_of
from cg_control.balancing.balance import BalanceController, BalanceSettings, balance_gains
from cg_description.model_file import write_atomically
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup
from cg_estimation.high_gain import HighGainObserver
from cg_sysid.checks.recordings import check_recording
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit, score
from cg_sysid.records.bags import read_raw, write_bag
from cg_sysid.records.record import Record

RESULT = Path(__file__).resolve().parent / 'results' / 'closed_loop.md'
RIGID = Model.load(model_path('compass_gait_mit'))
FLEXIBLE = Model.load(model_path('compass_gait_flexible'))
T, LENGTH, WINDOW = 0.002, 20.0, 1.0
SHOWN = ('c1', 'c2', 'c4', 'c5', 'viscous_friction.coefficient', 'coulomb_friction.torque')
START = {'c1': 0.108, 'c2': 0.131, 'c4': 0.107, 'c5': 0.118,
         'viscous_friction.coefficient': 0.8, 'coulomb_friction.torque': 1.6}  # fmt: skip


def balancing(robot: Model) -> Record:
    setup, settings = Setup(stance='inner'), BalanceSettings()
    controller = BalanceController(RIGID, settings, balance_gains(RIGID, settings, T))
    plant = Plant(robot, setup, np.array([0.04, 0.04, 0.0, 0.0]), T, seed=21)
    pushes = [(2.0 * k + 0.99, 0.5 * (-1) ** k) for k in range(10)]
    run = balance(plant, HighGainObserver(RIGID, setup, 0.1), controller, LENGTH, pushes)
    assert run.upright(LENGTH)
    return record_of('balancing', run, setup)


def on_springs(robot: Model, seed: int) -> Record:
    signal = make_signal(
        ExcitationSettings(kind='multisine', amplitude=5.0, duration=LENGTH, seed=seed)
    )
    setup = load_experiment('spring_stabilised_inner').setup
    return rehearse('springs', robot, setup, [0.1, 0.3, 0.0, 0.0], [signal], LENGTH, T, seed)


def check_says(record: Record, note: dict) -> str:
    """Whether `check` warns: of the recording as the machine notes it, and without that note."""
    return ' / '.join(_warns(dataclasses.replace(record, note=n)) for n in (note, {}))


def _warns(record: Record) -> str:
    with tempfile.TemporaryDirectory() as folder:
        raw = read_raw(write_bag(Path(folder) / 'bag', record))
        found = [f for f in check_recording(raw).findings if f.code == 'closed_loop']
    return 'warns' if found else 'silent'


def rows(name: str, robot: Model) -> Iterator[str]:
    start = RIGID.with_values(START)
    held_out = prepare(RIGID, on_springs(robot, 99).segments(WINDOW))
    for record in (balancing(robot), on_springs(robot, 5)):
        windows = record.segments(WINDOW)
        if record.name == 'balancing':
            # A push is not in any model: the window that has one is left out, of both sets.
            note = {'closed_loop': True}
            windows = [w for k, w in enumerate(windows) if k % 2 == 1]
        else:
            note, windows = {'closed_loop': False}, windows[1::2]
        found = fit(start, prepare(RIGID, windows))
        errors = [found.model.values[n] / RIGID.values[n] - 1 for n in SHOWN]
        test = score(found.model, held_out)
        rms = np.sqrt(np.mean(test.mse, axis=0))
        cells = [name, record.name, check_says(record, note), *(f'{100 * e:+.1f}' for e in errors)]
        cells += [f'{rms[0]:.1f}', f'{rms[2]:.1f}']
        yield '| ' + ' | '.join(cells) + ' |'


def table() -> Iterator[str]:
    yield '# Identification from closed-loop records'
    yield ''
    yield (
        '`python bench/closed_loop.py`. Error of the identified values in % of the truth; error '
        'of the simulation on held-out records on springs in multiples of the noise floor.'
    )
    yield ''
    yield (
        '| robot | records | `check` by note / by signals | c1 | c2 | c4 | c5 | viscous | Coulomb '
        '| held out, lean | held out, hip |'
    )
    yield '|---|---|---|---:|---:|---:|---:|---:|---:|---:|---:|'
    yield from rows('rigid', RIGID)
    yield from rows('flexible', FLEXIBLE)


def main() -> None:
    text = '\n'.join(table()) + '\n'
    write_atomically(RESULT, text)
    print(text)


if __name__ == '__main__':
    main()
