"""Real machines: import, check, identify, diagnose, and judge on records no choice has seen.

    ./cg exec python bench/real_data.py DATA_DIR [--only NAME] [--out FILE]

DATA_DIR holds the folders of docs/data.md. Each set is cut into records that the diagnosis may
use (it splits them into training and held-out by itself, to choose among effects) and records on
which nothing is chosen or fitted but each record's initial motion: those judge.
"""

import argparse
import fnmatch
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_sysid.bags import read_bag
from cg_sysid.candidates import believing
from cg_sysid.check import check_recording
from cg_sysid.diagnose import diagnose
from cg_sysid.diagnosis import Options
from cg_sysid.identify import fit, predict, score
from cg_sysid.importing import import_to_bags
from cg_sysid.text import measured
from cg_sysid.trial import prepare


def rms(error):
    return float(np.sqrt(np.nanmean(error**2)))


def mean_absolute(error):
    return float(np.nanmean(np.abs(error)))


@dataclass(frozen=True)
class Study:
    """One data set and how it is judged.

    Attributes:
        mapping: Import mapping.
        folder: Folder of the data.
        model: Published model, the nominal one.
        judge: Name patterns of the records that judge.
        share: What of these the diagnosis may use, from their start; the rest judges.
        window: Length in s into which records are cut for the diagnosis; 0 for whole records.
        judge_window: The same for judging.
        measure: Error of one record and channel.
        summary: Over records.
    """

    mapping: str
    folder: str
    model: str
    judge: tuple[str, ...]
    window: float
    judge_window: float
    measure: Callable
    summary: Callable
    how: str
    share: float = 0.0


STUDIES = (
    Study('sydney_pendulum', 'sydney_compass_gait', 'sydney_pendulum', ('*pendulum_2*',), 6.0, 0.0,
          rms, np.mean, 'RMSE over the second half of the chirp, 20 s open loop', 0.5),
    Study('sydney_walking', 'sydney_compass_gait', 'sydney_compass_gait',
          ('*_e07_*', '*_e08_*', '*_e09_*'), 0.0, 0.0, rms, np.mean,
          'mean RMSE over the steps of experiments 7 to 9'),
    Study('dfki_double_pendulum', 'dfki_double_pendulum', 'dfki_double_pendulum',
          ('*-143601*', '*-144115*', '*-1545*'), 1.0, 1.0, rms, np.median,
          'median RMSE over windows of 1 s of two sine files and one swing-up'),
    Study('bam_servo_pendulum', 'bam_servo_pendulum', 'xl330_pendulum', ('*kp0200*',), 1.5, 0.0,
          mean_absolute, np.mean, 'mean MAE over the files of gain 200, replayed by duty'),
)  # fmt: skip


def windows(records, length):
    return [part for record in records for part in record.segments(length)] if length else records


def errors(study, model, trials):
    """Summary over records of the error of each channel, and chi2/N."""
    found = score(model, trials)
    table = []
    for trial, motion in zip(trials, found.motions, strict=True):
        difference = predict(model, trial, motion) - trial.outputs
        table.append([
            study.measure(c) if np.isfinite(c).any() else np.nan for c in difference.T
        ])
    return study.summary(np.array(table), axis=0)


def run(study, data, bags, workers):
    began = time.monotonic()
    nominal = Model.load(model_path(study.model))
    paths = import_to_bags(study.mapping, data / study.folder, bags / study.mapping)
    verdicts = [check_recording(path).verdict for path in paths]
    records = [read_bag(path) for path in paths]
    judging = [r for r in records if any(fnmatch.fnmatch(r.name, p) for p in study.judge)]
    usable = [r for r in records if r not in judging]
    if study.share:
        usable += [r.slice(0.0, study.share * r.duration) for r in judging]
        judging = [r.slice(study.share * r.duration, np.inf) for r in judging]
    judges = prepare(nominal, windows(judging, study.judge_window))
    used = windows(usable, study.window)
    refitted = fit(nominal, prepare(nominal, used)).model
    found = diagnose(nominal, used, Options(workers=workers))
    # The file's beliefs, and the effects found with their values as a start.
    structure = believing(found.extended.model, nominal, '')
    extended = fit(structure, prepare(nominal, used)).model
    rows = {'published': errors(study, nominal, judges)}
    zeroed = [e for e in extended.effects if any(p.each == 'recording' for p in e.parameters)]
    if zeroed:
        published = nominal
        for effect in zeroed:
            published = published.with_effect(
                effect.name, effect.at, **{p.name: p.neutral for p in effect.parameters}
            )
        rows['published, with a zero for each recording'] = errors(study, published, judges)
    rows |= {
        'published model, identified anew': errors(study, refitted, judges),
        'with the causes named': errors(study, extended, judges),
    }
    channels = nominal.mechanism.outputs
    present = [j for j in range(len(channels)) if np.isfinite(rows['published'][j])]
    lines = [
        f'### {study.mapping}',
        '',
        f'{len(paths)} recordings imported; check: '
        + ', '.join(f'{verdicts.count(v)} {v}' for v in sorted(set(verdicts))) + '. '
        f'{len(used)} records used by the diagnosis, {len(judges)} judge: {study.how}.',
        '',
        f'Verdict **{found.verdict}**. {found.summary}',
        '',
        '| model | ' + ' | '.join(f'{channels[j]}, {nominal.mechanism.output_units[j]}'
                                   for j in present) + ' |',
        '|---|' + '---|' * len(present),
    ]
    for name, row in rows.items():
        lines.append(f'| {name} | ' + ' | '.join(f'{row[j]:.5f}' for j in present) + ' |')
    floor = judges[0].sigma
    lines.append('| noise floor | ' + ' | '.join(f'{floor[j]:.5f}' for j in present) + ' |')
    lines += ['', '| cause | parameters | evidence, nats | could also be |', '|---|---|---|---|']
    for cause in found.causes:
        numbers = ', '.join(
            f'{name} {measured(value, sigma, unit)}'
            for name, (value, sigma, unit) in cause.parameters.items()
        )
        lines.append(
            f'| {cause.label} | {numbers} | {cause.evidence:.0f} '
            f'| {", ".join(cause.rivals) or "-"} |'
        )
    lines += ['', f'{time.monotonic() - began:.0f} s.', '']
    return '\n'.join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('data', type=Path)
    parser.add_argument('--only')
    parser.add_argument('--workers', type=int)
    parser.add_argument('--out', type=Path)
    options = parser.parse_args()
    parts = []
    for study in STUDIES:
        if options.only and study.mapping != options.only:
            continue
        with tempfile.TemporaryDirectory() as bags:
            parts.append(run(study, options.data, Path(bags), options.workers))
        print(parts[-1], flush=True)
    if options.out:
        options.out.write_text('\n'.join(parts))


if __name__ == '__main__':
    main()
