"""Check of the instants of sampling: samples taken at other times than their stamps say.

The stamps may be as regular as they like; the samples know better (jitter.py).
"""

from collections.abc import Iterator, Mapping

from cg_sysid.checks.signals import Signal
from cg_sysid.records.findings import Finding
from cg_sysid.records.jitter import LEAST, TimingError, timing_error


def check_jitter(signals: Mapping[str, Signal]) -> Iterator[Finding]:
    """Findings about each sensor whose instants of sampling are not where its stamps say.

    Args:
        signals: Channels of the recording.
    """
    for topic, found in timing_errors(signals).items():
        own = [s for s in signals.values() if s.topic == topic]
        shown = ' and '.join(found.channels)
        yield Finding(
            'jitter',
            'warning',
            topic,
            f'the instants of sampling differ from the stamps by '
            f'{1e3 * found.sigma:.2g} +- {1e3 * found.error:.1g} ms RMS: the noise of {shown} '
            'grows with the rate, as no noise of a sensor does',
            value=found.sigma,
            allowed=LEAST / own[0].rate,
        )


def timing_errors(signals: Mapping[str, Signal]) -> dict[str, TimingError]:
    """Topic -> the error of its timing, where there is one to be seen."""
    moving = {n: s for n, s in signals.items() if s.is_position or s.is_rate}
    found = {
        topic: timing_error({
            n: (s.time, s.values) for n, s in moving.items() if s.topic == topic
        })
        for topic in sorted({s.topic for s in moving.values()})
    }  # fmt: skip
    return {topic: error for topic, error in found.items() if error is not None}
