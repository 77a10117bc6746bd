"""Checks of the motion against the torque, by the law that the recording itself shows (law.py).

* The law holds from the first second to the last: where it does not, but does once a sign is
  turned or stamps are spread, that is the fault.
* A torque that jumps is answered by the joint: where it is not, the zero of its record moved.
* A torque that runs along a limit is one: where the joint answers more, its record is clipped.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from cg_dynamics.mechanisms import URDF
from cg_interfaces.stamps import NS_PER_S
from cg_sysid.checks.law import Law, Motion, fit_law, motion_of
from cg_sysid.checks.signals import RESTING_S, Signal, limit_runs, rests
from cg_sysid.records.findings import Finding
from cg_sysid.records.jumps import Step, find_step
from cg_sysid.records.raw import RawRecording
from cg_sysid.records.torque_gaps import over_gap

DRIVEN = 0.25  # torque over the largest of the machine: a joint with less is not driven, [1]
AUDIBLE = 10.0  # torque over its noise: what a motor measures at rest answers the motion, [1]
BROKEN = 0.2  # share of the acceleration that no one law leaves in a sound recording, [1]
HOLDS = 0.05  # and what one law leaves where it holds, [1]
RESTORED = 0.25  # the fault is found if without it this share of that is left, [1]
MISALIGNED = 0.5  # the same for a topic that ends before the others, [1]
CHANGED = 0.5  # the law of a part leaves less than this share of what that of all leaves, [1]
PLACES = 40  # instants that are tried
SPLITS = 8  # of them, at which the parts are tried first
FEWEST_AVERAGES = 40  # averages in a part
RATHER = 2.0  # a torque turns rather than an angle, which would jump: leaves at most this more
RATES = (2, 3, 4, 5, 10)  # ratios of sampling rates that are tried
MOVED = 6.0  # standard errors of a term that makes a fault, [1]
ANSWERED = 5.0  # standard errors of an answer to what a record does not show, [1]
ELSEWHERE = np.linspace(0.1, 0.9, 9)  # of a recording, where such an answer is asked for as well
USUALLY = 0.75  # share of these places at which the law is off by no more
OFF_ELSEWHERE = 3.0  # answer to a step over that there
LIKE = 0.35  # such a term agrees with the fault to within this share, [1]
SHORT = 2.5  # samples by which a topic ends before the others
BEYOND = 'beyond_torque'  # name of what a limit may hide
COUPLED = 3  # joints that carry each other of which one recording shows the law
CLIPPED = 0.3  # share of the torque beyond a limit that the joint answered, [1]


def check_dynamics(
    raw: RawRecording, signals: dict[str, Signal], sound: bool
) -> Iterator[Finding]:
    """Findings about the motion against the torque.

    Args:
        raw: The recording, its clocks mended.
        signals: Its channels.
        sound: Whether no grave fault is known; otherwise a law that does not hold says nothing.
    """
    known = raw.mechanism
    wanted = {n: signals[n] for n in (*known.input_names, *known.output_names) if n in signals}
    motion = motion_of(wanted, raw.mechanism.name == URDF)
    if motion is None:
        return
    # The law of many joints has more terms than a recording tells apart.
    sound = sound and (not motion.coupled or len(motion.angle) <= COUPLED)
    for torque in known.input_names:
        angle = known.position_of(torque)
        if angle not in motion.angle or not drives(wanted, torque):
            continue
        law = fit_law(motion, torque, angle)
        broken = list(_broken(raw, wanted, motion, torque, angle, law)) if sound else []
        yield from broken
        if not broken:
            yield from _unanswered(wanted[torque], wanted[angle], motion)
            yield from _clipped(wanted, motion, torque, angle)


def drives(signals: Mapping[str, Signal], torque: str) -> bool:
    """Whether a torque is there, and makes the motion rather than follows from it."""
    rms = {n: float(np.std(s.values)) for n, s in signals.items() if s.is_torque}
    if rms.get(torque, 0.0) == 0.0:
        return False
    noise = signals[torque].noise.sigma_floor
    return rms[torque] > max(DRIVEN * max(rms.values()), AUDIBLE * noise)


def _broken(
    raw: RawRecording,
    signals: dict[str, Signal],
    motion: Motion,
    torque: str,
    angle: str,
    law: Law,
) -> Iterator[Finding]:
    """A law that does not hold throughout, and the fault without which it does."""
    best = (law.unexplained, '', '', 0.0)
    if law.unexplained > BROKEN and _changes(motion, torque, angle, law):
        groups: list[tuple[str, ...]] = [(name,) for name in (torque, *motion.angle)]
        for group in groups:
            for at in _places(motion):
                rest = _left(motion.mirrored(group, at), torque, angle, at)
                rest = rest / RATHER if group[0] == torque else rest
                best = min(best, (rest, 'sign_error', group[0], at))
        for ratio in RATES:
            for at in _places(motion):
                rest = _spread_out(motion, signals, tuple(signals), torque, angle, at, ratio)
                best = min(best, (rest, 'sampling_rate_change', '', at))
        if best[0] < min(RESTORED * law.unexplained, HOLDS):
            yield _restored(*best[1:], law.unexplained, best[0])
            return
    for topic, short in _short_topics(raw, signals).items():
        own = tuple(name for name, s in signals.items() if s.topic == topic)
        best = (law.unexplained, '', '', 0.0)
        end = float(signals[own[0]].time[-1])
        begin = float(signals[own[0]].time[0])
        for at in _places(motion):
            best = min(
                best,
                (
                    _spread_out(motion, signals, own, torque, angle, at, 1.0, short),
                    'dropped_samples',
                    topic,
                    at,
                ),
            )
        whole = 1.0 + short / (end - begin)
        best = min(
            best,
            (
                _spread_out(motion, signals, own, torque, angle, begin, whole),
                'dropped_samples',
                topic,
                begin,
            ),
        )
        for ratio in RATES:
            at = end - short / (ratio - 1.0)
            if at > begin:
                best = min(
                    best,
                    (
                        _spread_out(motion, signals, own, torque, angle, at, ratio),
                        'sampling_rate_change',
                        topic,
                        at,
                    ),
                )
        if best[0] < MISALIGNED * law.unexplained:
            yield _restored(*best[1:], law.unexplained, best[0])
            return


def _left(motion: Motion, torque: str, angle: str, at: float) -> float:
    """What one law leaves of the acceleration before an instant, or after it if that is more."""
    rows = motion.away_from(at)
    law = fit_law(motion, torque, angle, rows=rows)
    before = motion.time[rows] < at
    left = []
    for side in (before, ~before):
        size = float(law.wanted[side] @ law.wanted[side])
        left.append(float(law.rest[side] @ law.rest[side]) / size if size > 0 else 0.0)
    return max(left)


def _changes(motion: Motion, torque: str, angle: str, law: Law) -> bool:
    """Whether a part of the recording follows a law that the whole does not."""
    for at in _places(motion)[:: PLACES // SPLITS]:
        rows = motion.away_from(at)
        for part in (rows & (motion.time < at), rows & (motion.time > at)):
            if part.sum() < FEWEST_AVERAGES:
                continue
            left = fit_law(motion, torque, angle, rows=part).unexplained
            if left < CHANGED * law.unexplained:
                return True
    return False


def _places(motion: Motion) -> np.ndarray:
    return np.linspace(motion.time[0], motion.time[-1], PLACES + 2)[1:-1]


def _restored(code: str, where: str, at: float, before: float, after: float) -> Finding:
    what = {
        'sign_error': 'has the opposite sign from here on',
        'sampling_rate_change': 'is sampled at another rate from here on than its stamps say',
        'dropped_samples': 'lacks samples from here on that its stamps do not show',
    }[code]
    return Finding(
        code,
        'error',
        where,
        f'{where or "the recording"} {what}: so read, the motion follows '
        f'one law, which leaves {after:.1%} of the acceleration instead of {before:.1%}',
        at,
        None,
        None,
        before,
        after,
    )


def _short_topics(raw: RawRecording, signals: dict[str, Signal]) -> dict[str, float]:
    """Topics that begin with the others and end before them, and by how much, in s."""
    topics = {s.topic for s in signals.values()}
    short = {}
    for name in topics:
        stamp = raw.topics[name].stamp_ns
        others = [raw.topics[n].stamp_ns for n in topics if n != name]
        if not others:
            continue
        usual = float(np.median(np.diff(stamp)))
        late = float(np.median([s[0] for s in others])) - stamp[0]
        missing = float(np.median([s[-1] for s in others])) - stamp[-1]
        if abs(late) < SHORT * usual < missing:
            short[name] = missing / NS_PER_S
    return short


def _spread_out(
    motion: Motion,
    signals: dict[str, Signal],
    channels: Sequence[str],
    torque: str,
    angle: str,
    since: float,
    ratio: float,
    gap: float = 0.0,
) -> float:
    """What the law leaves if some channels' stamps go on slower, or later, from an instant on."""
    changed = dict(signals)
    for name in channels:
        time = signals[name].time
        later = since + gap + ratio * (time - since)
        changed[name] = replace(signals[name], time=np.where(time > since, later, time))
    slower = motion_of(changed, motion.coupled)
    if slower is None:
        return 1.0
    return _left(slower, torque, angle, since)


def _only_then(motion: Motion, torque: Signal, angle: str, step: Step, missing: float) -> bool:
    """Whether no such term is missing from other instants on, as it is where the law is off.

    A sensor that is late shows a law that holds nowhere exactly.
    """
    after = (motion.time > step.time).astype(float)
    others = []
    for at in np.quantile(motion.time, ELSEWHERE):
        rows = motion.away_from(step.time) & motion.away_from(at)
        later = (motion.time > at).astype(float)
        beside = fit_law(motion, torque.channel, angle, (after, later), rows)
        others.append(abs(float(beside.extra[1])))
    return abs(missing) > OFF_ELSEWHERE * float(np.quantile(others, USUALLY))


def _unanswered(torque: Signal, joint: Signal, motion: Motion) -> Iterator[Finding]:
    """A step of the torque that the joint does not answer; friction may hold one that rests."""
    angle = joint.channel
    step = find_step(torque.time, torque.values, torque.noise.sigma, torque.noise.quantum)
    if step is None:
        return
    after = (motion.time > step.time).astype(float)
    rows = motion.away_from(step.time)
    if min(rows[after > 0].sum(), rows[after == 0].sum()) < SHORT:
        return
    law = fit_law(motion, torque.channel, angle, (after,), rows)
    missing, error = -float(law.extra[0]), float(law.extra_error[0])
    expected = law.factor * step.size
    alike = abs(missing - expected) < LIKE * abs(expected) + 3 * error
    if abs(missing) > MOVED * error and alike and _only_then(motion, torque, angle, step, missing):
        held = rests(joint, step.time - RESTING_S, step.time + RESTING_S)
        yield Finding(
            'zero_shift',
            'warning' if held else 'error',
            torque.channel,
            f'jumps by {step.size:.3g} {torque.unit}, which {angle} does not answer'
            + (', but it rests there, and friction may hold it' if held else ''),
            float(torque.time[step.sample - 1]),
            step.time,
            int(torque.sample[step.sample]),
            step.size,
            MOVED * error / abs(law.factor),
        )


def _clipped(
    signals: dict[str, Signal], motion: Motion, torque: str, angle: str
) -> Iterator[Finding]:
    """A torque along a limit, though the joint answers one that goes beyond it."""
    signal = signals[torque]
    runs = limit_runs(signal)
    beyond = np.zeros(len(signal.values))
    for first, last in runs:
        if first >= 2 and last <= len(beyond) - 3:
            guess = over_gap(signal.time, signal.values, first - 1, last + 1)
            beyond[first : last + 1] = guess - signal.values[first : last + 1]
    if not beyond.any():
        return
    lost = replace(signal, values=beyond)
    extended = motion_of({**signals, BEYOND: lost}, motion.coupled)
    if extended is None:
        return
    law = fit_law(motion, torque, angle, (extended.torque[BEYOND],))
    answered, error = float(law.extra[0]), float(law.extra_error[0])
    if answered > ANSWERED * error and answered > CLIPPED * law.factor > 0:
        first, last = max(runs, key=lambda run: run[1] - run[0])
        yield Finding(
            'sensor_clipping',
            'error',
            torque,
            f'is recorded as no more than '
            f'{signal.values[first]:.4g} {signal.unit}, but {angle} answers more',
            float(signal.time[first]),
            float(signal.time[last]),
            int(signal.sample[first]),
            answered / law.factor,
            CLIPPED,
        )
