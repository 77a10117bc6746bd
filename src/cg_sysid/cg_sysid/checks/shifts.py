"""Checks of angles for steps: a zero that moved, a sign that changed, time that is missing.

The same step of a value can be three things. If value and rate go on mirrored, the sign changed.
If several sensors jump at once, each by its own rate times one and the same time, then that time
is missing from the stamps. Otherwise a zero moved, or an encoder lost counts.
"""

from collections.abc import Iterator

import numpy as np

from cg_dynamics.mechanisms import URDF
from cg_dynamics.mechanisms.compass_gait import CompassGait
from cg_dynamics.model import Model
from cg_interfaces.stamps import NS_PER_S
from cg_sysid.checks.resting import resting_band
from cg_sysid.checks.sampling import timing_errors
from cg_sysid.checks.signals import RESTING_S, Signal, rests, without_spikes
from cg_sysid.records.findings import Finding
from cg_sysid.records.jumps import Step, find_step, step_at, zero_known_to
from cg_sysid.records.raw import RawRecording

SURE = 4.0  # standard deviations within which two numbers count as equal, [1]
SHORT = 1.5  # sampling times by which a topic that lost samples ends early, at least, [1]
AT_ONCE = 3.0  # sampling times between steps of one event, [1]
MOVING = 6.0  # standard deviations of its rate from which a channel counts as moving, [1]
MIRRORED = 0.01  # of the size of a step by which a mirror image may be off, [1]
SHARE = 0.15  # of a missing time that may be wrong because the rate changes over it, [1]


def check_steps(
    raw: RawRecording, signals: dict[str, Signal], model: Model | None = None
) -> Iterator[Finding]:
    """Findings about steps of the measured angles.

    Args:
        raw: The recording, its clocks mended.
        signals: Its channels, without those that froze or that ran into a limit.
        model: Nominal model of the machine; it knows where friction lets a joint rest.
    """
    timing = timing_errors(signals)
    bands: dict[str, float] | None = None
    known = raw.mechanism
    clean = {
        name: without_spikes(signals[name])
        for name in (*known.input_names, *known.output_names)
        if name in signals and np.ptp(signals[name].values) > 0.0
    }
    # A foot that lands knocks, and so do teeth of a robot's joint whose play is passed.
    steps = raw.mechanism.name == CompassGait.name and raw.setup.may_step
    knocks = steps or raw.mechanism.name == URDF
    for name, signal in clean.items():
        if not signal.is_position:
            continue  # a torque may jump, and a rate at a knock
        late = timing[signal.topic].sigma if signal.topic in timing else 0.0
        step = find_step(
            signal.time, signal.values, signal.noise.sigma, signal.noise.quantum, knocks=knocks,
            timing=late,
        )  # fmt: skip
        if step is None:
            continue
        place = (float(signal.time[step.sample - 1]), step.time, int(signal.sample[step.sample]))
        missing = _missing_time(step, signal, clean, raw)
        together = _others_jump(step, signal, clean)
        if _mirrored(step):
            yield Finding(
                'sign_error',
                'error',
                name,
                f'jumps from {step.before:.4g} to '
                f'{step.after:.4g} {signal.unit} and goes on with the opposite sign',
                *place,
                step.after,
                step.before,
            )
        elif missing or together:
            time = f'{1e3 * missing:.3g} ms are' if missing else 'time is'
            yield Finding(
                'dropped_samples',
                'error',
                signal.topic,
                f'{name} jumps by '
                f'{step.size:.4g} {signal.unit}: {time} missing in the stamps, which '
                'show no gap',
                *place,
                missing or None,
                0.0,
            )
        else:
            bands = _resting_bands(raw, model) if bands is None else bands
            yield _shift(step, signal, place, bands.get(name, 0.0), _play(model))


def _shift(
    step: Step, signal: Signal, place: tuple[float, float, int], band: float, play: float
) -> Finding:
    """A zero that moved: an error where it moved further than zeros are known to."""
    text = f'jumps by {step.size:.4g} {signal.unit} from one sample to the next and stays there'
    fine = zero_known_to(signal.values, signal.unit)
    before, at = place[0], step.time
    slips = rests(signal, before - RESTING_S, before) and rests(signal, at, at + RESTING_S)
    if abs(step.size) < fine:
        text += f', by less than the {fine:.2g} {signal.unit} to which a zero is known'
    elif abs(step.size) < play:
        fine = play
        text += f', within the play of {play:.2g} {signal.unit}'
    elif slips and abs(step.size) < band:
        fine = band
        text += f', at rest, where friction allows {band:.2g} {signal.unit}'
    else:
        return Finding('zero_shift', 'error', signal.channel, text, *place, step.size, step.limit)
    return Finding('zero_shift', 'warning', signal.channel, text, *place, step.size, fine)


def _play(model: Model | None) -> float:
    """The widest play of the model's gears; what is light crosses it between two samples."""
    if model is None:
        return 0.0
    return max((model.values_of(effect).get('gap', 0.0) for effect in model.effects), default=0.0)


def _resting_bands(raw: RawRecording, model: Model | None) -> dict[str, float]:
    """Friction over stiffness of each joint, by the model; empty without one."""
    if model is None:
        return {}
    try:
        return resting_band(model, raw.setup)
    except ValueError:
        return {}  # a set-up that this model cannot have: reading says so


def _mirrored(step: Step) -> bool:
    """Value and rate go on with the opposite sign."""
    turned = abs(step.rate_before + step.rate_after)
    straight = abs(step.rate_before - step.rate_after)
    near = step.limit + MIRRORED * abs(step.size)
    return abs(step.before + step.after) < near and turned < straight


def _missing_time(
    step: Step, signal: Signal, signals: dict[str, Signal], raw: RawRecording
) -> float:
    """Time in s that is missing from the stamps, if that explains a step; 0 otherwise."""
    stamps = [raw.topics[name].stamp_ns for name in _measured(raw) if name != signal.topic]
    own = raw.topics[signal.topic].stamp_ns
    if stamps:
        late = (float(np.median([s[0] for s in stamps])) - own[0]) / NS_PER_S
        early = (float(np.median([s[-1] for s in stamps])) - own[-1]) / NS_PER_S
        usual = float(np.median(np.diff(signal.time)))
        if abs(late) < SHORT * usual < early:
            return early  # it began with the others, and ends before them
    rate = 0.5 * (step.rate_before + step.rate_after)
    if abs(rate) < MOVING * step.rate_sigma or step.size / rate <= 0.0:
        return 0.0
    time = step.size / rate
    agree = [_jumps_too(s, step.time, time) for s in signals.values() if s is not signal]
    return time if True in agree and False not in agree else 0.0


def _others_jump(step: Step, signal: Signal, signals: dict[str, Signal]) -> bool:
    """Whether a sensor of another topic jumps too: two zeros do not move at once."""
    usual = float(np.median(np.diff(signal.time)))
    for other in signals.values():
        if other.topic == signal.topic or other.is_rate:
            continue
        noise = other.noise
        its = find_step(other.time, other.values, noise.sigma, noise.quantum)
        if its and abs(its.time - step.time) < AT_ONCE * usual:
            return True
    return False


def _jumps_too(signal: Signal, instant: float, time: float) -> bool | None:
    """Whether a channel jumps as far as it moves in that time; None if that cannot be seen."""
    noise = signal.noise
    step = step_at(signal.time, signal.values, noise.sigma, noise.quantum, instant)
    if step is None:
        return None
    rate = 0.5 * (step.rate_before + step.rate_after)
    least = SURE * float(np.hypot(step.sigma, time * step.rate_sigma)) + noise.quantum
    if abs(rate * time) < 2.0 * least:
        return None
    return abs(step.size - rate * time) < least + SHARE * abs(rate * time)


def _measured(raw: RawRecording) -> list[str]:
    known = raw.mechanism
    return [t.name for t in (known.torque, *known.outputs) if len(raw.topics.get(t.name, ()))]
