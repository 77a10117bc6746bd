"""Checks of joints that follow commanded positions: sign, unit, the right joint, how late.

A drive that follows positions may lag and err, but it goes where it is told. So the measured way
of a joint is like its command, somewhat later; where it is like that of another joint, or like its
own upside down or many times too large, the recording mixes something up.
"""

from collections.abc import Iterator, Mapping

import numpy as np

from cg_interfaces.stamps import NS_PER_S
from cg_sysid.checks.kinematics import DEGREES, UNIT_TOLERANCE
from cg_sysid.checks.signals import Signal
from cg_sysid.records.findings import Finding
from cg_sysid.records.raw import RawRecording, RawTopic

LATEST = 0.5  # s by which a joint may follow
STEP = 0.005  # s, of the lags that are tried
ALIKE = 0.9  # correlation of a way with that of which it is a copy
UNLIKE = 0.6  # and below which a joint does not follow its command
MOVES = 20.0  # noise floors that a way must span before it is compared


def check_following(raw: RawRecording, signals: Mapping[str, Signal]) -> Iterator[Finding]:
    """Findings about measured positions against those that the drives were told."""
    told, known = raw.topics.get(raw.told), raw.mechanism
    if told is None or known.told is None:
        return
    origin = min(int(t.stamp_ns.min()) for t in raw.topics.values() if len(t))
    ways: dict[str, tuple[Signal, str]] = {}
    for torque in known.torque.channels:
        measured = known.position_of(torque.name)
        command = next(c.name for c in known.told.channels
                       if (c.joint, c.field) == (torque.joint, 'position'))  # fmt: skip
        if measured in signals and command in told.values:
            ways[torque.joint] = signals[measured], command
    for joint, (signal, command) in ways.items():
        if np.ptp(signal.values) < MOVES * signal.noise.sigma_floor:
            continue
        own, lag, scale = _alike(told, command, signal, origin)
        if own < -ALIKE:
            yield Finding(
                'sign_error', 'error', signal.channel,
                f'moves against its command (correlation {own:.2f})', value=own, allowed=ALIKE,
            )  # fmt: skip
        elif own < UNLIKE:
            others = {
                other: _alike(told, theirs, signal, origin)[0]
                for other, (_, theirs) in ways.items() if other != joint
            }  # fmt: skip
            like = max(others, key=lambda other: others[other], default='')
            if like and others[like] > ALIKE:
                yield Finding(
                    'joints_swapped', 'error', signal.channel,
                    f'follows what {like} is told (correlation {others[like]:.2f}) and not its '
                    f'own command ({own:.2f})', value=own, allowed=UNLIKE,
                )  # fmt: skip
        elif own > ALIKE:
            for factor, which in ((DEGREES, 'position'), (1 / DEGREES, 'command')):
                if abs(scale / factor - 1) < UNIT_TOLERANCE:
                    yield Finding(
                        'unit', 'error', signal.channel,
                        f'moves {scale:.3g} times as far as it is told: its {which} is in '
                        'degrees', value=scale, allowed=1.0,
                    )  # fmt: skip
            yield Finding(
                'follows', 'info', signal.channel,
                f'follows its command {1e3 * lag:.0f} ms later, correlation {own:.3f}',
                value=lag,
            )  # fmt: skip


def _alike(
    told: RawTopic, command: str, signal: Signal, origin: int
) -> tuple[float, float, float]:
    """How alike a way is to a command: correlation, lag in s and slope, at the lag of the most."""
    stamps = told.stamp_ns[~told.absent[command]]
    values = told.values[command][~told.absent[command]]
    finite = np.isfinite(values)
    order = np.argsort(stamps[finite], kind='stable')
    stamps, values = stamps[finite][order], values[finite][order]
    best = 0.0, 0.0, 0.0
    for lag in np.arange(0.0, LATEST + STEP / 2, STEP):
        at = origin + np.round((signal.time - lag) * NS_PER_S).astype(np.int64)
        held = np.searchsorted(stamps, at, side='right') - 1
        there = held >= 0
        if there.sum() < len(at) / 2:
            continue
        x, y = values[held[there]], signal.values[there]
        if np.ptp(x) == 0.0:
            continue
        r = float(np.corrcoef(x, y)[0, 1])
        if abs(r) > abs(best[0]):
            best = r, float(lag), r * float(np.std(y) / np.std(x))
    return best
