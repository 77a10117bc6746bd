"""Checks of single signals: not finite, frozen, clipped, saturated, spiked.

What counts as abnormal is measured against the channel's own noise, resolution and motion, so
that no limit has to be known. A joint that rests, a coarse encoder and a friction that holds a
joint still are normal.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from cg_interfaces.stamps import NS_PER_S
from cg_sysid.records.findings import Finding
from cg_sysid.records.noise import ChannelNoise, channel_noise, resolution
from cg_sysid.records.raw import RawRecording

PIECE = 200  # samples
FROZEN_SAMPLES = 15  # shortest run of one value that is looked at
CLIPPED_RUN = 3  # samples at the extreme value in a row that may be a flat top
LONG_TOP = 6  # samples of a single flat top that counts by itself: a turn on a count is shorter
VISITS = 2  # flat tops at one value, else: no two turns end in the same place by chance
REPEATS = 8  # samples at the extreme value: noise that is not rounded repeats none
RESTING_S = 0.1  # s before and after an instant in which a joint that rests does not move
RESTING = 8.0  # noise floors that a joint at rest moves over: two counts, or as much of noise
COARSER = 4.0  # at most as much coarser are numbers two octaves up, [1]
PAIRS = 5  # equal neighbours elsewhere that show that a signal is rounded after all
TOP_SIDE = 12  # samples beside a flat top that show how fast it was reached
ALIKE = 0.2  # ratio of the slopes on the two sides of a flat top, at least, [1]
TOP_QUANTA = 2.5  # a top this many quanta flat is normal, [1]
TOP_SIGMA = 5.0  # and one that is this many standard deviations of its estimate high, [1]
ABRUPT = 1.5  # steps this many quanta or sigmas long are motion, [1]
ACCELERATING = 7.5  # samples in which a motion of the usual acceleration comes to a stop, [1]
NOISY_SPAN = 20  # samples beside a run in which noise is looked for
RELEASE = 6.0  # a jump this many usual steps long ends a freeze, [1]
SPIKE = 10.0  # error of interpolation over its local size, [1]
MANY_SPIKES = 0.01  # share of samples, [1]
STILL_S = 1.0  # a sensor may be still this long while others move, in s
STILL_MOVED = 20.0  # motion over the noise floor before the rest, [1]
STILL_SHARE = 0.2  # and for this share of the recording, [1]
LIMIT_RUN = 5  # samples at the limit in a row
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
        unit: Unit of the samples.
    """

    channel: str
    topic: str
    time: np.ndarray
    values: np.ndarray
    sample: np.ndarray
    noise: ChannelNoise
    unit: str

    @property
    def rate(self) -> float:
        """Usual sampling rate in Hz."""
        return 1.0 / float(np.median(np.diff(self.time)))

    @property
    def is_position(self) -> bool:
        """Whether it is an angle, or a length along a joint that slides."""
        return self.unit in ('rad', 'm')

    @property
    def is_rate(self) -> bool:
        """Whether it is the rate of one."""
        return self.unit in ('rad/s', 'm/s')

    @property
    def is_torque(self) -> bool:
        """Whether it is a torque, or a force along a joint that slides."""
        return self.unit in ('N m', 'N')


def read_signals(raw: RawRecording) -> dict[str, Signal]:
    """Every channel of a recording that has enough samples to be checked."""
    stamps = [t.stamp_ns for t in raw.topics.values() if len(t)]
    origin = min((int(s.min()) for s in stamps), default=0)
    known = raw.mechanism
    signals = {}
    for topic in raw.topics.values():
        if topic.name in (known.command.name, raw.told):
            continue
        for channel, values in topic.values.items():
            usable = np.flatnonzero(np.isfinite(values))
            _, first = np.unique(topic.stamp_ns[usable], return_index=True)
            sample = usable[first]
            if len(sample) < 10:
                continue
            time = (topic.stamp_ns[sample] - origin) / NS_PER_S
            noise = channel_noise(time, values[sample])
            if noise.quantum == 0.0:
                noise = replace(noise, quantum=_quantum_of_pieces(values[sample]))
            unit = known.channel(channel).unit
            signals[channel] = Signal(
                channel, topic.name, time, values[sample], sample, noise, unit
            )
    return signals


def _quantum_of_pieces(values: np.ndarray) -> float:
    """Resolution of most pieces of a signal: a zero that moved leaves counts in two rows."""
    pieces = np.array_split(values, max(1, len(values) // PIECE))
    return float(np.median([resolution(piece) for piece in pieces]))


def rests(signal: Signal, start: float, stop: float) -> bool:
    """Whether a joint does not move between two instants in s; a turn is no rest."""
    within = signal.values[(signal.time > start) & (signal.time < stop)]
    return len(within) > 1 and float(np.ptp(within)) <= RESTING * signal.noise.sigma_floor


def check_signals(raw: RawRecording, signals: dict[str, Signal]) -> Iterator[Finding]:
    """Findings about each signal for itself."""
    known = raw.mechanism
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
    clipped, limits = _clipping(signal)
    yield from clipped
    yield from _frozen(signal, limits)


def without_spikes(signal: Signal) -> Signal:
    """The signal with its spikes replaced by the line between their neighbours."""
    return _without(signal, find_spikes(signal))


def _without(signal: Signal, samples: np.ndarray) -> Signal:
    keep = np.setdiff1d(np.arange(len(signal.values)), samples)
    values = np.interp(signal.time, signal.time[keep], signal.values[keep])
    return replace(
        signal, values=np.where(np.isin(np.arange(len(values)), samples), values, signal.values)
    )


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
            if (
                near.sum() > 10
                and np.std(signals[other].values[near])
                > 0.5 * np.std(signals[other].values)
                > 5.0 * signals[other].noise.sigma_floor
            ):
                yield Finding(
                    'still',
                    'warning',
                    name,
                    f'does not change for {stop - start:.2f} s while {other} moves as before',
                    start,
                    stop,
                    int(signal.sample[first]),
                    stop - start,
                    STILL_S,
                )
                break


def _not_finite(raw: RawRecording) -> Iterator[Finding]:
    stamps = [t.stamp_ns for t in raw.topics.values() if len(t)]
    origin = min((int(s.min()) for s in stamps), default=0)
    for topic in raw.topics.values():
        for channel, values in topic.values.items():
            bad = np.flatnonzero(~topic.absent[channel] & ~np.isfinite(values))
            if len(bad):
                time = (topic.stamp_ns[bad] - origin) / NS_PER_S
                yield Finding(
                    'not_finite',
                    'error',
                    channel,
                    f'{len(bad)} value(s) are NaN or infinite',
                    float(time[0]),
                    float(time[-1]),
                    int(bad[0]),
                    len(bad),
                    0,
                )


def constant_runs(values: np.ndarray, shortest: int) -> list[tuple[int, int]]:
    """Runs of one and the same value, as (first, last) indices, at least `shortest` long."""
    edges = np.flatnonzero(np.diff(values) != 0.0)
    first = np.concatenate([[0], edges + 1])
    last = np.concatenate([edges, [len(values) - 1]])
    long = last - first + 1 >= shortest
    return list(zip(first[long].tolist(), last[long].tolist(), strict=True))


def _clipping(signal: Signal) -> tuple[list[Finding], list[float]]:
    """Flat tops at the highest or the lowest value, and the limits that they lie at.

    Motion that reaches its highest count stays there for a while, too, and friction may hold it.
    Then it comes in slowly: a cubic that goes on with the slopes on both sides stays within a
    count or two. So a level is the end of a sensor where motion says so, at several visits or at
    a long one. Noise that is not rounded never repeats its extreme value at all.
    """
    values, noise = signal.values, signal.noise
    findings, limits = [], []
    for limit in (float(values.max()), float(values.min())):
        at = values == limit
        runs = constant_runs(np.where(at, 1.0, 0.0), CLIPPED_RUN)
        runs = [(a, b) for a, b in runs if at[a]]
        if not runs:
            continue
        grain = max(noise.quantum, _grain(values, limit))
        noisy = grain == 0.0 and noise.sigma > 1e-6 * np.ptp(values)
        long = [run for run in runs if run[1] - run[0] + 1 >= FROZEN_SAMPLES]
        abrupt = any(_comes_and_goes(signal, *run) == (True, True) for run in long)
        beyond = [(a, b) for a, b in runs if _height_over(signal, a, b, grain) > 1.0]
        ends = len(beyond) >= VISITS or any(b - a + 1 >= LONG_TOP for a, b in beyond)
        if not abrupt and not ends and not (noisy and at.sum() >= REPEATS):
            continue
        a, b = max(runs, key=lambda run: run[1] - run[0])
        length = sum(signal.time[last] - signal.time[first] for first, last in runs)
        limits.append(limit)
        findings.append(
            Finding(
                'sensor_clipping',
                'error',
                signal.channel,
                f'stays at {limit:.4g} for {length:.3f} s in all, in flat tops',
                float(signal.time[a]),
                float(signal.time[b]),
                int(signal.sample[a]),
                float(length),
                0.0,
            )
        )
    return findings, limits


def _grain(values: np.ndarray, level: float) -> float:
    """Step by which a signal goes on where neighbours are equal; 0 if hardly any are.

    A signal may be rounded though no one quantum fits it: rounded before a calibration that is
    no straight line, or in single precision. Its ends say nothing here, as it may be clipped.
    """
    inner = (values > values.min()) & (values < values.max())
    steps = np.abs(np.diff(values))
    pairs = np.flatnonzero((steps[:-1] == 0.0) & (steps[1:] > 0.0) & inner[:-2] & inner[2:])
    if len(pairs) < PAIRS:
        return 0.0
    grain = float(np.median(steps[pairs + 1]))
    # It may be coarser at that level, as floating point is coarser at large numbers.
    next_to = float(np.min(np.abs(values - level), where=values != level, initial=np.inf))
    return max(grain, min(next_to, COARSER * grain))


def _height_over(signal: Signal, first: int, last: int, grain: float) -> float:
    """How far a motion would go beyond a flat top, over what rounding and noise may feign."""
    values, time, noise = signal.values, signal.time, signal.noise
    n = TOP_SIDE
    if first < n or last + n >= len(values):
        return 0.0
    spacing = float(np.median(np.diff(time)))
    at = (np.arange(n) + 1.0) * spacing
    solve = np.linalg.pinv(np.vander(at, 3, increasing=True))[1]
    up = 1.0 if values[first] == values.max() else -1.0
    rise = -up * float(solve @ (values[first - n : first][::-1] - values[first]))
    fall = -up * float(solve @ (values[last + 1 : last + 1 + n] - values[last]))
    width = float(time[last] - time[first]) + spacing
    # A cubic with these slopes at its ends is this high in its middle.
    height = width * (rise + fall) / 8.0
    feigned = width * noise.sigma_floor * float(np.linalg.norm(solve)) * np.sqrt(2.0) / 8.0
    normal = TOP_QUANTA * grain + TOP_SIGMA * feigned + 1e-9 * float(np.ptp(values))
    # Beside a step one slope is not that of a motion.
    return height / normal if min(rise, fall) > ALIKE * max(rise, fall) > 0.0 else 0.0


def _frozen(signal: Signal, limits: list[float]) -> Iterator[Finding]:
    """A sensor that stops reporting motion.

    Nothing that moves several counts per sample stops within one sample without a knock, and
    nothing at rest is somewhere else one sample later. A signal whose noise vanishes has frozen
    too. Flat tops at the limits of a sensor are a finding of their own.
    """
    values, noise = signal.values, signal.noise
    runs = [(a, b) for a, b in constant_runs(values, FROZEN_SAMPLES) if values[a] not in limits]
    if not runs or np.ptp(values) == 0.0:
        return
    unit = max(noise.quantum, noise.sigma, 1e-9 * np.ptp(values))
    steps = np.abs(np.diff(values))
    usual = max(float(np.quantile(steps, 0.98)), unit)
    stuck: list[tuple[int, int]] = []
    for first, last in runs:
        came, left = _comes_and_goes(signal, first, last)
        release = steps[last] if last < len(steps) else 0.0
        silent = noise.sigma > noise.quantum and (
            _is_noisy(values[max(0, first - NOISY_SPAN) : first])
            or _is_noisy(values[last + 1 : last + 1 + NOISY_SPAN])
        )
        halts = came and (left or last == len(values) - 1)
        if release > RELEASE * usual or silent or halts:
            stuck.append((first, last))
    if stuck:
        spans = [(signal.time[a], signal.time[b]) for a, b in stuck]
        length = float(sum(b - a for a, b in spans))
        longest = max(range(len(spans)), key=lambda i: spans[i][1] - spans[i][0])
        yield Finding(
            'stuck',
            'error',
            signal.channel,
            f'does not change for {length:.2f} s in all while it should',
            float(spans[longest][0]),
            float(spans[longest][1]),
            int(signal.sample[stuck[longest][0]]),
            length,
            0.0,
        )


def _comes_and_goes(signal: Signal, first: int, last: int) -> tuple[bool, bool]:
    """Whether a signal moves right before a constant run, and right after it."""
    values, noise = signal.values, signal.noise
    unit = max(noise.quantum, noise.sigma, 1e-9 * float(np.ptp(values)))
    abrupt = ABRUPT * unit + ACCELERATING * _usual_bend(values)
    before, after = values[max(0, first - 5) : first + 1], values[last : last + 6]
    return _speed(before) > abrupt, _speed(after) > abrupt


def _usual_bend(values: np.ndarray) -> float:
    """Usual change of the step from one sample to the next, in the unit of the values."""
    stride = 5
    if len(values) <= 2 * stride:
        return 0.0
    bend = values[2 * stride :] - 2.0 * values[stride:-stride] + values[: -2 * stride]
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
        'spikes',
        'error' if len(spikes) > MANY_SPIKES * len(values) else 'warning',
        signal.channel,
        f'{len(spikes)} sample(s) far from their neighbours, the worst by {height[worst]:.3g}',
        at,
        at,
        int(signal.sample[spikes[worst]]),
        float(height[worst]),
    )


def limit_runs(signal: Signal) -> list[tuple[int, int]]:
    """Runs along the highest or the lowest value of a torque, as (first, last) indices.

    Steps and square waves hold a level on purpose: they have none.
    """
    values = signal.values
    if np.ptp(values) == 0.0 or len(np.unique(values)) < 0.05 * len(values):
        return []
    near = 1e-6 * float(np.abs(values).max())
    side = np.where(values >= values.max() - near, 1.0, 0.0)
    side = np.where(values <= values.min() + near, -1.0, side)
    return [(a, b) for a, b in constant_runs(side, LIMIT_RUN) if side[a]]


def _saturation(signal: Signal) -> Iterator[Finding]:
    """A torque that runs along a limit."""
    runs = limit_runs(signal)
    share = sum(b - a + 1 for a, b in runs) / len(signal.values)
    if share < SATURATED_SHARE:
        return
    a, b = max(runs, key=lambda run: run[1] - run[0])
    yield Finding(
        'saturation',
        'warning',
        signal.channel,
        f'the torque runs along {signal.values[a]:.4g} {signal.unit} for {share:.1%} '
        'of the samples',
        float(signal.time[a]),
        float(signal.time[b]),
        int(signal.sample[a]),
        share,
        SATURATED_SHARE,
    )
