"""Regular stamps, irregular sampling, odd rounding: told, not refused, and no false alarm.

    ./cg exec python bench/hidden_jitter.py [--seeds 30] [--write FILE]

*Free swings* are smooth motions of a double pendulum without torque, 8 s at 500 Hz. They are
rounded as encoders do, behind a calibration curve that is no straight line, in half precision, or
not at all beside white noise, and sampled at instants that are off by some ms RMS, which the
stamps do not say. *Refused*: called unusable. *Told*: a finding `jitter`, with the median of its
sizes. The second table counts false alarms among the sound synthetic recordings of check_rates.py
and of the free swings, stamps that jitter and say so among them.
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from check_rates import SYNTHETIC

from cg_sysid.checks.recordings import check_recording
from cg_sysid.experiments.synthetic import Synthesis, synthesise

RATE = 500.0
FREE = {
    'mechanism': 'double_pendulum',
    'torque': 'zero',
    'bandwidth': 1.0,
    'amplitude': 1.5,
    'quantum': 0.0,
}
COUNT = 2 * np.pi / 8192
JITTER = (0.0, 1e-4, 2e-4, 4e-4, 1e-3)


def bent(values):
    """Counts behind a calibration curve: no one quantum fits them."""
    counts = COUNT * np.rint(values / COUNT)
    return counts + 4e-3 * np.sin(counts) + 2e-3 * np.cos(2.0 * counts)


ROUNDING = {
    'counts': lambda v: COUNT * np.rint(v / COUNT),
    'counts behind a curve': bent,
    'half precision': lambda v: v.astype(np.float16).astype(float),
    'noise 0.3 mrad': None,
}


def swing(seed, sigma, rounding):
    """A free swing, its stamps regular whatever its sampling was."""
    change = ROUNDING[rounding]
    options = FREE if change else FREE | {'noise': 3e-4}
    raw = synthesise(Synthesis(jitter=sigma * RATE * np.sqrt(12.0), **options), seed)
    topics = {}
    for name, t in raw.topics.items():
        stamp = t.stamp_ns[0] + np.rint(np.arange(len(t)) * 1e9 / RATE).astype(np.int64)
        values = (
            t.values
            if change is None or name != '/joint_states'
            else {channel: change(v) for channel, v in t.values.items()}
        )
        topics[name] = replace(t, stamp_ns=stamp, values=values)
    return replace(raw, topics=topics)


def told_table(seeds) -> Iterator[str]:
    yield '| free swings, rounded as | jitter, ms RMS | cases | refused, by | told | told, ms |'
    yield '|---|---:|---:|---|---:|---:|'
    for rounding in ROUNDING:
        for sigma in JITTER:
            reports = [check_recording(swing(seed, sigma, rounding)) for seed in range(seeds)]
            refused = [r for r in reports if r.verdict == 'unusable']
            codes = {f.code for r in refused for f in r.findings if f.severity == 'error'}
            by = f' ({", ".join(sorted(codes))})' if codes else ''
            sizes = [1e3 * max(f.value for f in r.of('jitter')) for r in reports if r.of('jitter')]
            size = f'{np.median(sizes):.2f}' if sizes else '-'
            yield (
                f'| {rounding} | {1e3 * sigma:g} | {seeds} | {len(refused)}{by} | {len(sizes)} '
                f'| {size} |'
            )


def false_table(seeds) -> Iterator[str]:
    yield '| sound recordings | cases | false `jitter` |'
    yield '|---|---:|---:|'
    total = wrong = 0
    for name, options in ({'as they come': {}} | SYNTHETIC).items():
        reports = [check_recording(synthesise(Synthesis(**options), s)) for s in range(seeds)]
        alarms = sum(bool(report.of('jitter')) for report in reports)
        total, wrong = total + seeds, wrong + alarms
        yield f'| {name} | {seeds} | {alarms} |'
    yield f'| **all** | **{total}** | **{wrong}** |'


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seeds', type=int, default=30)
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    lines = []
    for table in (told_table, false_table):
        for line in (*table(options.seeds), ''):
            lines.append(line)
            print(line, flush=True)
    if options.write:
        options.write.write_text(
            '# Hidden jitter and odd rounding: told, not refused\n\nCommand: `python '
            f'bench/hidden_jitter.py --seeds {options.seeds}`. '
            + ' '.join(__doc__.split('\n\n')[2].split())
            + '\n\n'
            + '\n'.join(lines).rstrip()
            + '\n'
        )


if __name__ == '__main__':
    main()
