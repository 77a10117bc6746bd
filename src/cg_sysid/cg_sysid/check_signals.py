"""Checks of single signals: not finite, frozen, clipped, saturated, spiked, shifted.

What counts as abnormal is measured against the channel's own noise, resolution and motion, so
that no limit has to be known. A joint that rests, a coarse encoder and a friction that holds a
joint still are normal.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from cg_sysid.channels import mechanism
from cg_sysid.findings import Finding
from cg_sysid.noise import ChannelNoise, channel_noise
from cg_sysid.raw import RawRecording
from cg_sysid.record import NS_PER_S

FROZEN_SAMPLES = 15  # shortest run of one value that is looked at
ABRUPT = 1.5  # steps this many quanta or sigmas long are motion, [1]
ACCELERATING = 7.5  # samples in which a motion of the usual acceleration comes to a stop, [1]
NOISY_SPAN = 20  # samples beside a run in which noise is looked for
RELEASE = 6.0  # a jump this many usual steps long ends a freeze, [1]
SPIKE = 10.0  # error of interpolation over its local size, [1]
SHIFT = 8.0  # step over the noise of a step and over the change of slope around it, [1]
SHIFT_QUANTA = 4.0  # step over the resolution, [1]
MANY_SPIKES = 0.01  # share of samples, [1]
STILL_S = 1.0  # a sensor may be still this long while others move, in s
STILL_MOVED = 20.0  # motion over the noise floor before the rest, [1]
STILL_SHARE = 0.2  # and for this share of the recording, [1]
SATURATED_RUN = 5  # samples at the limit in a row
SATURATED_SHARE = 0.01  # share of samples at the limit, [1]


@dataclass(frozen=True)
class Signal:
    """One channel as it is checked: finite samples in order of time.

    Attributes:
        channel: Name of the channel.
        topic: Name of its topic.
        time: Times since the first stamp of the recording in s, shape (M,), increasing.
        values: Samples, shape (M,).
        sample: Index of each sample within its topic, shape (M,).
        noise: Noise and resolution.
    """

    channel: str
    topic: str
    time: np.ndarray
    values: np.ndarray
    sample: np.ndarray
    noise: ChannelNoise

    @property
    def step_floor(self) -> float:
        """Size of a step that noise and rounding alone make now and then."""
        return max(np.sqrt(2.0) * self.noise.sigma, self.noise.quantum)


def read_signals(raw: RawRecording) -> dict[str, Signal]:
    """Every channel of a recording that has enough samples to be checked."""
    stamps = [t.stamp_ns for t in raw.topics.values() if len(t)]
    origin = min((int(s.min()) for s in stamps), default=0)
    known = mechanism(raw.mechanism)
    signals = {}
    for topic in raw.topics.values():
        if topic.name == known.command.name:
            continue
        for channel, values in topic.values.items():
            usable = np.flatnonzero(np.isfinite(values))
            _, first = np.unique(topic.stamp_ns[usable], return_index=True)
            sample = usable[first]
            if len(sample) < 10:
                continue
            time = (topic.stamp_ns[sample] - origin) / NS_PER_S
            noise = channel_noise(time, values[sample])
            signals[channel] = Signal(channel, topic.name, time, values[sample], sample, noise)
    return signals


def check_signals(raw: RawRecording, signals: dict[str, Signal]) -> Iterator[Finding]:
    """Findings about each signal for itself."""
    known = mechanism(raw.mechanism)
    yield from _not_finite(raw)
    for name in known.output_names:
        if name in signals:
            yield from _check_output(signals[name])
    yield from _still(signals, known.output_names)
    for name in known.input_names:
        if name in signals:
            yield from _saturation(signals[name])


def _check_output(signal: Signal) -> Iterator[Finding]:
    """Spikes first; the other checks see the signal without them."""
    spikes = find_spikes(signal)
    yield from _spikes(signal, spikes)
    signal = _without(signal, spikes)
    frozen = list(_frozen(signal))
    yield from frozen
    yield from _shifts(signal, frozen)


def _without(signal: Signal, samples: np.ndarray) -> Signal:
    """The signal with some samples replaced by the line between their neighbours."""
    keep = np.setdiff1d(np.arange(len(signal.values)), samples)
    values = np.interp(signal.time, signal.time[keep], signal.values[keep])
    return replace(signal, values=np.where(np.isin(np.arange(len(values)), samples), values,
                                           signal.values))


def _still(signals: dict[str, Signal], names: tuple[str, ...]) -> Iterator[Finding]:
    """A sensor that has moved before and rests for long while another one moves as usual.

    Friction can do that too, so that this is a warning.
    """
    for name in names:
        if name not in signals:
            continue
        signal = signals[name]
        if np.ptp(signal.values) < STILL_MOVED * signal.noise.sigma_floor:
            continue  # it never moved, as the hip with its legs tied
        runs = constant_runs(signal.values, FROZEN_SAMPLES)
        if not runs:
            continue
        first, last = max(runs, key=lambda run: run[1] - run[0])
        start, stop = float(signal.time[first]), float(signal.time[last])
        if stop - start < max(STILL_S, STILL_SHARE * float(np.ptp(signal.time))):
            continue
        for other in names:
            if other == name or other not in signals:
                continue
            near = (signals[other].time > start) & (signals[other].time < stop)
            if near.sum() > 10 and np.std(signals[other].values[near]) > 0.5 * np.std(
                signals[other].values
            ) > 5.0 * signals[other].noise.sigma_floor:
                yield Finding('still', 'warning', name, f'does not change for {stop - start:.2f} '
                              f's while {other} moves as before', start, stop,
                              int(signal.sample[first]), stop - start, STILL_S)
                break


def _not_finite(raw: RawRecording) -> Iterator[Finding]:
    stamps = [t.stamp_ns for t in raw.topics.values() if len(t)]
    origin = min((int(s.min()) for s in stamps), default=0)
    for topic in raw.topics.values():
        for channel, values in topic.values.items():
            bad = np.flatnonzero(~topic.absent[channel] & ~np.isfinite(values))
            if len(bad):
                time = (topic.stamp_ns[bad] - origin) / NS_PER_S
                yield Finding('not_finite', 'error', channel,
                              f'{len(bad)} value(s) are NaN or infinite', float(time[0]),
                              float(time[-1]), int(bad[0]), len(bad), 0)


def constant_runs(values: np.ndarray, shortest: int) -> list[tuple[int, int]]:
    """Runs of one and the same value, as (first, last) indices, at least `shortest` long."""
    edges = np.flatnonzero(np.diff(values) != 0.0)
    first = np.concatenate([[0], edges + 1])
    last = np.concatenate([edges, [len(values) - 1]])
    long = last - first + 1 >= shortest
    return list(zip(first[long].tolist(), last[long].tolist(), strict=True))


def _frozen(signal: Signal) -> Iterator[Finding]:
    """A sensor that stops reporting motion, or that cannot follow it beyond a limit.

    Nothing that moves several counts per sample stops within one sample without a knock, and
    nothing at rest is somewhere else one sample later. A signal whose noise vanishes has frozen
    too.
    """
    values, noise = signal.values, signal.noise
    runs = constant_runs(values, FROZEN_SAMPLES)
    if not runs or np.ptp(values) == 0.0:
        return
    unit = max(noise.quantum, noise.sigma, 1e-9 * np.ptp(values))
    steps = np.abs(np.diff(values))
    usual = max(float(np.quantile(steps, 0.98)), unit)
    abrupt = ABRUPT * unit + ACCELERATING * _usual_bend(values)
    clipped: list[tuple[int, int]] = []
    stuck: list[tuple[int, int]] = []
    for first, last in runs:
        entry, leave = _speed(values[max(0, first - 5): first + 1]), _speed(values[last:last + 6])
        release = steps[last] if last < len(steps) else 0.0
        abrupt_in, abrupt_out = entry > abrupt, leave > abrupt
        at_limit = values[first] in (values.max(), values.min())
        silent = noise.sigma > noise.quantum and (
            _is_noisy(values[max(0, first - NOISY_SPAN): first])
            or _is_noisy(values[last + 1: last + 1 + NOISY_SPAN])
        )
        if at_limit and abrupt_in and abrupt_out and release <= RELEASE * usual:
            clipped.append((first, last))
        elif release > RELEASE * usual or silent:
            stuck.append((first, last))
        elif abrupt_in and (abrupt_out or last == len(values) - 1):
            stuck.append((first, last))
    for code, runs_found, text in (
        ('stuck', stuck, 'does not change for {0:.2f} s in all while it should'),
        ('clipped', clipped, 'stays at {1:.4g} for {0:.2f} s in all, in flat tops'),
    ):
        if runs_found:
            spans = [(signal.time[a], signal.time[b]) for a, b in runs_found]
            length = sum(b - a for a, b in spans)
            longest = max(range(len(spans)), key=lambda i: spans[i][1] - spans[i][0])
            at = runs_found[longest][0]
            yield Finding(code, 'error', signal.channel, text.format(length, values[at]),
                          float(spans[longest][0]), float(spans[longest][1]),
                          int(signal.sample[at]), float(length), 0.0)


def _usual_bend(values: np.ndarray) -> float:
    """Usual change of the step from one sample to the next, in the unit of the values."""
    stride = 5
    if len(values) <= 2 * stride:
        return 0.0
    bend = values[2 * stride:] - 2.0 * values[stride:-stride] + values[:-2 * stride]
    return float(np.quantile(np.abs(bend), 0.95)) / stride**2


def _is_noisy(values: np.ndarray) -> bool:
    """Whether a short run goes up and down as white noise does and motion does not."""
    signs = np.sign(np.diff(values))
    # The steps of white noise turn round two times out of three.
    return len(signs) >= 8 and float(np.mean(signs[1:] * signs[:-1] < 0.0)) > 0.4


def _speed(values: np.ndarray) -> float:
    """Typical step between the samples of a short run."""
    return float(np.median(np.abs(np.diff(values)))) if len(values) > 2 else 0.0


def _interpolation_error(time: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Each sample less the cubic through its four neighbours, shape (M - 4,)."""
    window = np.lib.stride_tricks.sliding_window_view
    times, samples = window(time, 5), window(values, 5)
    neighbours = [0, 1, 3, 4]
    predicted = np.zeros(len(times))
    for i in neighbours:
        weight = np.ones(len(times))
        for j in neighbours:
            if j != i:
                weight *= (times[:, 2] - times[:, j]) / (times[:, i] - times[:, j])
        predicted += weight * samples[:, i]
    return samples[:, 2] - predicted


def find_spikes(signal: Signal) -> np.ndarray:
    """Indices of single samples that fit nothing around them, shape (K,)."""
    time, values = signal.time, signal.values
    if len(values) < 40:
        return np.array([], dtype=int)
    size = np.abs(_interpolation_error(time, values))
    # A quantile over the neighbourhood forgets the spike and the four errors that it causes.
    reach = 12
    padded = np.pad(size, reach, mode='reflect')
    around = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1)
    local = np.quantile(around, 0.75, axis=1)
    limit = SPIKE * np.maximum(local, signal.noise.sigma) + 3.0 * signal.noise.quantum
    limit += 1e-9 * np.ptp(values)
    peak = np.ones(len(size), dtype=bool)
    peak[1:] &= size[1:] > size[:-1]
    peak[:-1] &= size[:-1] >= size[1:]
    hits = np.flatnonzero((size > limit) & peak) + 2
    # A step that lasts is a shift: a spike is back where it was.
    before, after = values[hits - 1], values[hits + 1]
    return hits[np.abs(after - before) < 0.5 * np.abs(values[hits] - 0.5 * (before + after))]


def _spikes(signal: Signal, spikes: np.ndarray) -> Iterator[Finding]:
    if not len(spikes):
        return
    values, time = signal.values, signal.time
    height = values[spikes] - 0.5 * (values[spikes - 1] + values[spikes + 1])
    worst = int(np.argmax(np.abs(height)))
    at = float(time[spikes[worst]])
    yield Finding(
        'spikes', 'error' if len(spikes) > MANY_SPIKES * len(values) else 'warning',
        signal.channel,
        f'{len(spikes)} sample(s) far from their neighbours, the worst by {height[worst]:.3g}',
        at, at, int(signal.sample[spikes[worst]]), float(height[worst]))


def _shifts(signal: Signal, frozen: list[Finding]) -> Iterator[Finding]:
    """Steps that last: a zero that moved, an encoder that lost counts.

    A step is a change between two samples that the slopes on both sides do not explain. A knock
    changes the slope, not the value.
    """
    k, size = largest_step(signal.time, signal.values, signal.step_floor, signal.noise.quantum)
    if k < 0:
        return
    at = float(signal.time[k])
    spans = [(f.start_s or 0.0, f.stop_s or 0.0) for f in frozen]
    if any(abs(at - stop) < 0.02 or abs(at - start) < 0.02 for start, stop in spans):
        return  # the release of a frozen sensor, reported as such
    yield Finding('zero_shift', 'error', signal.channel,
                  f'jumps by {size:.4g} from one sample to the next and stays there',
                  float(signal.time[k - 1]), at, int(signal.sample[k]), size,
                  SHIFT * signal.step_floor)


def largest_step(
    time: np.ndarray, values: np.ndarray, step_floor: float, quantum: float
) -> tuple[int, float]:
    """The largest step that the motion around it does not explain.

    Args:
        time: Increasing sample times in s, shape (M,).
        values: Samples, shape (M,).
        step_floor: Step that noise and rounding make, in the unit of the values.
        quantum: Resolution, in the unit of the values.

    Returns:
        (index of the first sample after the step, its size); (-1, 0.0) if there is none.
    """
    dt, steps = np.diff(time), np.diff(values)
    side = 6
    if len(steps) < 4 * side:
        return -1, 0.0
    slope = steps / dt
    window = np.lib.stride_tricks.sliding_window_view(slope, side)
    level, low, high = np.median(window, axis=1), window.min(axis=1), window.max(axis=1)
    index = np.arange(side, len(slope) - side)
    left, right = level[index - side], level[index + 1]
    spread = np.maximum(high[index - side], high[index + 1])
    spread = spread - np.minimum(low[index - side], low[index + 1])
    excess = steps[index] - 0.5 * (left + right) * dt[index]
    limit = SHIFT * step_floor + SHIFT_QUANTA * quantum + 2.0 * spread * dt[index]
    limit += 1e-9 * np.ptp(values)
    lasting = np.abs(excess) > limit
    # In a gap the motion may turn, and the slopes say nothing.
    lasting &= dt[index] < 2.5 * np.median(dt)
    if not lasting.any():
        return -1, 0.0
    best = int(np.argmax(np.where(lasting, np.abs(excess) / limit, 0.0)))
    return int(index[best]) + 1, float(excess[best])


def _saturation(signal: Signal) -> Iterator[Finding]:
    """A torque that runs along a limit. Steps and square waves hold a level on purpose."""
    values = signal.values
    peak = float(np.abs(values).max())
    if peak == 0.0 or len(np.unique(values)) < 0.05 * len(values):
        return
    at_limit = np.abs(values) >= peak * (1.0 - 1e-6)
    runs = [
        (a, b) for a, b in constant_runs(np.where(at_limit, np.sign(values), 0.0), SATURATED_RUN)
        if at_limit[a]
    ]
    share = sum(b - a + 1 for a, b in runs) / len(values)
    if share < SATURATED_SHARE:
        return
    a, b = max(runs, key=lambda run: run[1] - run[0])
    yield Finding('saturation', 'warning', signal.channel,
                  f'the torque runs along {peak:.4g} N m for {share:.1%} of the samples',
                  float(signal.time[a]), float(signal.time[b]), int(signal.sample[a]), share,
                  SATURATED_SHARE)
