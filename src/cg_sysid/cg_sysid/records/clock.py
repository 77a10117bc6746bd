"""The clock of each topic: stamps that jump, and how they are put right.

A sensor that samples regularly stamps regularly. Where a spacing is out of line and the stamps go
on regularly after it, either samples were lost and the stamps are right, or the clock jumped and
no sample is missing. Three witnesses tell them apart:

* the recorder's own clock, which did not jump with it;
* the other topics, with which a topic that lost nothing ends after its jump is taken out;
* the motion, which goes on from sample to sample as it always does.

A jump that they agree on is taken out of the stamps. Nothing else is touched here.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cg_interfaces.stamps import NS_PER_S
from cg_interfaces.topics import EXPERIMENT, TORQUE_COMMAND
from cg_sysid.records.findings import Finding
from cg_sysid.records.raw import RawRecording, RawTopic

FEWEST_SAMPLES = 100  # samples of a topic whose clock is looked at
REGULAR = 0.25  # stamps are regular where most spacings are this close to the usual one, [1]
MOST_REGULAR = 0.9  # [1]
OUT_OF_LINE = 0.4  # deviation of a spacing that may be a jump, in usual spacings, [1]
MOST_HOLES = 50  # holes behind regular stamps that are looked at
MUCH = 1.02  # arrivals take this much longer than stamps: many samples are lost, [1]
MOST_JUMPS = 3  # forward jumps that are looked at per topic; more are lost samples
SIDE = 12  # samples that predict the next ones
AHEAD = 5  # samples that are predicted, as their mean
TICKING = 1e-3  # spread of the spacings of a clock in hardware, [1]
FLOOR = 15  # arrivals whose earliest is the delay of the recorder without hold-ups
SURE = 5.0  # log odds beyond which a jump counts as such: 150 to 1
WITNESS = 15.0  # log odds that one witness can add at most
WORST = 8.0  # prediction errors in standard deviations beyond which nothing more is learnt


@dataclass(frozen=True)
class Jump:
    """A spacing out of line.

    Attributes:
        topic: Name of the topic.
        sample: Index of the first sample after it.
        before_ns: Stamp of the sample before it.
        excess_ns: Spacing less the usual one.
        odds: Log odds that the clock jumped, against samples lost in between.
    """

    topic: str
    sample: int
    before_ns: int
    excess_ns: int
    odds: float = 0.0


def mend_clocks(raw: RawRecording) -> tuple[RawRecording, list[Finding]]:
    """Take jumps of the clocks out of the stamps where that is safe.

    Returns:
        The recording with regular stamps, and a finding for each jump.
    """
    topics = {
        name: t
        for name, t in raw.topics.items()
        if name not in (EXPERIMENT, TORQUE_COMMAND) and usual_spacing(t.stamp_ns)
    }
    jumps = [jump for topic in topics.values() for jump in _out_of_line(topic)]
    if not jumps:
        return raw, []
    origin = min(int(t.stamp_ns.min()) for t in raw.topics.values() if len(t))
    mended, findings = dict(raw.topics), []
    for event in _events(jumps, topics):
        odds = sum(_witness(topics[j.topic], j) for j in event)
        if len(event) < len(topics):
            odds += sum(_agreement(topics, j, event) for j in event)
        jumped = odds > SURE
        for jump in event:
            if jumped and (len(event) == len(topics) or _starts_with_others(topics, jump)):
                mended[jump.topic] = _without(mended[jump.topic], jump)
                findings.append(_finding(jump, topics[jump.topic], origin, repaired=True))
            elif jumped or _goes_back(topics[jump.topic], jump):
                findings.append(_finding(jump, topics[jump.topic], origin, repaired=False))
    return replace(raw, topics=mended), findings


def usual_spacing(stamp_ns: np.ndarray) -> float:
    """Spacing of regular stamps in ns; 0 where they are not regular, or too few to tell."""
    spacing = np.diff(stamp_ns)
    if len(spacing) < FEWEST_SAMPLES:
        return 0.0
    usual = float(np.median(spacing))
    near = np.abs(spacing - usual) < REGULAR * usual
    return usual if usual > 0 and np.mean(near) > MOST_REGULAR else 0.0


def independent_arrivals(topic: RawTopic) -> bool:
    """Whether the recorder's clock says anything about the stamps: not in lock-step."""
    stamp, log = np.diff(topic.stamp_ns), np.diff(topic.log_ns)
    if not len(stamp) or not np.any(log != stamp):
        return False
    return bool(np.median(np.abs(log - stamp)) < 0.25 * np.median(np.abs(stamp)))


def lost_behind_stamps(topic: RawTopic, end_ns: float) -> tuple[list[int], int]:
    """Samples that were lost though the stamps go on as if none were.

    Arrivals that are late by whole samples are the places. Whether time passed there that the
    stamps do not show is for the motion to say, and for the other topics, which end later.

    Args:
        topic: Its samples.
        end_ns: Stamp with which the other topics end.

    Returns:
        Indices of the first samples after the holes, and about how many samples are missing;
        none and 0 if the stamps are right.
    """
    usual = usual_spacing(topic.stamp_ns)
    if not usual or not independent_arrivals(topic):
        return [], 0
    offset = (topic.log_ns - topic.stamp_ns) / usual
    late = np.rint(np.diff(offset))  # samples that may be missing before sample i + 1
    odds = 0.0
    if np.ptp(topic.log_ns) > MUCH * np.ptp(topic.stamp_ns):
        # A machine that is too slow is not late by whole samples.
        whole = np.abs(np.diff(offset) - late) < REGULAR
        odds -= 3.0 * WITNESS if np.mean(whole) > MOST_REGULAR else 0.0
    else:
        # Few are lost, if any. A message held up on its way is late too, but not for good.
        level = np.median(np.lib.stride_tricks.sliding_window_view(offset, 5), axis=1)
        for_good = np.zeros(len(late))
        for_good[4 : 4 + len(level) - 5] = np.rint(level[5:] - level[:-5])
        late = np.where(np.diff(offset) > 0.5, for_good, 0.0)
    places = np.flatnonzero(late >= 1.0)
    found = [int(i) + 1 for i in places[:MOST_HOLES]]
    for k in found:
        odds += _by_motion(topic, Jump(topic.name, k, 0, round(late[k - 1] * usual)))
    lost = int(late[places].sum())
    # What is lost never comes back; what a busy recorder held up does.
    if offset[-FLOOR:].min() - offset[:FLOOR].min() < 0.5 * lost:
        return [], 0
    if abs(end_ns - topic.stamp_ns[-1] - lost * usual) < 0.25 * min(lost, 6) * usual:
        odds -= WITNESS
    return (found, lost) if found and odds < -SURE else ([], 0)


def _out_of_line(topic: RawTopic) -> list[Jump]:
    """Lasting deviations from regular stamps, at most `MOST_JUMPS` of them."""
    stamp = topic.stamp_ns
    usual = usual_spacing(stamp)
    excess = np.diff(stamp) - usual
    found = []
    for k in np.flatnonzero(np.abs(excess) > OUT_OF_LINE * usual):
        # Two messages that overtook each other, or one late stamp, leave the rest in line.
        left, right = stamp[max(0, k - 4) : k + 1], stamp[k + 1 : k + 6]
        left = left + usual * (len(left) - 1 - np.arange(len(left)))
        right = right - usual * (1 + np.arange(len(right)))
        lasting = np.median(right) - np.median(left)
        if abs(lasting - excess[k]) < OUT_OF_LINE * usual:
            found.append(Jump(topic.name, int(k) + 1, int(stamp[k]), round(float(excess[k]))))
    backward = [jump for jump in found if jump.excess_ns < 0]
    forward = sorted((j for j in found if j.excess_ns > 0), key=lambda j: -j.excess_ns)
    # Many holes of one length are lost samples; a jump among them stands out.
    if len(forward) > MOST_JUMPS:
        often = 3.0 * float(np.median([jump.excess_ns for jump in forward]))
        forward = [jump for jump in forward[:MOST_JUMPS] if jump.excess_ns > often]
    return sorted(backward[:MOST_JUMPS] + forward, key=lambda jump: jump.sample)


def _events(jumps: Sequence[Jump], topics: dict[str, RawTopic]) -> Iterator[list[Jump]]:
    """Jumps that happened to several topics at once, together."""
    left = sorted(jumps, key=lambda jump: jump.before_ns)
    while left:
        first = left[0]
        usual = usual_spacing(topics[first.topic].stamp_ns)
        same: dict[str, Jump] = {}
        for jump in left:
            close = abs(jump.before_ns - first.before_ns) < 1.5 * usual
            if close and abs(jump.excess_ns - first.excess_ns) < usual:
                same.setdefault(jump.topic, jump)
        yield list(same.values())
        left = [jump for jump in left if same.get(jump.topic) is not jump]


def _goes_back(topic: RawTopic, jump: Jump) -> bool:
    """Whether time runs backwards, which needs no witness.

    A loop in software that was late for a few samples comes back by a short spacing.
    """
    return bool(topic.stamp_ns[jump.sample] <= jump.before_ns)


def _witness(topic: RawTopic, jump: Jump) -> float:
    """What the recorder's clock and the motion say about one topic, in log odds."""
    return _by_recorder(topic, jump) + _by_motion(topic, jump) + _by_grid(topic, jump)


def _by_grid(topic: RawTopic, jump: Jump) -> float:
    """Lost samples leave the stamps of a clock that ticks by itself on their grid."""
    usual = usual_spacing(topic.stamp_ns)
    spread = float(np.quantile(np.abs(np.diff(topic.stamp_ns) / usual - 1.0), 0.99))
    off = abs(jump.excess_ns / usual - round(jump.excess_ns / usual))
    # A loop in software that is late once may go on late; then the stamps are right.
    return WITNESS if jump.excess_ns > 0 and spread < TICKING and off > 0.2 else 0.0


def _by_recorder(topic: RawTopic, jump: Jump) -> float:
    if not independent_arrivals(topic):
        return 0.0
    offset, k = (topic.log_ns - topic.stamp_ns).astype(float), jump.sample
    before, after = offset[max(0, k - FLOOR) : k], offset[k : k + FLOOR]
    if min(len(before), len(after)) < FLOOR // 2:
        return 0.0
    windows = np.lib.stride_tricks.sliding_window_view(offset, FLOOR).min(axis=1)
    unsteady = 6.0 * float(np.median(np.abs(windows[FLOOR:] - windows[:-FLOOR])))
    change, size = after.min() - before.min(), jump.excess_ns
    tolerance = 0.3 * abs(size)
    if unsteady > tolerance:
        return 0.0
    if abs(change + size) < tolerance:
        return WITNESS
    return -WITNESS if abs(change) < tolerance else 0.0


def _by_motion(topic: RawTopic, jump: Jump) -> float:
    """Whether the samples after the jump follow one sampling time after those before it."""
    usual = usual_spacing(topic.stamp_ns)
    odds = 0.0
    for channel, values in topic.values.items():
        if topic.absent[channel].any() or not np.isfinite(values).all():
            continue
        jumped = _prediction(values, jump.sample, 1.0)
        passed = _prediction(values, jump.sample, 1.0 + jump.excess_ns / usual)
        if jumped is None or passed is None:
            continue
        # Gaussian likelihoods; the spread is how well such predictions come true elsewhere.
        odds += 0.5 * (min(abs(passed[0]), WORST) ** 2 - min(abs(jumped[0]), WORST) ** 2)
        odds += np.log(passed[1] / jumped[1])
    return float(np.clip(odds, -WITNESS, WITNESS))


def _prediction(values: np.ndarray, k: int, elapsed: float) -> tuple[float, float] | None:
    """Error of the samples at k, predicted from those before, in its usual size; and that size.

    Args:
        values: Regular samples, shape (M,).
        k: Index of the first sample to predict.
        elapsed: Time since the sample before, in sampling times; not 0, may be negative.
    """
    if k < SIDE or k + AHEAD > len(values):
        return None
    window = np.lib.stride_tricks.sliding_window_view
    target = window(values, AHEAD).mean(axis=1)  # of samples i .. i + AHEAD - 1
    before = window(values, SIDE)  # samples i .. i + SIDE - 1
    at = np.arange(SIDE) - (SIDE - 1.0)  # their times; the last one is at 0
    middle = 0.5 * (AHEAD - 1)
    shift = SIDE - 1 + round(elapsed)
    first, last = max(0, -shift), min(len(before), len(target) - shift)
    if last - first < FEWEST_SAMPLES // 2:
        return None
    best = None
    for degree in (0, 1, 2):
        solve = np.linalg.pinv(np.vander(at, degree + 1, increasing=True))
        weights = (round(elapsed) + middle) ** np.arange(degree + 1) @ solve
        errors = target[first + shift : last + shift] - before[first:last] @ weights
        usual = max(float(np.sqrt(np.mean(errors**2))), 1e-12 * float(np.ptp(values)), 1e-300)
        if best is None or usual < best[1]:
            weights = (elapsed + middle) ** np.arange(degree + 1) @ solve
            best = ((target[k] - before[k - SIDE] @ weights) / usual, usual)
    return best


def _agreement(topics: dict[str, RawTopic], jump: Jump, event: Sequence[Jump]) -> float:
    """Whether the topic ends with those that did not jump once the jump is taken out."""
    own = topics[jump.topic]
    usual = usual_spacing(own.stamp_ns)
    names = {j.topic for j in event}
    ends = [int(t.stamp_ns[-1]) for name, t in topics.items() if name not in names]
    apart = int(own.stamp_ns[-1]) - float(np.median(ends))
    near = 0.25 * min(abs(jump.excess_ns), 6.0 * usual)
    if abs(apart - jump.excess_ns) < near:
        return WITNESS
    return -WITNESS if abs(apart) < near else 0.0


def _starts_with_others(topics: dict[str, RawTopic], jump: Jump) -> bool:
    """Whether the stamps before the jump are the right ones: the topics begin together."""
    others = [int(t.stamp_ns[0]) for name, t in topics.items() if name != jump.topic]
    own = topics[jump.topic].stamp_ns
    near = max(2.5 * usual_spacing(own), 0.1 * abs(jump.excess_ns))
    return abs(int(own[0]) - float(np.median(others))) < near


def _without(topic: RawTopic, jump: Jump) -> RawTopic:
    later = np.arange(len(topic)) >= jump.sample
    stamp = topic.stamp_ns - jump.excess_ns * later
    # Where nobody noted the arrivals, they are the stamps once more.
    follows = not independent_arrivals(topic)
    arrival = topic.log_ns - jump.excess_ns * later if follows else topic.log_ns
    return replace(topic, stamp_ns=stamp, log_ns=arrival)


def _finding(jump: Jump, topic: RawTopic, origin: int, repaired: bool) -> Finding:
    size = 1e-6 * jump.excess_ns
    text = f'the stamps jump by {size:+.4g} ms, though no sample is missing'
    repair = f'the stamps after the jump were moved by {-size:+.4g} ms' if repaired else ''
    ends = sorted((jump.before_ns, int(topic.stamp_ns[jump.sample])))
    return Finding(
        'clock_jump',
        'warning' if repaired else 'error',
        jump.topic,
        text,
        (ends[0] - origin) / NS_PER_S,
        (ends[1] - origin) / NS_PER_S,
        jump.sample,
        jump.excess_ns / NS_PER_S,
        0.0,
        repair,
    )
