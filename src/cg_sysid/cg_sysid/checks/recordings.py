"""Check of a recording before any fit: is it what it claims to be, and what is it good for?

    python3 -m cg_sysid check BAG [BAG ...] [--json] [--model FILE] [--note NOTE.yaml]

The checks themselves are in clock.py, check_timing.py and check_jitter.py (stamps),
check_signals.py and check_steps.py (single signals), check_kinematics.py (IMU against itself),
check_dynamics.py (motion against torque), check_signs.py (signs of all channels together) and
check_content.py (note, coverage, feedback).
"""

import argparse
import json
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from rich.console import Console

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_interfaces.channels import Mechanism, interface
from cg_sysid.checks.content import check_content
from cg_sysid.checks.dynamics import check_dynamics
from cg_sysid.checks.following import check_following
from cg_sysid.checks.kinematics import check_kinematics
from cg_sysid.checks.sampling import check_jitter
from cg_sysid.checks.shifts import check_steps
from cg_sysid.checks.signals import check_signals, read_signals
from cg_sysid.checks.signs import check_signs
from cg_sysid.checks.timing import check_timing
from cg_sysid.errors import RecordingError
from cg_sysid.identification.data_set import other_robot
from cg_sysid.progress import Bars
from cg_sysid.records.bags import RawRecording, load_note, read_raw, to_record
from cg_sysid.records.clock import mend_clocks
from cg_sysid.records.findings import CheckReport, Finding, make_report, overrulable, overrule
from cg_sysid.stances.touchdown import find_touchdowns

LANDING_S = 0.08  # s that a landing blurs on either side; twice that where the foot bounces


def check_recording(
    recording: str | Path | RawRecording,
    model: str | Path | None = None,
    use_region: Mapping[str, tuple[float, float]] | None = None,
    note: Mapping[str, Any] | None = None,
    use_anyway: Iterable[str] = (),
) -> CheckReport:
    """Check a recording.

    Args:
        recording: Path of a bag, or a recording as `read_raw` returns it.
        model: Model file that the recording is about to be used with; a bag that names no robot
            is of that model's.
        use_region: Quantity -> (lowest, highest) value at which the model will be used, for
            channels and rates of angles, such as `{'hip_angle_rate': (-2.0, 2.0)}`.
        note: Recording note for a bag that carries none.
        use_anyway: Names of findings that make no recording unusable; `findings.OVERRULABLE` has
            those that may be named.

    Returns:
        The findings. A bag that cannot be read at all gives the one finding `unreadable`.

    Raises:
        ValueError: `use_anyway` names what cannot be overruled.
    """
    anyway = overrulable(use_anyway)
    robot, mechanism, unreadable = _model(model)
    try:
        raw = (
            recording
            if isinstance(recording, RawRecording)
            else read_raw(recording, note, mechanism)
        )
        setup_error = _setup_error(raw)
    except RecordingError as error:
        name = Path(str(recording)).name
        return make_report(name, [Finding('unreadable', 'error', '', str(error))])
    if setup_error:
        return make_report(raw.name, [setup_error])
    raw, clocks = mend_clocks(raw)
    signals = read_signals(raw)
    timing = [*clocks, *check_timing(raw), *check_jitter(signals)]
    findings = [*overrule([*timing, *check_signals(raw, signals)], anyway)]
    # What depends on several samples makes no sense where single ones, or their stamps, are wrong.
    faulty = {finding.where for finding in findings if finding.severity == 'error'}
    sane = {n: s for n, s in signals.items() if not faulty & {n, s.topic}}
    if robot is not None and other_robot(raw.mechanism, robot):
        robot = None
    jumps = [*check_steps(raw, sane, robot), *check_kinematics(sane)]
    findings += overrule(_not_of_landings(raw, robot, jumps), anyway)
    sound = not any(finding.severity == 'error' for finding in findings)
    findings += overrule(check_dynamics(raw, signals, sound), anyway)
    findings += [*overrule(check_signs(raw, sane, robot), anyway), *unreadable]
    findings += overrule(check_following(raw, sane), anyway)
    findings += check_content(raw, signals, model, use_region)
    if not any(finding.severity == 'error' for finding in findings):
        findings += _refused(raw)
    return make_report(raw.name, _once(findings))


def _setup_error(raw: RawRecording) -> Finding | None:
    try:
        _ = raw.setup
    except RecordingError as error:
        return Finding('setup_wrong', 'error', '', str(error))
    return None


def _model(
    path: str | Path | None,
) -> tuple[Model | None, Mechanism | None, list[Finding]]:
    """The model in a file, and its channels; signs are compared without one, too."""
    if path is None:
        return None, None, []
    try:
        model = Model.load(path)
        return model, interface(model.mechanism), []
    except ValueError as error:
        return None, None, [Finding('model_unreadable', 'info', '', str(error))]


def _not_of_landings(
    raw: RawRecording, robot: Model | None, jumps: list[Finding]
) -> list[Finding]:
    """Findings less those jumps that a foot made which landed, bounced or slid."""
    if robot is None or not any(jump.code == 'zero_shift' for jump in jumps):
        return jumps
    try:
        landed = [touchdown.time for touchdown in find_touchdowns(to_record(raw), robot)]
    except RecordingError:
        return jumps
    return [
        jump for jump in jumps
        if jump.code != 'zero_shift' or jump.start_s is None
        or not any(-LANDING_S < jump.start_s - time < 2 * LANDING_S for time in landed)
    ]  # fmt: skip


def _refused(raw: RawRecording) -> list[Finding]:
    """What reading refuses must never pass as usable."""
    try:
        to_record(raw)
    except RecordingError as error:
        return [Finding('refused', 'error', '', str(error))]
    return []


def _once(findings: list[Finding]) -> list[Finding]:
    """Findings without repeats: one code per channel and place is enough."""
    seen, kept = set(), []
    for finding in findings:
        key = (finding.code, finding.where, finding.start_s)
        if key not in seen:
            seen.add(key)
            kept.append(finding)
    return kept


def parse_region(text: str) -> tuple[str, tuple[float, float]]:
    """A region of use such as `hip_angle_rate=-2:2`.

    Raises:
        ValueError: The text is none.
    """
    name, _, limits = text.partition('=')
    low, colon, high = limits.partition(':')
    if not name or not colon:
        msg = f'use region {text!r}: expected NAME=LOW:HIGH, such as hip_angle=-0.3:0.3'
        raise ValueError(msg)
    return name, (float(low), float(high))


def use_anyway_option(parser: argparse.ArgumentParser) -> None:
    """The option that overrules the check."""
    parser.add_argument(
        '--use-anyway', action='append', default=[], metavar='FINDING',
        help='use recordings in spite of this finding of the check, such as zero_shift; the '
        'answer says so; may be repeated',
    )  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Command line: check recordings. Exit code 0 if all are usable, 1 otherwise."""
    parser = argparse.ArgumentParser(prog='cg check', description='Check recordings before use.')
    parser.add_argument('bags', nargs='+', help='bag directories')
    parser.add_argument('--json', action='store_true', help='print JSON')
    parser.add_argument('--model', help='that they will be used with: a model file or a name')
    parser.add_argument('--note', help='YAML file with the recording note, for bags without one')
    parser.add_argument(
        '--use-region',
        action='append',
        default=[],
        metavar='NAME=LOW:HIGH',
        help='where the model will be used; may be repeated',
    )
    use_anyway_option(parser)
    args = parser.parse_args(argv)
    try:
        region = dict(parse_region(text) for text in args.use_region)
        note = load_note(args.note) if args.note else None
        model = model_path(args.model) if args.model else None
        anyway = overrulable(args.use_anyway)
    except (OSError, ValueError) as error:
        print(f'error: {error}', file=sys.stderr)
        return 2
    reports = []
    with Bars('cg check') as bars:
        for done, bag in enumerate(args.bags):
            bars('checking recordings', done, len(args.bags))
            reports.append(check_recording(bag, model, region, note, anyway))
    if args.json:
        print(json.dumps([report.to_dict() for report in reports], indent=1, default=float))
    else:
        console = Console()
        for report in reports:
            report.print(console)
    return 1 if any(report.verdict == 'unusable' for report in reports) else 0


if __name__ == '__main__':
    sys.exit(main())
