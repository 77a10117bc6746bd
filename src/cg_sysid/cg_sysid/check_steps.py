"""Checks of angles for steps: a zero that moved, a sign that changed, time that is missing.

The same step of a value can be three things. If value and rate go on mirrored, the sign changed.
If several sensors jump at once, each by its own rate times one and the same time, then that time
is missing from the stamps. Otherwise a zero moved, or an encoder lost counts.
"""

from collections.abc import Iterator

import numpy as np

from cg_sysid.channels import mechanism
from cg_sysid.check_signals import Signal, without_spikes
from cg_sysid.findings import Finding
from cg_sysid.raw import RawRecording
from cg_sysid.record import NS_PER_S
from cg_sysid.steps import Step, find_step

AT_ONCE = 3.0  # sampling times between steps of one event, [1]
SURE = 4.0  # standard deviations within which two numbers count as equal, [1]
MOVING = 6.0  # standard deviations of its rate from which a channel counts as moving, [1]
MIRRORED = 0.01  # of the size of a step by which a mirror image may be off, [1]
SHARE = 0.15  # of a missing time that may be wrong because the rate changes over it, [1]


def check_steps(raw: RawRecording, signals: dict[str, Signal]) -> Iterator[Finding]:
    """Findings about steps of the measured angles.

    Args:
        raw: The recording, its clocks mended.
        signals: Its channels, without those that froze or that ran into a limit.
    """
    known = mechanism(raw.mechanism)
    steps: dict[str, Step] = {}
    for name in (*known.input_names, *known.output_names):
        if name not in signals or name == 'imu_rate' or np.ptp(signals[name].values) == 0.0:
            continue
        signal = without_spikes(signals[name])
        step = find_step(signal.time, signal.values, signal.noise.sigma, signal.noise.quantum)
        if step:
            steps[name] = step
    for name, step in steps.items():
        if not name.endswith('angle'):
            continue  # a torque may jump; here it is a witness only
        signal = signals[name]
        place = (float(signal.time[step.sample - 1]), step.time, int(signal.sample[step.sample]))
        missing = _missing_time(name, step, steps, raw, signal)
        if _mirrored(step):
            yield Finding('sign_error', 'error', name, f'jumps from {step.before:.4g} to '
                          f'{step.after:.4g} rad and goes on with the opposite sign', *place,
                          step.after, step.before)
        elif missing:
            yield Finding('dropped_samples', 'error', signal.topic, f'{name} jumps by '
                          f'{step.size:.4g} rad, as far as it moves in {1e3 * missing:.3g} ms, '
                          'while the stamps show no gap: they are wrong', *place, missing, 0.0)
        else:
            yield Finding('zero_shift', 'error', name, f'jumps by {step.size:.4g} rad from one '
                          'sample to the next and stays there', *place, step.size, step.limit)


def _mirrored(step: Step) -> bool:
    """Value and rate go on with the opposite sign."""
    turned = abs(step.rate_before + step.rate_after)
    straight = abs(step.rate_before - step.rate_after)
    near = SURE * step.sigma + MIRRORED * abs(step.size)
    return abs(step.before + step.after) < near and turned < straight


def _missing_time(
    name: str, step: Step, steps: dict[str, Step], raw: RawRecording, signal: Signal
) -> float:
    """Time in s that is missing from the stamps, if that explains a step; 0 otherwise."""
    time, sigma = _time_of(step)
    if time <= 0.0:
        return 0.0
    usual = float(np.median(np.diff(signal.time)))
    for other, its in steps.items():
        its_time, its_sigma = _time_of(its)
        apart = SURE * np.hypot(sigma, its_sigma) + SHARE * time
        at_once = abs(its.time - step.time) < AT_ONCE * usual
        if other != name and at_once and its_time > 0.0 and abs(its_time - time) < apart:
            return time
    ends = {t: int(raw.topics[t].stamp_ns[-1]) for t in {signal.topic, *_measured(raw)}}
    late = float(np.median([end for t, end in ends.items() if t != signal.topic] or [0]))
    early = (late - ends[signal.topic]) / NS_PER_S
    return time if early > 0.5 * usual and abs(early - time) < SURE * sigma + SHARE * time else 0.0


def _measured(raw: RawRecording) -> list[str]:
    known = mechanism(raw.mechanism)
    return [t.name for t in (known.torque, *known.outputs) if len(raw.topics.get(t.name, ()))]


def _time_of(step: Step) -> tuple[float, float]:
    """Time in s in which the motion would make the step, and its standard deviation; or 0."""
    rate = 0.5 * (step.rate_before + step.rate_after)
    sigma = step.rate_sigma / np.sqrt(2.0)
    if abs(rate) < MOVING * sigma:
        return 0.0, 0.0
    time = step.size / rate
    return time, float(np.hypot(step.sigma, time * sigma) / abs(rate))
