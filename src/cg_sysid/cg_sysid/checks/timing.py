"""Checks of the stamps: rate, gaps, order, and agreement with the recorder's clock."""

from collections.abc import Iterator, Sequence

import numpy as np

from cg_interfaces.stamps import NS_PER_S
from cg_interfaces.topics import APPLIED_TORQUE, EXPERIMENT, TORQUE_COMMAND
from cg_sysid.records.clock import FLOOR, independent_arrivals, lost_behind_stamps
from cg_sysid.records.findings import Finding
from cg_sysid.records.raw import RawRecording, RawTopic
from cg_sysid.records.torque_gaps import torque_gaps

GAP = 2.5  # a spacing this many times the usual one lacks samples, [1]
GAP_REGULAR = 1.8  # the same where the stamps are regular, [1]
REGULAR_SPREAD = 1.25  # regular: 95 % of the spacings are below this times the median, [1]
LONG_GAP_S = 0.1  # a torque that changed over a gap this long is not known, in s
LOST_SHARE = 0.5  # share lost in long gaps from which more is lost than there is, [1]
RATE_TOLERANCE = 0.05  # of the nominal rate, [1]
RATE_CHANGE = 0.15  # lasting change of the rate midway, [1]
RATE_BLOCK = 25  # samples per block when looking for a change of rate
CLOCK_JUMP_S = 0.02  # step between stamp and recorder's clock, in s
LATE_S = 0.5  # a topic that starts later or ends earlier than the others by this, in s
REGULAR = 0.3  # see bags.REGULAR_AFTER_SORTING
WAITED = 0.1  # of the spacing of two stamps: arrivals closer than this came out of a queue, [1]


def check_timing(raw: RawRecording) -> Iterator[Finding]:
    """Findings about the stamps of every topic of a recording.

    A torque command is sent whenever there is one, and a switch may be stamped when it changes:
    only their order is checked.
    """
    stamps = [t.stamp_ns for t in raw.topics.values() if len(t)]
    if not stamps:
        return
    origin = min(int(s.min()) for s in stamps)
    yield from _overlap(raw, origin)
    switches = {topic.name for topic in raw.mechanism.extra_inputs}
    for topic in raw.topics.values():
        if len(topic) < 2:
            yield Finding(
                'too_few_samples',
                'error',
                topic.name,
                f'{len(topic)} sample(s); at least 2 are needed',
                value=len(topic),
                allowed=2,
            )
            continue
        asked = topic.name == TORQUE_COMMAND and APPLIED_TORQUE in raw.topics
        yield from _order(topic, origin, asked)
        if topic.name in (EXPERIMENT, TORQUE_COMMAND, raw.told, *switches):
            continue
        yield from _arrivals(raw, topic, origin)
        yield from _gaps(raw, topic, origin)
        yield from _rate(topic, raw.note.get('nominal_rate_hz'), origin)


def _seconds(stamp_ns: int | np.integer, origin: int) -> float:
    return (int(stamp_ns) - origin) / NS_PER_S


def _overlap(raw: RawRecording, origin: int) -> Iterator[Finding]:
    """Topics that do not span the recording."""
    known = raw.mechanism
    names = [t.name for t in (known.torque, *known.outputs) if len(raw.topics.get(t.name, ()))]
    spans = {n: (raw.topics[n].stamp_ns.min(), raw.topics[n].stamp_ns.max()) for n in names}
    if len(spans) < 2:
        return
    start, stop = max(s for s, _ in spans.values()), min(e for _, e in spans.values())
    if start >= stop:
        late = max(spans, key=lambda n: spans[n][0])
        yield Finding(
            'no_overlap',
            'error',
            late,
            'the topics share no time: this one begins after another has ended',
            _seconds(spans[late][0], origin),
        )
        return
    first, last = min(s for s, _ in spans.values()), max(e for _, e in spans.values())
    for name, (begin, end) in spans.items():
        if begin - first > LATE_S * NS_PER_S:
            at = _seconds(begin, origin)
            yield Finding(
                'starts_late',
                'warning',
                name,
                f'first sample only after {at:.2f} s',
                0.0,
                at,
                0,
                at,
                LATE_S,
            )
        if last - end > LATE_S * NS_PER_S:
            begin_s, end_s = _seconds(end, origin), _seconds(last, origin)
            yield Finding(
                'ends_early',
                'warning',
                name,
                f'no sample in the last {end_s - begin_s:.2f} s',
                begin_s,
                end_s,
                len(raw.topics[name]) - 1,
                end_s - begin_s,
                LATE_S,
            )


def _order(topic: RawTopic, origin: int, asked: bool) -> Iterator[Finding]:
    """Stamps that repeat or run backwards.

    Args:
        topic: The topic.
        origin: Of the recording, ns.
        asked: It is what was asked for, beside what was applied: a command may be revised, as a
            gate does whose requests stop.
    """
    stamp = topic.stamp_ns
    step = np.diff(stamp)
    backward = np.flatnonzero(step < 0)
    if len(backward):
        k = int(backward[0]) + 1
        spacing = np.diff(np.unique(stamp))
        harmless = len(spacing) > 0 and spacing.min() >= REGULAR * np.median(spacing)
        yield Finding(
            'time_backwards',
            'warning' if harmless else 'error',
            topic.name,
            f'stamps run backwards {len(backward)} time(s), first by {-step[k - 1] / 1e6:.3g} ms'
            + ('; sorting restores their order' if harmless else ''),
            _seconds(stamp[k], origin),
            _seconds(stamp[k - 1], origin),
            k,
            float(step[k - 1]) / NS_PER_S,
            0.0,
        )
    order = np.argsort(stamp, kind='stable')
    repeats = np.flatnonzero(np.diff(stamp[order]) == 0)
    if len(repeats):
        k = int(order[repeats[0] + 1])
        conflict = any(
            np.any(v[order][repeats] != v[order][repeats + 1]) for v in topic.values.values()
        )
        yield Finding(
            'duplicates',
            'error' if conflict and not asked else 'warning',
            topic.name,
            f'{len(repeats)} stamp(s) occur twice'
            + (' with different values' if conflict else '; the copies are dropped'),
            _seconds(stamp[k], origin),
            sample=k,
            value=len(repeats),
            allowed=0,
        )


def _arrivals(raw: RawRecording, topic: RawTopic, origin: int) -> Iterator[Finding]:
    """Stamps against the recorder's clock: jumps between them, and a rate that only one knows.

    In lock-step simulation the two clocks run at different speeds and say nothing about each
    other.
    """
    if not independent_arrivals(topic):
        return
    # Messages that have waited for the recorder arrive with the next one: nobody paced them.
    paced = np.flatnonzero(np.diff(topic.log_ns) > WAITED * np.diff(topic.stamp_ns))
    if len(paced) < 4 * FLOOR:
        return
    found = (
        _rate_of_arrivals(topic, paced, origin)
        or _lost_behind(raw, topic, origin)
        or _clock_jump(topic, paced, origin)
    )
    if found is not None:
        yield found


def _rate_of_arrivals(topic: RawTopic, paced: np.ndarray, origin: int) -> Finding | None:
    """Messages that come at another rate from some instant on, by arrivals and not by stamps."""
    stamp, log = topic.stamp_ns[paced], topic.log_ns[paced]
    change = _change_of_rate(np.diff(log) / NS_PER_S)
    if (
        change is None
        or _change_of_rate(np.diff(stamp) / NS_PER_S) is not None
        or not _falls_behind(stamp, log, *change)
    ):
        return None
    k, before, after = change
    return Finding(
        'sampling_rate_change', 'error', topic.name,
        f'messages arrive at {before:.4g} Hz, later at {after:.4g} Hz, but the stamps go on '
        'as before: they are wrong',
        _seconds(stamp[k], origin), _seconds(stamp[-1], origin), int(paced[k]), after, before,
    )  # fmt: skip


def _lost_behind(raw: RawRecording, topic: RawTopic, origin: int) -> Finding | None:
    """Samples that did not arrive, while the stamps go on as if none were missing."""
    known = raw.mechanism
    ends = [
        raw.topics[t.name].stamp_ns[-1]
        for t in (known.torque, *known.outputs)
        if t.name != topic.name and len(raw.topics.get(t.name, ()))
    ]
    holes, lost = lost_behind_stamps(topic, float(np.median(ends)) if ends else np.inf)
    if not holes:
        return None
    k = holes[0]
    return Finding(
        'dropped_samples', 'error', topic.name,
        f'about {lost} sample(s) lost, the first here, while the stamps go on as if none were: '
        'they are wrong',
        _seconds(topic.stamp_ns[k - 1], origin), _seconds(topic.stamp_ns[holes[-1]], origin),
        k, lost, 0,
    )  # fmt: skip


def _clock_jump(topic: RawTopic, paced: np.ndarray, origin: int) -> Finding | None:
    """A clock that jumps moves the floor of the offset, to which late arrivals only add."""
    stamp, log = topic.stamp_ns[paced], topic.log_ns[paced]
    offset = (log - stamp).astype(float) / NS_PER_S
    windows = np.lib.stride_tricks.sliding_window_view(offset, FLOOR).min(axis=1)
    moved = windows[FLOOR:] - windows[:-FLOOR]  # sample k = index + FLOOR
    k = int(np.argmax(np.abs(moved))) + FLOOR
    before, after = np.median(windows[: max(1, k - FLOOR)]), np.median(windows[k:])
    lasting = float(after - before)
    if abs(moved[k - FLOOR]) < CLOCK_JUMP_S or abs(lasting) < 0.5 * CLOCK_JUMP_S:
        return None
    jumps = np.abs(np.diff(offset))
    near = slice(max(0, k - FLOOR), min(len(jumps), k + FLOOR))
    k = near.start + int(np.argmax(jumps[near])) + 1
    in_log = abs(log[k] - log[k - 1] - np.median(np.diff(log)))
    in_stamp = abs(stamp[k] - stamp[k - 1] - np.median(np.diff(stamp)))
    place = (_seconds(stamp[k - 1], origin), _seconds(stamp[k], origin), int(paced[k]))
    size = f'{1e3 * abs(lasting):.0f} ms'
    if in_stamp > in_log:
        return Finding(
            'clock_jump', 'error', topic.name,
            f"the stamps jump by {size} against the recorder's clock",
            *place, lasting, CLOCK_JUMP_S,
        )  # fmt: skip
    return Finding(
        'clock_jump', 'warning', topic.name,
        f"the recorder's clock jumps by {size} against the stamps",
        *place, lasting, CLOCK_JUMP_S, 'the stamps count, not the times of arrival',
    )  # fmt: skip


def _falls_behind(stamp: np.ndarray, log: np.ndarray, k: int, before: float, after: float) -> bool:
    """Whether arrivals from sample k on drift away from the stamps as their rates say.

    A recorder that was held up catches up again.
    """
    offset = (log - stamp) / NS_PER_S
    promised = (before / after - 1) * (stamp[-1] - stamp[k]) / NS_PER_S
    drifted = offset[-FLOOR:].min() - offset[max(0, k - FLOOR) : k + 1].min()
    return bool(abs(drifted - promised) < 0.5 * abs(promised))


def _gaps(raw: RawRecording, topic: RawTopic, origin: int) -> Iterator[Finding]:
    """Spacings that lack samples."""
    order = np.argsort(topic.stamp_ns, kind='stable')
    stamp = topic.stamp_ns[order]
    spacing = np.diff(stamp)
    if not np.any(spacing > 0):
        return
    usual, limit = np.empty(len(spacing)), np.empty(len(spacing))
    change = _change_of_rate(spacing / NS_PER_S)
    for part in (slice(0, change[0]), slice(change[0], None)) if change else (slice(None),):
        positive = spacing[part][spacing[part] > 0]
        usual[part] = np.median(positive)
        regular = np.quantile(positive, 0.95) < REGULAR_SPREAD * usual[part][0]
        limit[part] = (GAP_REGULAR if regular else GAP) * usual[part]
    gaps = np.flatnonzero(spacing > limit)
    if not len(gaps):
        return
    lost = int(np.sum(np.rint(spacing[gaps] / usual[gaps]) - 1))
    share = lost / (len(stamp) + lost)
    worst, unknown, repair = int(gaps[np.argmax(spacing[gaps])]), False, 'they are left out'
    torques = [name for name in raw.mechanism.input_names if name in topic.values]
    measures = len(topic.values) > len(torques)
    if torques:
        unknown, worst, filled = _torque_over(topic, torques, order, gaps, worst)
        repair = f'{repair}; {filled}' if measures else filled
    if measures and share > LOST_SHARE and spacing[worst] > LONG_GAP_S * NS_PER_S:
        # A sensor that reports only now and then is read as it comes; one that stops is not.
        unknown = True
    length = spacing[worst] / NS_PER_S
    consequence = '; what happened in between is not known' if unknown else ''
    yield Finding(
        'dropped_samples',
        'error' if unknown else 'warning',
        topic.name,
        f'{len(gaps)} gap(s), about {lost} sample(s) lost ({share:.1%}); the '
        f'{"worst" if unknown else "longest"} {1e3 * length:.1f} ms instead of '
        f'{usual[worst] / 1e6:.3g} ms' + consequence,
        _seconds(stamp[worst], origin),
        _seconds(stamp[worst + 1], origin),
        int(order[worst]),
        length,
        limit[worst] / NS_PER_S,
        '' if unknown else repair,
    )


def _torque_over(
    topic: RawTopic, torques: Sequence[str], order: np.ndarray, gaps: np.ndarray, worst: int
) -> tuple[bool, int, str]:
    """Whether a torque is not known somewhere; the worst gap; what is done about the others."""
    stamp = topic.stamp_ns[order]
    filled = 0
    for values in (topic.values[name] for name in torques):
        known = torque_gaps(stamp, values[order])
        bad = [gap for gap in known if not gap.known]
        if bad:
            return True, max(bad, key=lambda gap: gap.lost).sample, ''
        filled = max(filled, sum(gap.lost for gap in known))
        among = {gap.sample for gap in known}
        for k in gaps:
            changed = values[order][k] != values[order][k + 1]
            long = stamp[k + 1] - stamp[k] > LONG_GAP_S * NS_PER_S
            if k not in among and long and changed:
                return True, int(k), ''
    if not filled:
        return False, worst, 'the torque is held over the gaps'
    return False, worst, f'{filled} sample(s) of the torque filled from their neighbours'


def _rate(topic: RawTopic, nominal_hz: object, origin: int) -> Iterator[Finding]:
    """Rates that differ from the nominal one, or change midway."""
    stamp = np.unique(topic.stamp_ns)
    spacing = np.diff(stamp) / NS_PER_S
    if len(spacing) < 4:
        return
    # Without the gaps, which have a finding of their own; the mean knows jitter, the median not.
    regular = spacing[spacing <= GAP * np.median(spacing)]
    rate = 1.0 / float(np.mean(regular))
    change = _change_of_rate(spacing)
    if change is not None:
        k, before, after = change
        yield Finding(
            'sampling_rate_change',
            'warning',
            topic.name,
            f'the rate changes midway, from {before:.4g} Hz to {after:.4g} Hz',
            _seconds(stamp[k], origin),
            _seconds(stamp[-1], origin),
            k,
            after,
            before,
            'samples count at their stamps, whatever their rate',
        )
    if not isinstance(nominal_hz, int | float) or not nominal_hz > 0:
        return
    if abs(rate / nominal_hz - 1.0) > RATE_TOLERANCE:
        yield Finding(
            'rate',
            'warning',
            topic.name,
            f'{rate:.4g} Hz instead of the nominal {nominal_hz:.4g} Hz',
            value=rate,
            allowed=nominal_hz,
        )


def _change_of_rate(spacing: np.ndarray) -> tuple[int, float, float] | None:
    """Place of the lasting change of the rate, and the rates before and after, if there is one."""
    blocks = len(spacing) // RATE_BLOCK
    if blocks < 6:
        return None
    trimmed = spacing[: blocks * RATE_BLOCK].reshape(blocks, RATE_BLOCK)
    levels = np.log(np.median(trimmed, axis=1))
    total = np.cumsum(levels)
    left = np.arange(3, blocks - 2)
    contrast = total[left - 1] / left - (total[-1] - total[left - 1]) / (blocks - left)
    weight = np.sqrt(left * (blocks - left) / blocks)
    cut = int(left[np.argmax(np.abs(contrast) * weight)])
    before, after = np.median(levels[:cut]), np.median(levels[cut:])
    spread = np.median(np.abs(np.concatenate([levels[:cut] - before, levels[cut:] - after])))
    if abs(after - before) < np.log1p(RATE_CHANGE) or abs(after - before) < 6.0 * spread:
        return None
    return cut * RATE_BLOCK, float(np.exp(-before)), float(np.exp(-after))
