"""Homing, as a CiA 402 drive does it by itself (mode of operation 6): written from the standard.

It follows a position that moves at the speed of 0x6099:2, reached by the acceleration of 0x609A,
until the encoder's index comes by; there is home. It comes to rest and tells so by bits 10, 12 and
13 of the statusword. A shaft that does not follow is a homing error.

    method  33, 34   the next index in negative, in positive direction
            35, 37   home is where the shaft stands
"""

from dataclasses import dataclass

ATTAINED, REACHED, ERROR = 1 << 12, 1 << 10, 1 << 13
FOLLOWING = 640  # counts by which the shaft may stay behind
SMOOTHING = 0.02  # s, of the speed that it sees
STIFFNESS, DAMPING, INTEGRAL = 1.2, 0.16, 4.0  # per mille of rated: per count, per count/s; 1/s


@dataclass
class HomingMode:
    """One homing, from the rising edge of bit 4 on.

    Attributes:
        method: Of 0x6098.
        speed: Of the search for the index, counts/s.
        acceleration: In counts/s^2.
        at: Position of the shaft at the start, counts.
        home: Position of home in counts, None until it is found.
        failed: The shaft did not follow.
    """

    method: int
    speed: float
    acceleration: float
    at: float
    home: int | None = None
    failed: bool = False

    def __post_init__(self) -> None:
        self._wanted, self._rate = self.at, 0.0
        self._seen, self._seen_rate, self._sum = self.at, 0.0, 0.0
        if self.method in (35, 37):
            self.home = round(self.at)
        elif self.method not in (33, 34):
            self.failed = True

    @property
    def bits(self) -> int:
        """What the statusword says of it."""
        if self.failed:
            return ERROR | REACHED
        if self.home is None:
            return 0
        return ATTAINED | REACHED if self._rate == 0.0 else ATTAINED

    def pass_index(self, position: int, direction: int) -> None:
        """The shaft went over the index, in the direction of growing counts (1) or falling."""
        if self.home is None and not self.failed and direction == (self.method == 34) * 2 - 1:
            self.home = position

    def torque(self, counts: int, passed: float) -> int:
        """Torque in per mille of rated.

        Args:
            counts: Position of the shaft now.
            passed: Time in s since the last call.
        """
        goal = 0.0
        if self.home is None and not self.failed:
            goal = self.speed if self.method == 34 else -self.speed
        change = self.acceleration * passed
        self._rate += min(max(goal - self._rate, -change), change)
        self._wanted += self._rate * passed
        share = passed / (SMOOTHING + passed)
        self._seen_rate += share * ((counts - self._seen) / passed - self._seen_rate)
        self._seen = counts
        behind = self._wanted - counts
        if abs(behind) > FOLLOWING:
            self.failed, self._rate, self._wanted = True, 0.0, counts
            behind = self._sum = 0.0
        self._sum += INTEGRAL * behind * passed
        slower = self._rate - self._seen_rate
        return round(STIFFNESS * (behind + self._sum) + DAMPING * slower)
