"""Checks of what a recording is about: its note, its start, its coverage, its excitation."""

import hashlib
from collections.abc import Iterator, Mapping
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from cg_interfaces.stamps import NS_PER_S
from cg_interfaces.topics import APPLIED_TORQUE, JOINT_STATES, TORQUE_COMMAND
from cg_sysid.checks.signals import Signal
from cg_sysid.records.findings import Finding
from cg_sysid.records.raw import RawRecording

WANTED = (
    'experiment',
    'nominal_rate_hz',
    'sensor_zeros',
    'zeroed_at',
    'initial_state',
    'model_file',
    'model_sha256',
    'software',
)
ZERO_AGE_S = 24 * 3600.0  # sensor zeros older than this are stale, in s
START_S = 0.06  # the start of a recording, in s
REST_RATE = 0.1  # rate below which a start counts as rest, in rad/s
UPRIGHT = 0.02  # a start this close to the upright can fall either way, in rad
LITTLE_MOTION = 10.0  # motion over the noise floor below which there is none, [1]
SLOPE_S = 0.03  # rates for the coverage are slopes over this span, in s
WELL_COVERED = 0.5  # share of the region of use that the data should cover, [1]
FEEDBACK = 0.9  # share of the torque's variance that angles and rates explain, [1]
NARROW_BAND = 0.8  # share of the torque's power in one line: a sine proves no feedback, [1]
LINE = 4  # bins of the spectrum that one line spreads over


def check_content(
    raw: RawRecording,
    signals: dict[str, Signal],
    model: str | Path | None = None,
    use_region: Mapping[str, tuple[float, float]] | None = None,
) -> Iterator[Finding]:
    """Findings about the note and about what the data cover.

    Args:
        raw: The recording.
        signals: Its channels.
        model: Model file that the recording is about to be used with.
        use_region: Quantity -> (lowest, highest) value at which the model will be used. A
            quantity is a channel or a channel's rate, such as `hip_angle_rate`.
    """
    yield from _topics(raw)
    yield from _note(raw)
    yield from _checklist(raw)
    if model is not None:
        yield from _model(raw, Path(model))
    yield from _start(raw, signals)
    rates = {f'{n}_rate': _slope(s) for n, s in signals.items() if s.is_position}
    yield from _coverage(raw, signals, rates, use_region or {})
    yield from _excitation(raw, signals)
    yield from _closed_loop(raw, signals, rates)


def _topics(raw: RawRecording) -> Iterator[Finding]:
    """Topics that should be there."""
    known = raw.mechanism
    tied = raw.setup.fixture == 'legs_tied'
    if APPLIED_TORQUE not in raw.topics and not tied and not raw.told:
        if raw.torque_topic == TORQUE_COMMAND:
            yield Finding(
                'topic_missing',
                'warning',
                APPLIED_TORQUE,
                'missing; the torque command is used as the input instead',
            )
        elif raw.torque_topic:
            yield Finding(
                'topic_missing',
                'info',
                APPLIED_TORQUE,
                f'missing; the effort on {raw.torque_topic} is used as the input instead',
            )
        else:
            effort = f', nor effort on {JOINT_STATES}' if JOINT_STATES in known.topics else ''
            yield Finding(
                'topic_missing',
                'error',
                APPLIED_TORQUE,
                f'missing, and there is no {TORQUE_COMMAND} either{effort}',
            )
    if raw.told and raw.told not in raw.topics:
        yield Finding('topic_missing', 'error', raw.told, 'missing; the note says that drives '
                      'were told positions on it')  # fmt: skip
    present = [topic for topic in known.outputs if topic.name in raw.topics]
    for topic in known.outputs:
        if topic not in present:
            yield Finding(
                'topic_missing',
                'warning' if present else 'error',
                topic.name,
                'missing; its channels are ' + ', '.join(c.name for c in topic.channels),
            )
    for topic in present:
        lacking = [c for c in topic.channels if c.name not in raw.topics[topic.name].values]
        if lacking:
            yield Finding(
                'topic_missing',
                'warning',
                topic.name,
                'holds no ' + ', '.join(f'{c.place} ({c.name})' for c in lacking),
            )


def _note(raw: RawRecording) -> Iterator[Finding]:
    """The recording note: complete, and zeros taken not long ago."""
    missing = [key for key in WANTED if raw.note.get(key) in (None, '')]
    if 'setup' not in raw.note:
        missing.insert(0, 'setup')
    if missing:
        yield Finding(
            'metadata_missing',
            'warning' if 'setup' in missing else 'info',
            '',
            f'the note does not say {", ".join(missing)}',
            value=missing,
        )
    zeroed_at = raw.note.get('zeroed_at')
    when = _instant(zeroed_at)
    if when is None:
        yield Finding(
            'zeroing_unknown',
            'warning',
            '',
            'when the sensors were zeroed is not '
            f'known (zeroed_at: {zeroed_at!r}); an ISO 8601 time is needed',
        )
        return
    stamps = [int(t.stamp_ns.min()) for t in raw.topics.values() if len(t)]
    if not stamps:
        return
    age = min(stamps) / NS_PER_S - when
    if age > ZERO_AGE_S or age < -60.0:
        text = f'{age / 3600.0:.1f} h before' if age > 0 else f'{-age / 3600.0:.1f} h after'
        yield Finding(
            'zeroing_stale',
            'warning',
            '',
            f'the sensors were zeroed {text} the recording',
            value=age,
            allowed=ZERO_AGE_S,
        )


def _checklist(raw: RawRecording) -> Iterator[Finding]:
    """What was tried of the robot before it was recorded; nothing of notes that do not say."""
    checklist = raw.note.get('checklist')
    if checklist is None:
        return
    if not checklist.get('date'):
        yield Finding('checklist', 'info', '', 'recorded without a checklist of the robot')
        return
    failed, left = checklist.get('failed') or (), checklist.get('not_checked') or ()
    told = [f'passed {checklist.get("passed", 0)} of {checklist.get("of", 0)}']
    told += [f'{title} failed' for title in failed]
    told += [f'{title} not checked' for title in left]
    yield Finding(
        'checklist', 'warning' if failed else 'info', '',
        f'checklist of {checklist["date"]}: {", ".join(told)}', value=checklist.get('file'),
    )  # fmt: skip


def _instant(value: object) -> float | None:
    """Seconds since 1970 of an ISO 8601 time, None if it is none."""
    if isinstance(value, str):
        try:
            value = datetime.fromisoformat(value.replace('Z', '+00:00'))
        except ValueError:
            return None
    if not isinstance(value, datetime):
        return None
    return (value if value.tzinfo else value.replace(tzinfo=timezone.utc)).timestamp()


def _model(raw: RawRecording, model: Path) -> Iterator[Finding]:
    recorded = raw.note.get('model_sha256')
    if recorded and hashlib.sha256(model.read_bytes()).hexdigest() != recorded:
        yield Finding(
            'model_differs',
            'info',
            '',
            f'recorded with another version of the model '
            f'than {model.name} (its hash is not the one in the note)',
        )


def _start(raw: RawRecording, signals: dict[str, Signal]) -> Iterator[Finding]:
    """A start that is not at rest as stated, or that can fall either way."""
    known = raw.mechanism
    begins = {}
    for name in known.output_names:
        signal = signals.get(name)
        if signal is None or not signal.is_position:
            continue
        early = signal.time <= signal.time[0] + START_S
        if early.sum() < 5:
            continue
        time = signal.time[early] - signal.time[0]
        curvature, slope, _ = (float(c) for c in np.polyfit(time, signal.values[early], 2))
        # Standard error of the slope of a parabola at the end of its N samples; and a torque or
        # a fall that sets in within the span changes the rate by this much.
        spread = 5.0 * signal.noise.sigma_floor * np.sqrt(192.0 / early.sum()) / START_S
        spread += abs(curvature) * START_S
        begins[name] = (float(np.mean(signal.values[early])), slope, spread)
    moving = [n for n, (_, v, s) in begins.items() if abs(v) > REST_RATE + s]
    for name in moving if raw.note.get('initial_state') == 'rest' else ():
        rate = begins[name][1]
        yield Finding(
            'not_at_rest',
            'warning',
            name,
            f'the note says that the motion starts from '
            f'rest, but this moves at {rate:.3g} {signals[name].unit}/s',
            0.0,
            START_S,
            0,
            rate,
            REST_RATE,
        )
    free = raw.mechanism.name == 'compass_gait' and raw.setup.fixture == 'none'
    if free and not raw.setup.springs and 'imu_angle' in begins and not moving:
        lean = begins['imu_angle'][0] - (
            begins.get('hip_angle', (0.0,))[0] if raw.setup.stance == 'outer' else 0.0
        )
        if abs(lean) < UPRIGHT:
            yield Finding(
                'poor_start',
                'warning',
                'imu_angle',
                'starts at rest near the upright: a small change decides which way it falls',
                0.0,
                START_S,
                0,
                lean,
                UPRIGHT,
            )


def _slope(signal: Signal) -> np.ndarray:
    """Central slopes over about `SLOPE_S`, shape (M,), in 1/s times the signal's unit."""
    reach = max(1, round(0.5 * SLOPE_S / float(np.median(np.diff(signal.time)))))
    low = np.maximum(np.arange(len(signal.time)) - reach, 0)
    high = np.minimum(np.arange(len(signal.time)) + reach, len(signal.time) - 1)
    return (signal.values[high] - signal.values[low]) / (signal.time[high] - signal.time[low])


def _coverage(
    raw: RawRecording,
    signals: dict[str, Signal],
    rates: dict[str, np.ndarray],
    use_region: Mapping[str, tuple[float, float]],
) -> Iterator[Finding]:
    """The region of state space that the data lie in, and how it meets the region of use."""
    covered = {}
    for name, values in [(n, s.values) for n, s in signals.items()] + list(rates.items()):
        if name in raw.mechanism.extra_input_names:
            continue
        low, high = (float(q) for q in np.quantile(values, [0.01, 0.99]))
        covered[name] = (low, high)
        yield Finding(
            'coverage', 'info', name, f'98 % lie in {low:.4g} .. {high:.4g}', value=[low, high]
        )
    for name, (low, high) in use_region.items():
        if name not in covered:
            yield Finding(
                'coverage_unknown',
                'warning',
                name,
                f'not in this recording, which has {", ".join(covered)}',
            )
            continue
        shared = min(high, covered[name][1]) - max(low, covered[name][0])
        share = max(0.0, shared) / (high - low) if high > low else 0.0
        if share < WELL_COVERED:
            yield Finding(
                'coverage_poor',
                'warning',
                name,
                f'the data cover {share:.0%} of {low:.4g} .. {high:.4g}, where the '
                'model will be used',
                value=share,
                allowed=WELL_COVERED,
            )
    known = raw.mechanism
    angles = [s for n, s in signals.items() if n in known.output_names and s.is_position]
    moved = [np.ptp(s.values) > LITTLE_MOTION * max(s.noise.sigma_floor, 1e-6) for s in angles]
    if angles and not any(moved):
        yield Finding(
            'no_motion',
            'warning',
            '',
            'nothing moves: no parameter of motion can be identified from this recording',
        )


def _excitation(raw: RawRecording, signals: dict[str, Signal]) -> Iterator[Finding]:
    """Amplitude and band of each torque."""
    for name in raw.mechanism.input_names:
        if name not in signals:
            continue
        signal = signals[name]
        peak = float(np.abs(signal.values).max())
        if peak == 0.0:
            yield Finding('excitation', 'info', name, 'zero throughout: free motion', value=0.0)
            continue
        frequency, power = _spectrum(signal)
        share = np.cumsum(power) / max(float(np.sum(power)), 1e-300)
        low, high = (float(frequency[np.searchsorted(share, q)]) for q in (0.05, 0.95))
        rms = float(np.sqrt(np.mean(signal.values**2)))
        yield Finding(
            'excitation',
            'info',
            name,
            f'rms {rms:.4g} {signal.unit}, '
            f'peak {peak:.4g} {signal.unit}, 90 % of the power in {low:.3g} .. '
            f'{high:.3g} Hz',
            value=[rms, peak, low, high],
        )


def _spectrum(signal: Signal) -> tuple[np.ndarray, np.ndarray]:
    """Frequencies in Hz and power of a signal without its mean, both shape (K,)."""
    step = float(np.median(np.diff(signal.time)))
    grid = np.arange(signal.time[0], signal.time[-1], step)
    values = np.interp(grid, signal.time, signal.values)
    power = np.abs(np.fft.rfft((values - values.mean()) * np.hanning(len(values)))) ** 2
    power[-1] += 1e-300  # a constant torque has no power at all
    return np.fft.rfftfreq(len(grid), step), power


def _closed_loop(
    raw: RawRecording, signals: dict[str, Signal], rates: dict[str, np.ndarray]
) -> Iterator[Finding]:
    """Torques that are made of the measured state."""
    if raw.note.get('closed_loop') is True:
        yield Finding(
            'closed_loop',
            'warning',
            '',
            'recorded under feedback, says the note: '
            'delays and noise of the loop bias an identification',
        )
        return
    for name in raw.mechanism.input_names:
        if name not in signals or np.ptp(signals[name].values) == 0.0:
            continue
        torque = signals[name]
        power = np.sort(_spectrum(torque)[1])[::-1]
        if power[:LINE].sum() > NARROW_BAND * power.sum():
            continue
        columns = [np.ones(len(torque.time))]
        for other, signal in signals.items():
            if signal.is_position:
                columns.append(np.interp(torque.time, signal.time, signal.values))
                columns.append(np.interp(torque.time, signal.time, rates[f'{other}_rate']))
        design = np.column_stack(columns)
        fit = design @ np.linalg.lstsq(design, torque.values, rcond=None)[0]
        explained = 1.0 - float(np.var(torque.values - fit) / np.var(torque.values))
        if explained > FEEDBACK:
            yield Finding(
                'closed_loop',
                'warning',
                name,
                f'{explained:.0%} of the torque follows '
                'from angles and rates: it looks like feedback, which biases an '
                'identification',
                value=explained,
                allowed=FEEDBACK,
            )
