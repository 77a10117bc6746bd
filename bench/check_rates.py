"""How surely the check finds faults of a recording, and how often it cries wolf.

    ./cg exec python bench/check_rates.py [--seeds 2] [--quick] [--write FILE]

Sound recordings come from the simulated robot, its numbers 10 to 20 % off the nominal file, in
the four identification set-ups and others, 8 s at 500 Hz with sensor noise and encoder counts;
each effect that the demonstration may hide is hidden in them; pendulums come along. Faults set in
somewhere in the middle. *Named*: a finding of that name, at the right channel or topic. *Unusable*
and *repaired*: what becomes of the recording (repaired: usable, with the repair stated). *Missed*:
nothing is said about it, and the recording is used. Recordings in which a fault cannot show (an
IMU on a leg that is held) are left out.
"""

import argparse
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from cg_bringup.hidden import hide, hideable_effects, perturb
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.checks.recordings import check_recording
from cg_sysid.experiments import fault_injection as fault_injection
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.experiments.synthetic import Synthesis, synthesise

SET_UPS = (
    'spring_stabilised_inner',
    'spring_stabilised_outer',
    'swing_inner_fixed',
    'swing_outer_fixed',
)
OTHERS = ('legs_tied', 'chirp', 'open_loop_playback')
SECONDS = 8.0
SYNTHETIC = {
    'steps of torque': {'torque': 'steps'},
    'sine': {'torque': 'sine'},
    '512 counts per turn': {'quantum': 2 * np.pi / 512},
    'hardly moving': {'amplitude': 1e-3},
    'ideal sensors, rest first': {'quantum': 0.0, 'rest_share': 0.5},
    'noise 1 mrad': {'noise': 1e-3, 'quantum': 0.0},
    'stamps that jitter by 80 %': {'jitter': 0.8},
    'rest first': {'rest_share': 0.7},
    'motion up to 15 Hz': {'bandwidth': 15.0, 'amplitude': 0.1},
    'pendulum, 100 Hz': {'mechanism': 'pendulum', 'rate': 100.0, 'amplitude': 2.0},
    'double pendulum': {'mechanism': 'double_pendulum', 'bandwidth': 8.0, 'jitter': 0.5},
}
# torque RMS in N m that keeps each pendulum from turning over
PENDULUMS = {'sydney_pendulum': 0.04, 'dfki_double_pendulum': 0.2, 'xl330_pendulum': 0.1}
TOPICS = ('/applied_torque', '/imu', '/hip_encoder', fault_injection.ALL)
TOPIC_OF = {
    'hip_torque': '/applied_torque',
    'imu_angle': '/imu',
    'imu_rate': '/imu',
    'hip_angle': '/hip_encoder',
}
SHIFTS = {
    'hip_angle': (0.002, 0.005, 0.02, 0.1),
    'imu_angle': (0.002, 0.005, 0.02, 0.1),
    'imu_rate': (0.005, 0.02, 0.05, 0.2),
    'hip_torque': (0.3, 1.0, 5.0),
}
UNITS = {'hip_angle': 'rad', 'imu_angle': 'rad', 'imu_rate': 'rad/s', 'hip_torque': 'N m'}


def robot_record(machine, name, seed):
    e = load_experiment(name)
    settings = ExcitationSettings(**e.excitation, duration=SECONDS, seed=seed)
    record = rehearse(
        name, machine, e.setup, e.initial_state, [make_signal(settings)], SECONDS, seed=seed
    )
    return fault_injection.as_recorded(record, seed)


def pendulum_record(name, seed):
    machine = Model.load(model_path(name))
    joints = len(machine.mechanism.joints)
    signals = [
        make_signal(
            ExcitationSettings(
                amplitude=PENDULUMS[name],
                f_min=0.1,
                f_max=3.0,
                duration=SECONDS,
                seed=10 * seed + i,
            )
        )
        for i in range(len(machine.mechanism.inputs))
    ]
    record = rehearse(
        name, machine, Setup(), [0.3] * joints + [0.0] * joints, signals, SECONDS, seed=seed
    )
    return fault_injection.as_recorded(record, seed)


def sound(seeds) -> Iterator[tuple[str, list]]:
    """Kind of sound recording, and recordings of it."""
    nominal = Model.load(model_path(NOMINAL_MODEL))
    machines = [perturb(nominal, np.random.default_rng(seed))[0] for seed in range(seeds)]
    for name in (*SET_UPS, *OTHERS):
        yield name, [robot_record(m, name, seed) for seed, m in enumerate(machines)]
    for name in PENDULUMS:
        yield name, [pendulum_record(name, seed) for seed in range(seeds)]
    for name, options in SYNTHETIC.items():
        yield name, [synthesise(Synthesis(**options), seed) for seed in range(seeds)]
    for effect in hideable_effects(nominal):
        machines = [hide(nominal, effect, 100 + seed).model for seed in range(seeds)]
        yield (
            f'{effect} hidden',
            [
                robot_record(m, name, 100 + 10 * seed + i)
                for seed, m in enumerate(machines)
                for i, name in enumerate(SET_UPS)
            ],
        )


def faults(at, seed) -> Iterator[tuple[str, str, str, object]]:
    """(name, what, channel or topic concerned, fault) of every fault, setting in at `at` s."""
    for channel, sizes in SHIFTS.items():
        for size in sizes:
            yield (
                'zero_shift',
                f'{channel} by {size:g} {UNITS[channel]}',
                channel,
                fault_injection.shifted(channel, size, at),
            )
    for channel in SHIFTS:
        yield (
            'sign_error',
            f'{channel}, all the time',
            channel,
            fault_injection.mirrored((channel,)),
        )
        yield (
            'sign_error',
            f'{channel}, from the middle on',
            channel,
            fault_injection.mirrored((channel,), at),
        )
    both = ('imu_angle', 'imu_rate')
    yield 'sign_error', 'imu_angle and imu_rate', 'imu_angle', fault_injection.mirrored(both)
    for channel in SHIFTS:
        for share in (0.995, 0.98, 0.9, 0.6):
            yield (
                'sensor_clipping',
                f'{channel}, {1 - share:.1%} of the time',
                channel,
                fault_injection.clipped(channel, share),
            )
    for topic in TOPICS:
        for ratio in (2, 5):
            for honest in (True, False):
                yield (
                    'sampling_rate_change',
                    f'{topic}, a {"half" if ratio == 2 else "fifth"} of it'
                    + ('' if honest else ', stamps as before'),
                    topic,
                    fault_injection.decimated(topic, ratio, at, honest),
                )
    for topic in TOPICS:
        for honest in (True, False):
            tail = '' if honest else ', stamps as if none were'
            for share in (0.002, 0.02, 0.2):
                yield (
                    'dropped_samples',
                    f'{topic}, {share:.1%} at random{tail}',
                    topic,
                    fault_injection.thinned(topic, share, seed, honest),
                )
            for length in (0.006, 0.02, 0.1, 0.5):
                yield (
                    'dropped_samples',
                    f'{topic}, {1e3 * length:g} ms{tail}',
                    topic,
                    fault_injection.interrupted(topic, length, at, honest),
                )
    for topic in TOPICS:
        for size in (0.003, 0.01, 0.05, 0.5):
            for sign in (1, -1):
                yield (
                    'clock_jump',
                    f'{topic} by {1e3 * sign * size:+g} ms',
                    topic,
                    fault_injection.jumped(topic, sign * size, at),
                )


def shows(raw, where) -> bool:
    """Whether a fault there can show at all: the IMU is at rest while its leg is held."""
    return not (raw.setup.fixture == 'inner_fixed' and where.strip('/').startswith('imu'))


def judge(raw, name, where, at, model):
    """named, in place, unusable, repaired, missed of one spoilt recording."""
    report = check_recording(raw, model)
    places = {where, TOPIC_OF.get(where, where)}
    named = [f for f in report.of(name) if where == fault_injection.ALL or f.where in places]
    if where in ('hip_torque', 'hip_angle'):  # either, where only these two disagree
        named = named or [f for f in report.of(name) if f.where in ('hip_torque', 'hip_angle')]
    placed = [f for f in named if f.start_s is None or abs(f.start_s - at) < 0.25]
    unusable = report.verdict == 'unusable'
    repaired = not unusable and any(f.repair for f in named)
    told = any(f.severity == 'warning' for f in report.findings)
    return np.array([bool(named), bool(placed), unusable, repaired, not unusable and not told])


def fault_table(seeds, quick) -> Iterator[str]:
    nominal = Model.load(model_path(NOMINAL_MODEL))
    model = model_path(NOMINAL_MODEL)
    for arrivals in (True,) if quick else (True, False):
        rows: dict[tuple[str, str], list] = {}
        for seed in range(seeds):
            machine = perturb(nominal, np.random.default_rng(50 + seed))[0]
            at = float(np.random.default_rng(seed).uniform(0.3, 0.7)) * SECONDS
            for i, set_up in enumerate(SET_UPS):
                raw = robot_record(machine, set_up, 500 + 10 * seed + i)
                for name, what, where, fault in faults(at, seed):
                    if not shows(raw, where):
                        continue
                    spoilt = fault(raw)
                    if not arrivals:
                        spoilt = fault_injection.without_arrivals(spoilt)
                    row = judge(spoilt, name, where, at, model)
                    rows.setdefault((name, what), []).append(row)
        yield ''
        yield '## Faults' + ('' if arrivals else ', where times of arrival equal the stamps')
        yield ''
        yield (
            '| fault | where and how much | cases | named | in place | unusable | repaired '
            '| missed |'
        )
        yield '|---|---|---:|---:|---:|---:|---:|---:|'
        for (name, what), found in rows.items():
            shares = np.mean(found, axis=0)
            yield (
                f'| `{name}` | {what} | {len(found)} | '
                + ' | '.join(f'{share:.0%}' for share in shares)
                + ' |'
            )


def sound_table(seeds) -> Iterator[str]:
    yield '| sound recordings | cases | called unusable | other warnings |'
    yield '|---|---:|---:|---|'
    total = wrong = 0
    for name, raws in sound(seeds):
        reports = [
            check_recording(
                raw,
                model_path(NOMINAL_MODEL)
                if raw.mechanism.name == 'compass_gait' and not raw.name.startswith('synthetic')
                else None,
            )
            for raw in (*raws, *map(fault_injection.without_arrivals, raws))
        ]
        unusable = sum(report.verdict == 'unusable' for report in reports)
        codes = {f.code for r in reports for f in r.findings if f.severity == 'warning'}
        total, wrong = total + len(reports), wrong + unusable
        yield f'| {name} | {len(reports)} | {unusable} | {", ".join(sorted(codes))} |'
    yield f'| **all** | **{total}** | **{wrong}** | |'


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seeds', type=int, default=2)
    parser.add_argument('--quick', action='store_true', help='only with times of arrival')
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    began = time.monotonic()
    lines = []
    for line in (*sound_table(options.seeds), *fault_table(options.seeds, options.quick)):
        lines.append(line)
        print(line, flush=True)
    text = '\n'.join(lines)
    if options.write:
        command = f'python bench/check_rates.py --seeds {options.seeds}'
        command += ' --quick' if options.quick else ''
        options.write.write_text(
            f'# Faults of recordings: found, and cried wolf\n\nCommand: `{command}` '
            f'({(time.monotonic() - began) / 60:.0f} min on one core). '
            + ' '.join(__doc__.split('\n\n')[2].split())
            + f'\n\n{text}\n'
        )


if __name__ == '__main__':
    main()
