"""Real machines: import, check, identify, diagnose, and judge on records no choice has seen.

    ./cg exec python bench/real_data.py DATA_DIR [--only NAME] [--budget SECONDS] [--write FILE]

DATA_DIR holds the folders of data.md. Each set is cut into records that the diagnosis may
use (it splits them into training and held-out by itself, to choose among effects) and records on
which nothing is chosen or fitted but each record's start: those judge. Records are whole wherever
the whole can be followed (cg_sysid/following.py).

They judge twice. *Start fitted*: initial angles and rates of each record are fitted. *Start
measured*: the angles are those measured, by a curve through the first samples, and the rates are
fitted, over as much of each record as measured angles carry (cg_sysid/measured_start.py), the same
stretch for every model.
"""

import argparse
import fnmatch
import resource
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_sysid.checks.recordings import check_recording
from cg_sysid.deadline import Deadline
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit, predict, score
from cg_sysid.identification.measured_start import carried, from_measured_angles
from cg_sysid.identification.windows import Windows, followed, windows_of
from cg_sysid.records.bags import read_bag
from cg_sysid.records.importing import import_to_bags
from cg_sysid.text import measured

BUDGET = 600.0  # s


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
        measure: Error of one record and channel.
        summary: Over records.
        how: What that is, in words.
        zeroed: Encoders that were zeroed anew for each recording; the published model is judged
            with a zero of each judging record's own as well, fitted like its start.
        share: What of the judging records the diagnosis may use, from their start.
    """

    mapping: str
    folder: str
    model: str
    judge: tuple[str, ...]
    measure: Callable
    summary: Callable
    how: str
    zeroed: tuple[str, ...] = ()
    share: float = 0.0


STUDIES = (
    Study('sydney_pendulum', 'sydney_compass_gait', 'sydney_pendulum', ('*pendulum_2*',),
          rms, np.mean, 'RMSE over the second half of the chirp, 20 s open loop', ('angle',), 0.5),
    Study('bam_servo_pendulum', 'bam_servo_pendulum', 'xl330_pendulum', ('*kp0200*',),
          mean_absolute, np.mean, 'mean MAE over the files of gain 200, replayed by duty'),
    Study('dfki_double_pendulum', 'dfki_double_pendulum', 'dfki_double_pendulum',
          ('*-143601*', '*-144115*', '*-1545*'), rms, np.median,
          'median RMSE over two sine files of 10 s and the windows of one swing-up',
          ('shoulder_angle', 'elbow_angle')),
    Study('sydney_walking', 'sydney_compass_gait', 'sydney_compass_gait',
          ('*_e07_*', '*_e08_*', '*_e09_*'), rms, np.mean,
          'mean RMSE over the steps of experiments 7 to 9'),
)  # fmt: skip


def as_followed(model, records):
    """Records, whole or cut where they cannot be followed, and what is told about it."""
    found = followed(model, records)
    parts = [p for r, f in zip(records, found, strict=True) for p in windows_of(r, f)]
    return parts, Windows(found).text


def errors(study, model, judges, rows):
    """Summary over records of the error of each channel, for each way to judge."""
    fitted = score(model, judges)
    ways = [(judges, fitted)]
    if rows:
        held = from_measured_angles(model.mechanism, judges, fitted, rows)
        ways.append((held, score(model, held, own=fitted.own_by_name(judges))))
    summaries = []
    for data_sets, found in ways:
        table = []
        for data_set, motion in zip(data_sets, found.motions, strict=True):
            difference = predict(model, data_set, motion) - data_set.outputs
            table.append(
                [study.measure(c) if np.isfinite(c).any() else np.nan for c in difference.T]
            )
        summaries.append(study.summary(np.array(table), axis=0))
    return np.array(summaries)


def cpu_seconds():
    """Of this process and of those that it has waited for."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in used)


def run(study, data, bags, workers, budget):
    began = cpu_seconds()
    nominal = Model.load(model_path(study.model))
    paths = import_to_bags(study.mapping, data / study.folder, bags / study.mapping)
    verdicts = [check_recording(path).verdict for path in paths]
    records = [read_bag(path) for path in paths]
    judging = [r for r in records if any(fnmatch.fnmatch(r.name, p) for p in study.judge)]
    usable = [r for r in records if r not in judging]
    if study.share:
        usable += [r.slice(0.0, study.share * r.duration) for r in judging]
        judging = [r.slice(study.share * r.duration, np.inf) for r in judging]
    parts, judged_as = as_followed(nominal, judging)
    used, used_as = as_followed(nominal, usable)
    judges = prepare(nominal, parts)
    carry = carried(judges, score(nominal, judges))
    refitted = fit(nominal, prepare(nominal, used)).model
    before = cpu_seconds()
    found = diagnose(nominal, used, Options(workers=workers), deadline=Deadline(budget))
    searched = cpu_seconds() - before
    rows = {'published': errors(study, nominal, judges, carry)}
    if study.zeroed:
        published = nominal
        for sensor in study.zeroed:
            published = published.with_effect('encoder_zero', sensor)
        rows['published, with a zero for each recording'] = errors(study, published, judges, carry)
    rows |= {
        'published model, identified anew': errors(study, refitted, judges, carry),
        'with the causes named': errors(study, found.model, judges, carry),
    }
    channels = nominal.mechanism.outputs
    present = [j for j in range(len(channels)) if np.isfinite(rows['published'][0, j])]
    heads = [
        f'{channels[j]}, {nominal.mechanism.output_units[j]}, start {way}'
        for way in ('fitted', 'measured')[: 1 + bool(carry)] for j in present
    ]  # fmt: skip
    lasts = [float(t.time[carry[t.name] - 1]) for t in judges if t.name in carry]
    lines = [
        f'### {study.mapping}',
        '',
        f'{len(paths)} recordings imported; check: '
        + ', '.join(f'{verdicts.count(v)} {v}' for v in sorted(set(verdicts))) + '. '
        f'{len(used)} records used by the diagnosis ({used_as}), {len(judges)} judge '
        f'({judged_as}): {study.how}. '
        + (f'Measured angles carry {len(carry)} of them, for {min(lasts):.2g} to '
           f'{max(lasts):.2g} s.' if carry else 'Measured angles carry none of them.'),
        '',
        f'Verdict **{found.verdict}**. {found.summary}',
        *(f'Note: {finding}.' for finding in found.findings),
        '',
        '| model | ' + ' | '.join(heads) + ' |',
        '|---|' + '---|' * len(heads),
    ]  # fmt: skip
    for name, row in rows.items():
        lines.append(
            f'| {name} | ' + ' | '.join(f'{v:.5f}' for v in row[:, present].ravel()) + ' |'
        )
    floor = [f'{judges[0].sigma[j]:.5f}' for _ in rows['published'] for j in present]
    lines.append('| noise floor | ' + ' | '.join(floor) + ' |')
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
    lines += ['', f'{cpu_seconds() - began:.0f} CPU s, of which the diagnosis {searched:.0f}.', '']
    return '\n'.join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('data', type=Path)
    parser.add_argument('--only')
    parser.add_argument('--workers', type=int)
    parser.add_argument('--budget', type=float, default=BUDGET, help='of each diagnosis, in s')
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    parts = []
    for study in STUDIES:
        if options.only and study.mapping != options.only:
            continue
        with tempfile.TemporaryDirectory() as bags:
            parts.append(run(study, options.data, Path(bags), options.workers, options.budget))
        print(parts[-1], flush=True)
        if options.write:
            options.write.write_text('\n'.join(parts), encoding='utf-8')


if __name__ == '__main__':
    main()
