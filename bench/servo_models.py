"""The servo's published friction models M1 to M6 on the files that judge ours (results.md).

    ./cg exec python bench/servo_models.py DATA_DIR

Each model is simulated as its authors do it (Duclusaud et al., Extended Friction Models, ICRA
2025, and the equations of Rhoban/bam): the torque that would stop the joint is opposed by at most

    Coulomb + viscous + [1 when at rest .. 0 when fast] (Stribeck) + load-dependent friction,

where the load is the torque on the gearbox from the motor's side and from outside. The motor's
torque is kt (V duty - kt w) / R with the measured duty and voltage. Every step of the record is
cut into `SUBSTEPS`; the start is the measured position at rest. Error: MAE of the position over
the files of gain 200, as in bench/real_data.py.
"""

import argparse
import csv
import json
import math
from pathlib import Path

import numpy as np

GRAVITY = 9.80665
COUNTS = 885.0  # of full duty
SUBSTEPS = 8
MODELS = ('m1', 'm2', 'm3', 'm4', 'm5', 'm6')


def friction(p, motor, outside, rate):
    """Largest torque of friction in N m."""
    slow = 0.0
    if 'dtheta_stribeck' in p:
        slow = math.exp(-(abs(rate / p['dtheta_stribeck']) ** p['alpha']))
    most = p['friction_base'] + slow * p.get('friction_stribeck', 0.0)
    if 'load_friction_motor' in p:
        most += abs(outside * p['load_friction_external'] - motor * p['load_friction_motor'])
        most += slow * abs(
            outside * p['load_friction_external_stribeck']
            - motor * p['load_friction_motor_stribeck']
        )
    elif 'load_friction_base' in p:
        load = p['load_friction_base'] + slow * p.get('load_friction_stribeck', 0.0)
        most += load * abs(outside - motor)
    if 'load_friction_motor_quad' in p and motor * outside < 0:
        if abs(outside) < abs(motor):
            most += slow * p['load_friction_external_quad'] * outside**2
        else:
            most += slow * p['load_friction_motor_quad'] * motor**2
    return most + p['friction_viscous'] * abs(rate)


def error(p, log, rows):
    """MAE in rad of one file."""
    inertia = log['mass'] * log['length'] ** 2 + p['armature']
    weight = log['mass'] * GRAVITY * log['length']
    q, w, total = float(rows[0]['position']), 0.0, 0.0
    for row, following in zip(rows, [*rows[1:], None], strict=True):
        total += abs(q - float(row['position']))
        if following is None:
            break
        h = (float(following['timestamp']) - float(row['timestamp'])) / SUBSTEPS
        volts = float(row['input_volts']) * float(row['pwm_counts']) / COUNTS
        on = float(row['torque_enable'])
        for _ in range(SUBSTEPS):
            motor = on * p['kt'] * (volts - p['kt'] * w) / p['R']
            outside = -weight * math.sin(q + p['q_offset'])
            stop = inertia / h * w + motor + outside
            held = min(abs(stop), friction(p, motor, outside, w))
            rate = (motor + outside - math.copysign(held, stop)) / inertia
            w += h * rate
            q += h * w
    return total / len(rows)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('data', type=Path)
    options = parser.parse_args()
    folder = options.data / 'bam_servo_pendulum'
    logs = [log for log in json.loads((folder / 'logs.json').read_text()) if log['kp'] == 200]
    files = sorted(folder.glob('published_params_*.json'))
    sets = [file.stem.removeprefix('published_params_') for file in files]
    print('| model | ' + ' | '.join(sets) + ' |')
    print('|---|' + '---|' * len(files))
    published = [json.loads(file.read_text()) for file in files]
    for model in MODELS:
        cells = []
        for parameters in published:
            if model not in parameters:
                cells.append('-')
                continue
            found = []
            for log in logs:
                with (folder / log['file']).open() as stream:
                    found.append(error(parameters[model], log, list(csv.DictReader(stream))))
            cells.append(f'{np.mean(found):.4f}')
        print(f'| {model.upper()} | ' + ' | '.join(cells) + ' |')


if __name__ == '__main__':
    main()
