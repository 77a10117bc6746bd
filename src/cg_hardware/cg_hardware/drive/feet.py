"""The feet are drawn in by outputs of the drive, so that a swing leg clears the ground. No ROS.

An output that is off is a foot that is out: that is the safe state, and so it should be wired. A
foot is drawn in only while

- somebody asked for it no longer than `stale_after` ago, and nobody else asks on its topic;
- the drive is enabled;
- nobody asks for both: a robot without feet falls.
"""

import math
from collections.abc import Mapping

REPEATED = 25  # cycles in which the outputs are sent again, changed or not


class FootRetraction:
    """Who asked for what, and which outputs follow from it.

    Args:
        bits: Leg -> bit of the outputs.
        stale_after: Age of a request beyond which it counts as withdrawn, s.
    """

    def __init__(self, bits: Mapping[str, int], stale_after: float):
        self.bits, self.stale_after = dict(bits), stale_after
        self._asked = dict.fromkeys(self.bits, -math.inf)  # leg -> when

    @property
    def mask(self) -> int:
        """Outputs that belong to feet."""
        return sum(1 << bit for bit in self.bits.values())

    def ask(self, leg: str, retracted: bool, now: float) -> None:
        """A request at time `now` in s."""
        self._asked[leg] = now if retracted else -math.inf

    def retracted(self, now: float) -> tuple[str, ...]:
        """Legs whose foot is asked to be in."""
        return tuple(leg for leg, at in self._asked.items() if now - at <= self.stale_after)

    def outputs(self, now: float, enabled: bool) -> int:
        """What the outputs of the drive shall be at time `now` in s."""
        legs = self.retracted(now)
        if not enabled or len(legs) != 1:
            return 0
        return 1 << self.bits[legs[0]]
