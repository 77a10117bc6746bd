"""What the check says about recordings of real machines: refusals, warnings, and why.

    ./cg exec python bench/check_real.py DATA_DIR [--plots DIR] [--write FILE]

DATA_DIR holds the folders of data.md. Every recording that can be imported is checked with
its published model and without one. `uncut` is the file that its mapping cuts where the encoder
was zeroed anew, whole: a fault that the check must find. A refusal has a row with what is behind
it, as far as somebody looked, and a picture of the signal around it in the folder of `--plots`.
"""

import argparse
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from matplotlib.figure import Figure

from cg_description.paths import model_path
from cg_sysid.checks.faults import fault_signals
from cg_sysid.checks.recordings import check_recording
from cg_sysid.records import importing
from cg_sysid.records.bags import read_raw
from cg_sysid.records.importing import import_to_bags

# Set: mapping, folder, published model.
SETS = {
    'sydney_pendulum': ('sydney_pendulum', 'sydney_compass_gait', 'sydney_pendulum'),
    'sydney_pendulum, uncut': ('sydney_pendulum', 'sydney_compass_gait', 'sydney_pendulum'),
    'sydney_walking': ('sydney_walking', 'sydney_compass_gait', 'sydney_compass_gait'),
    'dfki_double_pendulum': (
        'dfki_double_pendulum', 'dfki_double_pendulum', 'dfki_double_pendulum'),
    'dfki_double_pendulum_command': (
        'dfki_double_pendulum_command', 'dfki_double_pendulum', 'dfki_double_pendulum'),
    'bam_servo_pendulum': ('bam_servo_pendulum', 'bam_servo_pendulum', 'xl330_pendulum'),
}  # fmt: skip
# What is behind a refusal, by set and finding; a refusal that is not here is to be looked into.
REASONS = {
    ('sydney_pendulum, uncut', 'zero_shift'): 'real: the angle jumps to exactly 0 within one '
    'sample, as the encoder was zeroed anew; friction over weight is 18.0 mrad, the jump 18.4',
}


def bags(name: str, data: Path, out: Path) -> list[Path]:
    """The recordings of a set as bags."""
    mapping, folder, _ = SETS[name]
    content = importing.load_mapping(mapping)
    if name.endswith('uncut'):
        del content['split']
    return import_to_bags(content, data / folder, out / name.replace(', ', '_'))


def plot(raw, report, folder: Path) -> None:
    """The signal around each fault of a recording, one picture each."""
    folder.mkdir(parents=True, exist_ok=True)
    for signal in fault_signals(raw, report):
        figure = Figure(figsize=(7, 3), layout='constrained')
        axes = figure.add_subplot(
            xlabel='s',
            ylabel=f'{signal.channel}, {signal.unit}',
            title=f'{report.name}: {signal.code}',
        )
        axes.plot(signal.time, signal.values, '.-', lw=0.6, ms=3)
        axes.axvspan(signal.start, signal.stop, color='tab:red', alpha=0.3)
        figure.savefig(folder / f'{report.name}_{signal.code}_{signal.channel}.png', dpi=100)


def tables(data: Path, plots: Path | None) -> Iterator[str]:
    """Lines of the two tables."""
    refusals = []
    yield '| set | recordings | refused | refused without a model | warnings: recordings |'
    yield '|---|---:|---:|---:|---|'
    for name, (_, _, model) in SETS.items():
        with tempfile.TemporaryDirectory() as out:
            raws = [read_raw(path) for path in bags(name, data, Path(out))]
        reports = [check_recording(raw, model_path(model)) for raw in raws]
        alone = [check_recording(raw) for raw in raws]
        told: Counter[str] = Counter()
        for raw, report in zip(raws, reports, strict=True):
            told.update(sorted({f.code for f in report.findings if f.severity == 'warning'}))
            refusals += [(name, report.name, f) for f in report.findings if f.severity == 'error']
            if plots is not None and report.verdict == 'unusable':
                plot(raw, report, plots)
        refused, blind = (sum(r.verdict == 'unusable' for r in rs) for rs in (reports, alone))
        words = ', '.join(f'`{code}` {count}' for code, count in told.most_common())
        yield f'| {name} | {len(raws)} | {refused} | {blind} | {words} |'
    yield ''
    yield '| set | recording | finding | where | what the check says | what is behind it |'
    yield '|---|---|---|---|---|---|'
    for name, recording, f in refusals:
        reason = REASONS.get((name, f.code), 'not looked into')
        yield (
            f'| {name} | {recording} | `{f.code}` | {f.where} {f.place} | {f.text} | {reason} |'
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('data', type=Path)
    parser.add_argument('--plots', type=Path, help='folder for pictures of the refusals')
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    lines = []
    for line in tables(options.data, options.plots):
        lines.append(line)
        print(line, flush=True)
    if options.write:
        options.write.write_text(
            '# Recordings of real machines: what the check says\n\nCommand: `python '
            'bench/check_real.py DATA_DIR --plots DIR`. '
            + ' '.join(__doc__.split('\n\n')[2].split())
            + '\n\n'
            + '\n'.join(lines)
            + '\n'
        )


if __name__ == '__main__':
    main()
