"""A real arm: what friction do the joints of a UR10e have, and does it carry a load?

    ./cg exec python bench/ur10e.py DATA_DIR [--budget SECONDS] [--write bench/results/ur10e.md]

DATA_DIR is a checkout of github.com/shamilmamedov/dynamic_calibration, or its folder
dataset_ur10e beside URe/urdf/ur10e.urdf: 100 Hz, positions to 1e-4 rad, motor currents. The data
carry no licence: they are read where they are. Used are identification_data up to the files of
20_02_10, and no others. Torques are currents times the drive gains that the authors took from
[Gaz, Flacco, De Luca: Identifying the dynamic model used by the KUKA LWR and UR10]: those of
GAINS.

    train       20_02_05-20sec_8harm, 20_02_06-20sec_5harm and 10harm, 20_02_10-20sec_7harm
    held out    20_02_05-20sec_12harm, 20_02_10-30sec_12harm
    load        20_01_31-unload, then 20_01_31-load, which the model does not know

The relative residual error of a joint is the root mean square of the torque that is not explained
over that of the torque, along held-out motions; for every model with the same smoothed motion.
Least squares is the usual peer: base parameters, viscous and dry friction and an offset for each
joint, linear, with no belief.
"""

import argparse
import io
import resource
import sys
import time
from pathlib import Path

import numpy as np
from base_parameters import least_squares

from cg_description.reading import read_text
from cg_description.robot_description import RobotDescriptionError, parse
from cg_dynamics.mechanisms.urdf import Urdf
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_interfaces import channels
from cg_sysid.cli.new_robot import template
from cg_sysid.deadline import Deadline
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.identification.torque_error import fit_by_torque
from cg_sysid.identification.windows import followed, windows_of
from cg_sysid.records.record import Record
from cg_sysid.text import measured

GAINS = (14.87, 13.26, 11.13, 10.62, 11.03, 11.47)  # N m/A
TRAIN = ('20_02_05-20sec_8harm', '20_02_06-20sec_5harm', '20_02_06-20sec_10harm',
         '20_02_10-20sec_7harm')  # fmt: skip
HELD = ('20_02_05-20sec_12harm', '20_02_10-30sec_12harm')
UNLOADED, LOADED = ('20_01_31-unload',), ('20_01_31-load',)
FLANGE, NUMBERS = 'wrist_3_link', ('mass', 'x', 'y', 'z')
MOVES = 0.01  # rad/s
TURNING = 0.02  # rad/s, over which dry friction turns


def nominal(folder: Path) -> Model:
    """The arm as its URDF has it, with a rotor and plain friction at each joint, not believed."""
    path = next(folder.glob('**/urdf/ur10e.urdf'))
    description = parse(read_text(path, RobotDescriptionError), str(path))
    model = Model.from_text(template(description, None, [], path.name))
    for joint in model.mechanism.driven:
        model = model.with_effect('rotor_inertia', joint, inertia=0.5)
        model = model.with_effect('viscous_friction', joint, coefficient=5.0)
        model = model.with_effect('coulomb_friction', joint, torque=5.0, transition_rate=TURNING)
    return model


def read(folder: Path, name: str, body: Urdf) -> Record:
    """One recording, from its first motion to its last."""
    rows = np.loadtxt(next(folder.glob(f'**/identification_data/ur-{name}.csv')), delimiter=',')
    rows = rows[np.r_[True, np.diff(rows[:, 0]) > 0]]
    moving = np.flatnonzero(np.abs(rows[:, 7:13]).max(axis=1) > MOVES)
    rows = rows[moving[0] : moving[-1]]
    joints = body.coordinates
    return Record(
        name=name,
        stamp_ns=np.round(rows[:, 0] * 1e9).astype(np.int64),
        inputs={f'{j}_effort': GAINS[k] * rows[:, 13 + k] for k, j in enumerate(joints)},
        outputs={f'{j}_position': rows[:, 1 + k] for k, j in enumerate(joints)},
        mechanism=channels.interface(body),
        setup=Setup(),
        note={},
    )  # fmt: skip


def relative(model: Model, data_sets) -> np.ndarray:
    """Relative residual error of each joint of a model as it is."""
    found = fit_by_torque(model, data_sets, only=())
    return found.relative if found else np.full(len(model.mechanism.coordinates), np.nan)


def as_followed(model: Model, records):
    """The records, cut where they cannot be followed."""
    found = followed(model, records)
    return [p for r, f in zip(records, found, strict=True) for p in windows_of(r, f)]


def found_in(model: Model, records, budget: float):
    """A diagnosis of records, and the CPU time that it took."""
    began = _cpu()
    result = diagnose(
        model, as_followed(model, records), options=Options(), deadline=Deadline(budget)
    )
    return result, _cpu() - began


def _cpu() -> float:
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def bare(model: Model) -> Model:
    """Rigid bodies alone."""
    for effect in model.effects:
        model = model.without_effect(effect.label)
    return model


def _row(name: str, values) -> str:
    return f'| {name} | ' + ' | '.join(f'{v:.3f}' for v in values) + ' |'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('data', type=Path)
    parser.add_argument('--budget', type=float, default=600.0, help='of each diagnosis, in s')
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    model = nominal(options.data)
    body = model.mechanism
    out = io.StringIO()

    def say(line=''):
        print(line, flush=True)
        out.write(line + '\n')

    sets = {
        names: prepare(model, [read(options.data, name, body) for name in names])
        for names in (TRAIN, HELD, UNLOADED, LOADED)
    }
    say('Relative residual error on held-out motions, by joint:\n')
    say('| | ' + ' | '.join(j.removesuffix('_joint') for j in body.coordinates) + ' |')
    say('|---|' + '---|' * len(body.coordinates))
    say(_row('URDF, no friction', relative(bare(model), sets[HELD])))
    began = time.process_time()
    squares = least_squares(model, sets[TRAIN], sets[HELD], TURNING).left
    squares_seconds = time.process_time() - began
    say(_row('least squares', squares))
    began = time.process_time()
    plain = fit_by_torque(model, sets[TRAIN])
    plain_seconds = time.process_time() - began
    say(_row('ours, plain friction', relative(model.with_values(plain.values), sets[HELD])))
    records = [read(options.data, name, body) for name in TRAIN]
    result, seconds = found_in(model, records, options.budget)
    final = result.model
    refit = fit_by_torque(final, sets[TRAIN])
    say(_row('ours, with causes', relative(final.with_values(refit.values), sets[HELD])))
    say(f'\nCPU: least squares {squares_seconds:.1f} s, torque fit {plain_seconds:.1f} s, '
        f'diagnosis {seconds:.0f} s.\n')  # fmt: skip
    say(result.summary)
    say('\nFriction of the joints:\n')
    for effect in final.effects:
        if effect.place in ('joint', 'transmission'):
            values = final.with_values(refit.values).values_of(effect)
            say(f'- {effect.label}: ' + ', '.join(f'{k} = {v:.3g}' for k, v in values.items()))
    unloaded = [read(options.data, name, body) for name in UNLOADED]
    known = fit(model, prepare(model, as_followed(model, unloaded))).model
    loaded, seconds = found_in(
        known, [read(options.data, name, body) for name in LOADED], options.budget
    )
    say(f'\nWith the load that the model of the unloaded arm does not know ({seconds:.0f} s):\n')
    say(loaded.summary)
    hung = fit_by_torque(known.with_effect('payload', FLANGE, mass=1.0), sets[LOADED])
    numbers = ', '.join(f'{k} = {hung.values[f"payload@{FLANGE}.{k}"]:.3g}' for k in NUMBERS)
    say(f'\nA payload at {FLANGE} by torques alone: {numbers} (kg, m).')
    for cause in loaded.causes:
        told = ', '.join(f'{k} = {measured(*v)}' for k, v in cause.parameters.items())
        say(f'- {cause.label}: {told}')
    if options.write:
        options.write.write_text(out.getvalue())


if __name__ == '__main__':
    sys.exit(main())
