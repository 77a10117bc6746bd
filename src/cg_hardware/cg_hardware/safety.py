"""What a torque command must be before it may reach a motor. Pure; no ROS.

The rule of the house: torque is zero when anything is in doubt. `TorqueGate` holds the last
command that was fit to be held and answers, at any instant, which torque may act:

- a command that is not finite, or of the wrong length, is refused, and the torque is zero until
  the next good one;
- a command beyond the limit is brought back to the limit (a motor saturates as well);
- a command older than `stale_after` counts as lost: torque zero;
- a command dated more than one sample ahead of the last measurement is refused when it comes, and
  changes nothing: it neither acts later nor stands before a good one;
- while more than one publisher is on the topic, nobody knows who controls: torque zero;
- optionally, the torque climbs away from zero no faster than `rate_limit`; towards zero it is
  always free.

The safety gate and the simulated hardware, in both its modes, apply these rules by this class.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from cg_interfaces.settings import Settings, setting
from cg_interfaces.stamps import NS_PER_S


@dataclass(frozen=True)
class GateSettings(Settings):
    """What the gate lets through."""

    torque_limit: float = setting(
        40.0, 'largest torque that is passed on', unit='N m', minimum=0.0, live=True
    )
    stale_after: float = setting(
        0.02,
        'age beyond which a command counts as lost and the torque is zero',
        unit='s',
        minimum=0.001,
        maximum=10.0,
        live=True,
    )
    rate_limit: float = setting(
        0.0, 'fastest growth of the torque, 0 for no limit', unit='N m/s', minimum=0.0, live=True
    )
    sample_rate_hz: float = setting(
        500.0,
        'rate of the measurements; a command dated more than one sample ahead is refused',
        unit='Hz',
        minimum=10.0,
        maximum=2000.0,
    )

    @property
    def sample_ns(self) -> int:
        """Time between two measurements in ns."""
        return round(NS_PER_S / self.sample_rate_hz)


@dataclass(frozen=True)
class Judgement:
    """Which torque may act, and why it is not what was asked for.

    Attributes:
        torque: In N m, one per joint.
        doubt: Empty if the request passes as it is.
        refused: The request changes nothing, and no answer to it may go on.
        unfit: It is no torque at all, or nobody knows whose it is; not only too large.
    """

    torque: tuple[float, ...]
    doubt: str = ''
    refused: bool = False
    unfit: bool = False


def judge(request: Sequence[float], joints: Sequence[str], limit: float) -> Judgement:
    """Judge one request by its values alone.

    Args:
        request: Torque asked for, in N m.
        joints: Names of the joints it must serve.
        limit: Largest magnitude allowed, in N m.
    """
    zero = (0.0,) * len(joints)
    if len(request) != len(joints):
        return Judgement(
            zero, f'{len(request)} torques for the joints {", ".join(joints)}', unfit=True
        )
    for joint, torque in zip(joints, request, strict=True):
        if not math.isfinite(torque):
            return Judgement(
                zero, f'torque of {joint} is {torque}; a finite number is needed', unfit=True
            )
    limited = tuple(min(max(float(torque), -limit), limit) for torque in request)
    for joint, torque, held in zip(joints, request, limited, strict=True):
        if torque != held:
            return Judgement(
                limited, f'torque of {joint} is {torque:.6g} N m; limited to {held:.6g} N m'
            )
    return Judgement(limited)


class TorqueGate:
    """Remembers the last command and says at any instant which torque may act.

    Attributes:
        settings: May be replaced at any time.
        joints: Names of the joints, in the order of the torques.
        publishers: How many publishers the topic of the commands has.
    """

    def __init__(self, settings: GateSettings, joints: Sequence[str]):
        self.settings = settings
        self.joints = tuple(joints)
        self.publishers = 1
        self._zero = (0.0,) * len(self.joints)
        self._held = Judgement(self._zero, 'no command yet')
        self._held_ns: int | None = None  # stamp of the command that is held
        self._since_ns = 0  # the same instant on the clock of `torque`
        self._output = self._zero
        self._output_ns: int | None = None

    @property
    def rivalry(self) -> str:
        """Why nobody is listened to; empty with one publisher or none."""
        if self.publishers <= 1:
            return ''
        return f'{self.publishers} publishers of the torque; zero until one is left'

    def offer(
        self, request: Sequence[float], stamp_ns: int, now_ns: int, measured_ns: int | None = None
    ) -> Judgement:
        """Take in a command, or refuse it.

        Args:
            request: Torque asked for, in N m, one per joint.
            stamp_ns: Of the measurement that it answers; 0 for the last one.
            now_ns: Present instant of the clock by which `torque` is asked.
            measured_ns: Stamp of the last measurement, on the clock of `stamp_ns`; None where that
                is also the clock of `torque`, and the last measurement is now.

        Returns:
            What came of it. The torque that acts is said by `torque` alone.
        """
        measured_ns = now_ns if measured_ns is None else measured_ns
        stamp_ns = stamp_ns or measured_ns
        ahead = stamp_ns - measured_ns
        if self.rivalry:
            self.drop(self.rivalry)
            return Judgement(self._zero, self.rivalry, unfit=True)
        if ahead > self.settings.sample_ns:
            return Judgement(
                self._held.torque,
                f'dated {ahead / NS_PER_S:.3g} s ahead of the last measurement; refused',
                refused=True,
            )
        if self._in_force(now_ns) and self._held_ns is not None and stamp_ns < self._held_ns:
            return Judgement(
                self._held.torque, 'older than the command before it; ignored', refused=True
            )
        self._held = judge(request, self.joints, self.settings.torque_limit)
        # What is a little early counts as of now: it must not stand before the next one.
        self._held_ns = min(stamp_ns, measured_ns)
        self._since_ns = now_ns + min(ahead, 0)
        return self._held

    def drop(self, reason: str) -> None:
        """Forget the command: torque zero until the next good one."""
        self._held = Judgement(self._zero, reason)
        self._held_ns = None

    def torque(self, now_ns: int) -> Judgement:
        """The torque that may act at `now_ns`."""
        judgement = self._held
        if self.rivalry:
            self.drop(self.rivalry)
            judgement = self._held
        elif self._held_ns is not None and not self._in_force(now_ns):
            age = (now_ns - self._since_ns) / NS_PER_S
            kind = 'old' if age > 0.0 else 'ahead of the clock'
            judgement = Judgement(self._zero, f'command is {abs(age):.3g} s {kind}')
        torque = self._slowed(judgement.torque, now_ns)
        self._output, self._output_ns = torque, now_ns
        return Judgement(torque, judgement.doubt)

    def _in_force(self, now_ns: int) -> bool:
        age = now_ns - self._since_ns
        return self._held_ns is not None and 0 <= age <= self.settings.stale_after * NS_PER_S

    def _slowed(self, wanted: tuple[float, ...], now_ns: int) -> tuple[float, ...]:
        if self.settings.rate_limit == 0.0:
            return wanted
        elapsed = 0.0 if self._output_ns is None else (now_ns - self._output_ns) / NS_PER_S
        step = self.settings.rate_limit * max(elapsed, 0.0)
        return tuple(
            _approach(before, after, step)
            for before, after in zip(self._output, wanted, strict=True)
        )


def _approach(before: float, after: float, step: float) -> float:
    """The value nearest to `after` that is at most `step` further from zero than `before`."""
    start = before if before * after > 0.0 else 0.0
    reach = abs(start) + step
    return min(max(after, -reach), reach)
