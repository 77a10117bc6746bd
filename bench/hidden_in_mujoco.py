"""How often the right cause is named where the machine shares no code with the model.

    ./cg exec python bench/hidden_in_mujoco.py [--first 1] [--seeds 1] [--effects a,b]
        [--workers N] [--raw FILE] [--write FILE] [--table-only]

The robot is MuJoCo's (src/cg_dynamics/test/mujoco_robot.py): its rigid bodies, its integrator, and
effects written down once more, there and here, from their physics: a motor that clips hard, teeth
without a smooth corner, filters in closed form. Numbers are 10 to 15 % off the nominal file, and
sizes are drawn as in bench/hidden_effects.py, with the same experiments, noise and counts. The hip
body is left out, which a plain link cannot be.

A name with a slash, as `stribeck_friction/exponential`, is the same effect by another law than the
library's: what the literature and other simulators have for it.

Not here: feet that roll or give way, springs that harden and presliding, which this robot does not
have, and `boom_mass`: to an engine a mass is a mass.
"""

import argparse
import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from hidden_effects import PROGRAMME, SECONDS, row_of, summary_of, table_of, verdict_of

from cg_bringup.hidden import draw_values, hidden_effects_file
from cg_bringup.runs import NOMINAL_MODEL
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_sysid.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments import load_experiment
from cg_sysid.record import Record

sys.path.insert(0, str(Path(__file__).parents[1] / 'src/cg_dynamics/test'))
from mujoco_robot import Hidden, simulate_mujoco, two_links

SAMPLE = 0.002
FINE = 4  # rows of the simulation for one of the record: filters run on these
TEETH = 3000.0, 4.0  # N m/rad and N m s/rad of teeth that touch; the library's are 4000 and 5
TURN = 0.01  # rad/s, over which dry friction turns
OFF = ('c1', 'c2', 'c4', 'c5', 'coulomb_friction.torque', 'viscous_friction.coefficient')
PUSHED = 1  # the record with a push
PAUSE = 2.0  # s between two recordings
SLOW = 6.0  # times as long does grease take to warm that goes on warming from one to the next
HALF_SINE = np.sqrt(1 / 4 - 2 / np.pi**2)  # standard deviation of a half sine over its length
CHANNELS = ('imu_angle', 'imu_rate', 'hip_angle')

Channels = dict[str, np.ndarray]


@dataclass(frozen=True)
class Secret:
    """What is wrong with the machine.

    Attributes:
        robot: Attributes of mujoco_robot.Hidden.
        command: Reported torque and step in s -> delivered torque, shape (n,).
        read: True channels and time -> what the sensors show.
        step: Longest of the engine, in s.
    """

    robot: Mapping[str, Any] = field(default_factory=dict)
    command: Callable[[np.ndarray, float], np.ndarray] = lambda torque, dt: torque
    read: Callable[[Channels, np.ndarray], Channels] = lambda channels, time: channels
    step: float = SAMPLE / FINE


def dry(level: Callable) -> Secret:
    """Dry friction at the hip of a level (time, angle, rate, torque) -> N m."""

    def torque(time, angle, rate, load):
        return -level(time, angle, rate, load) * np.tanh(rate / TURN)

    return Secret({'at_hip': torque})


def sensor(channel: str, change: Callable) -> Secret:
    """A channel (value, time) -> as it is shown."""
    return Secret(read=lambda c, time: {**c, channel: change(c[channel], time)})


def half_sine(t: float, length: float) -> float:
    """A pulse of area one about t = 0, in 1/s."""
    return np.pi / (2 * length) * np.cos(np.pi * t / length) if abs(t) < length / 2 else 0.0


def lagged_torque(torque: np.ndarray, dt: float, constant: float) -> np.ndarray:
    """Mean over each row of T y' = u - y, u held."""
    kept = np.exp(-dt / constant)
    mean, y = np.empty_like(torque), torque[0]
    for k, u in enumerate(torque):
        mean[k] = u + (y - u) * constant / dt * (1 - kept)
        y = u + (y - u) * kept
    return mean


def filtered(x: np.ndarray, dt: float, constant: float) -> np.ndarray:
    """T y' = x - y, x straight between rows, as after a while at the first rate."""
    kept, slopes = np.exp(-dt / constant), np.diff(x) / dt
    y = np.empty_like(x)
    y[0] = x[0] - constant * slopes[0]
    for k, s in enumerate(slopes):
        y[k + 1] = x[k + 1] - s * constant + (y[k] - x[k] + s * constant) * kept
    return y


def secret_of(effect: str, v: Mapping[str, float], leg_length: float, begin: float) -> Secret:
    """The physics of an effect of these values, in a recording that begins at that time in s."""
    imu = ('imu_angle', 'imu_rate')
    made: dict[str, Callable[[], Secret]] = {
        'actuator_delay': lambda: Secret({'torque_delay': v['delay']}),
        'actuator_lag': lambda: Secret(
            command=lambda u, dt: lagged_torque(u, dt, v['time_constant'])),
        'torque_constant': lambda: Secret({'torque_gain': 1 + v['error']}),
        'torque_bias': lambda: Secret({'torque_bias': v['bias']}),
        'torque_saturation': lambda: Secret(
            command=lambda u, dt: np.clip(u, -v['limit'], v['limit'])),
        'cogging_torque': lambda: Secret({
            'at_hip': lambda t, angle, rate, load:
                v['amplitude'] * np.sin(v['cycles'] * angle + v['phase'])}),
        'joint_flexibility': lambda: Secret({
            'flexibility': (v['stiffness'], v['rotor_inertia'], v['damping'])}),
        'backlash': lambda: Secret({
            'flexibility': (TEETH[0], v['rotor_inertia'], TEETH[1]), 'gap': v['gap']},
            step=SAMPLE / 20),  # teeth meet within a step
        'quadratic_friction': lambda: Secret({
            'at_hip': lambda t, angle, rate, load: -v['coefficient'] * rate * abs(rate)}),
        'asymmetric_friction': lambda: dry(
            lambda t, angle, rate, load: v['excess'] * (rate > 0)),
        'stribeck_friction': lambda: dry(
            lambda t, angle, rate, load:
                v['torque'] * np.exp(-((rate / v['stribeck_rate']) ** 2))),
        'load_dependent_friction': lambda: dry(
            lambda t, angle, rate, load: v['coefficient'] * abs(load)),
        'position_dependent_friction': lambda: dry(
            lambda t, angle, rate, load: v['torque'] * (1 + np.cos(angle - v['tightest'])) / 2),
        'friction_drift': lambda: dry(
            lambda t, angle, rate, load: v['excess'] * np.exp(-t / v['time_constant'])),
        'payload': lambda: Secret({'payload': ('outer', v['mass'], v['distance'])}),
        'ground_slope': lambda: Secret({'slope': v['angle']}),
        'aerodynamic_drag': lambda: Secret({
            'on_leg': lambda rate: -v['coefficient'] * rate * abs(rate)}),
        'ankle_friction': lambda: Secret({
            'at_stance': lambda t, angle, rate: -v['coefficient'] * rate}),
        'tether_force': lambda: Secret({
            'at_stance': lambda t, angle, rate: v['force'] * leg_length * np.cos(angle)}),
        'external_push': lambda: Secret({'at_stance': lambda t, angle, rate:
            v['impulse'] * half_sine(t - v['instant'], v['duration'] / HALF_SINE)
            * leg_length * np.cos(angle)}),
        'spring_damping': lambda: Secret({'spring_damping': v['coefficient']}),
        'encoder_offset': lambda: sensor('hip_angle', lambda x, t: x + v['offset']),
        'encoder_scale': lambda: sensor('hip_angle', lambda x, t: (1 + v['error']) * x),
        'encoder_eccentricity': lambda: sensor(
            'hip_angle', lambda x, t: x + v['amplitude'] * np.sin(x + v['phase'])),
        'gyro_bias': lambda: sensor('imu_rate', lambda x, t: x + v['bias']),
        'gyro_scale': lambda: sensor('imu_rate', lambda x, t: (1 + v['error']) * x),
        'imu_offset': lambda: sensor('imu_angle', lambda x, t: x + v['offset']),
        'imu_scale': lambda: sensor('imu_angle', lambda x, t: (1 + v['error']) * x),
        'imu_drift': lambda: sensor('imu_angle', lambda x, t: x + v['rate'] * t),
        'imu_lag': lambda: Secret(read=lambda c, time: {
            **c, **{n: filtered(c[n], time[1], v['time_constant']) for n in imu}}),
        'sensor_delay': lambda: Secret({'sensor_delay': v['delay']}),
        'none': lambda: Secret(),
        # Tustin's law; a motor whose iron saturates; a gear out of round; grease that warms on.
        'stribeck_friction/exponential': lambda: dry(
            lambda t, angle, rate, load:
                v['torque'] * np.exp(-abs(rate) / v['stribeck_rate'])),
        'torque_saturation/tanh': lambda: Secret(
            command=lambda u, dt: v['limit'] * np.tanh(u / v['limit'])),
        'position_dependent_friction/twice_a_turn': lambda: dry(
            lambda t, angle, rate, load:
                v['torque'] * (1 + np.cos(2 * angle - v['tightest'])) / 2),
        'friction_drift/straight': lambda: dry(
            lambda t, angle, rate, load: v['excess'] * (1 - t / (2 * SECONDS))),
        'friction_drift/session': lambda: dry(
            lambda t, angle, rate, load:
                v['excess'] * np.exp(-(begin + t) / v['time_constant'])),
    }  # fmt: skip
    if effect not in made:
        raise SystemExit(f'no effect {effect!r} here; there are {", ".join(made)}')
    return made[effect]()


EFFECTS = (
    'none', 'actuator_delay', 'actuator_lag', 'torque_constant', 'torque_bias',
    'torque_saturation', 'cogging_torque', 'joint_flexibility', 'backlash', 'quadratic_friction',
    'asymmetric_friction', 'stribeck_friction', 'load_dependent_friction',
    'position_dependent_friction', 'friction_drift', 'payload', 'ground_slope',
    'aerodynamic_drag', 'ankle_friction', 'tether_force', 'external_push', 'spring_damping',
    'encoder_offset', 'encoder_scale', 'encoder_eccentricity', 'gyro_bias', 'gyro_scale',
    'imu_offset', 'imu_scale', 'imu_drift', 'imu_lag', 'sensor_delay',
    'stribeck_friction/exponential', 'torque_saturation/tanh',
    'position_dependent_friction/twice_a_turn', 'friction_drift/straight',
    'friction_drift/session',
)  # fmt: skip


def record(
    name: str, experiment: str, truth: Mapping[str, float], secret: Secret, sensors: Mapping,
    seed: int, begin: float,
) -> Record:
    """One recording of MuJoCo's robot, which begins at that time in s."""
    e = load_experiment(experiment)
    signal = make_signal(ExcitationSettings(**e.excitation, duration=SECONDS, seed=seed))
    rows = round(SECONDS / SAMPLE)
    reported = np.array([signal(k * SAMPLE) for k in range(rows)])
    dt = SAMPLE / FINE
    hidden = Hidden(
        viscous=truth['viscous_friction.coefficient'], coulomb=truth['coulomb_friction.torque'],
        transition_rate=TURN, **secret.robot,
    )  # fmt: skip
    out = simulate_mujoco(
        {n: x for n, x in truth.items() if '.' not in n}, e.setup,
        secret.command(np.repeat(reported, FINE), dt), dt, np.array(e.initial_state, float),
        hidden, fine_step=secret.step,
    )  # fmt: skip
    shown = secret.read({c: out[c] for c in CHANNELS}, out['time'])
    rng = np.random.default_rng(seed)
    outputs = {}
    for channel in CHANNELS:
        has = {name: q.value for name, q in sensors[channel].items()}
        values = shown[channel][::FINE] + has.get('noise', 0.0) * rng.standard_normal(rows)
        count = has.get('resolution')
        outputs[channel] = np.round(values / count) * count if count else values
    return Record(
        name=name,
        stamp_ns=((begin + np.arange(rows) * SAMPLE) * 1e9).round().astype(np.int64),
        inputs={'hip_torque': reported},
        outputs=outputs,
        mechanism='compass_gait',
        setup=e.setup,
    )


def case(effect: str, seed: int, workers: int | None) -> dict[str, Any]:
    """One line of the raw results."""
    file = Model.load(model_path(NOMINAL_MODEL))
    nominal = file.with_values(two_links(file.values))
    rng = np.random.default_rng(seed)
    truth = dict(nominal.values)
    for name in OFF:
        truth[name] *= float(1 + rng.choice([-1, 1]) * rng.uniform(0.1, 0.15))
    table = yaml.safe_load(hidden_effects_file().read_text(encoding='utf-8'))
    named = effect.partition('/')[0]
    values = draw_values(table[named], rng) if effect != 'none' else {}
    if effect == 'friction_drift/session':
        values['time_constant'] *= SLOW
    records = []
    for i, name in enumerate(PROGRAMME):
        begin = i * (SECONDS + PAUSE)
        secret = secret_of(effect, values, truth['leg_length'], begin)
        if effect == 'external_push' and i != PUSHED:
            secret = Secret()  # somebody pushed once
        seeded = 100 * seed + i
        records.append(record(f'{i}_{name}', name, truth, secret, nominal.sensors, seeded, begin))
    hidden = {named: values} if effect != 'none' else {}
    about = {'law': effect, 'size': 1.0, 'seed': seed, 'faults': False}
    return about | row_of(nominal, records, hidden, workers)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--first', type=int, default=1)
    parser.add_argument('--seeds', type=int, default=1)
    parser.add_argument('--effects', help='comma-separated; none is a sound robot')
    parser.add_argument('--workers', type=int, help='processes of each diagnosis')
    parser.add_argument('--raw', type=Path, default=Path('bench/results/hidden_in_mujoco.jsonl'))
    parser.add_argument('--write', type=Path)
    parser.add_argument('--table-only', action='store_true', help='run nothing')
    options = parser.parse_args()
    effects = options.effects.split(',') if options.effects else EFFECTS
    for k in range(0 if options.table_only else options.seeds):
        for j, effect in enumerate(EFFECTS):
            if effect not in effects:
                continue
            row = case(effect, options.first + 1000 * k + j, options.workers)
            print(*(key for key, seen in verdict_of(row).items() if seen), row, flush=True)
            with options.raw.open('a') as raw:
                raw.write(json.dumps(row) + '\n')
    rows = [json.loads(line) for line in options.raw.read_text().splitlines()]
    print('\n'.join(summary_of(rows)))
    if options.write:
        command = 'python bench/hidden_in_mujoco.py --table-only --write FILE'
        lines = ['# Effects hidden in MuJoCo', '', f'Command: `{command}`', '']
        options.write.write_text('\n'.join([*lines, *summary_of(rows), '', *table_of(rows), '']))


if __name__ == '__main__':
    main()
