"""How often the checks cry wolf, and how often they find a fault: seeded synthetic recordings.

Usage: python bench/check_rates.py [SEEDS]
"""

import sys
from collections import Counter
from dataclasses import replace

import numpy as np

from cg_sysid.check import check_recording
from cg_sysid.synthetic import Synthesis, synthesise

HEALTHY = {
    'multisine': {},
    'free motion': {'torque': 'zero'},
    'chirp': {'torque': 'chirp'},
    'steps': {'torque': 'steps'},
    '512 counts per turn': {'quantum': 2 * np.pi / 512},
    'hardly moving': {'amplitude': 1e-3},
    'no quantum, no noise, rest first': {'quantum': 0.0, 'rest_share': 0.5},
    'noise 1 mrad': {'noise': 1e-3, 'quantum': 0.0},
    'jitter 80 %': {'jitter': 0.8},
    'rest first': {'rest_share': 0.7},
    'up to 15 Hz': {'bandwidth': 15.0, 'amplitude': 0.1},
    'pendulum, 100 Hz': {'mechanism': 'pendulum', 'rate': 100.0, 'amplitude': 2.0},
    'double pendulum': {'mechanism': 'double_pendulum', 'bandwidth': 8.0, 'jitter': 0.5},
}


def hip_angle(change):
    """A fault of the hip encoder: a function from good to bad values."""

    def fault(raw):
        topic = raw.topics['/hip_encoder']
        values = {'hip_angle': change(topic.values['hip_angle'].copy())}
        return replace(raw, topics={**raw.topics, topic.name: replace(topic, values=values)})

    return fault


def freeze(start, stop):
    """Values that stay from one index to another."""

    def change(values):
        values[start:stop] = values[start]
        return values

    return change


def shift(size):
    """A zero that moves at sample 2500."""
    return lambda v: v + size * (np.arange(len(v)) > 2500)


FAULTS = {
    'stuck for 500 ms': (hip_angle(freeze(2000, 2250)), {'stuck', 'zero_shift'}),
    'stuck for 100 ms': (hip_angle(freeze(2000, 2050)), {'stuck', 'zero_shift'}),
    'stuck for 50 ms': (hip_angle(freeze(2000, 2025)), {'stuck', 'zero_shift'}),
    'dead from 4 s on': (hip_angle(freeze(2000, 9999)), {'stuck', 'still'}),
    'shift 100 mrad': (hip_angle(shift(0.1)), {'zero_shift'}),
    'shift 20 mrad': (hip_angle(shift(0.02)), {'zero_shift'}),
    'shift 10 mrad': (hip_angle(shift(0.01)), {'zero_shift'}),
    'shift 5 mrad': (hip_angle(shift(0.005)), {'zero_shift'}),
    'clipped at 0.15 rad': (hip_angle(lambda v: np.clip(v, -0.15, 0.15)), {'clipped', 'stuck'}),
    'clipped at 0.25 rad': (hip_angle(lambda v: np.clip(v, -0.25, 0.25)), {'clipped', 'stuck'}),
}


def main(seeds):
    print(f'{"healthy":34s} {"unusable":>9s} {"warnings":>9s}   codes')
    for name, options in HEALTHY.items():
        raws = [synthesise(Synthesis(**options), seed) for seed in range(seeds)]
        reports = [check_recording(raw) for raw in raws]
        verdicts = Counter(report.verdict for report in reports)
        codes = {f.code for r in reports for f in r.findings if f.severity != 'info'}
        print(f'{name:34s} {verdicts["unusable"] / seeds:9.1%} {verdicts["warnings"] / seeds:9.1%}'
              f'   {", ".join(sorted(codes))}')
    print(f'\n{"fault of the hip encoder":34s} {"found":>9s} {"unusable":>9s}')
    for name, (fault, codes) in FAULTS.items():
        reports = [check_recording(fault(synthesise(Synthesis(), seed))) for seed in range(seeds)]
        found = sum(any(f.code in codes for f in r.findings) for r in reports)
        unusable = sum(r.verdict == 'unusable' for r in reports)
        print(f'{name:34s} {found / seeds:9.1%} {unusable / seeds:9.1%}')


if __name__ == '__main__':
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 50)
