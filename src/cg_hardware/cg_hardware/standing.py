"""How a robot that is to stand on one leg fares, by the simulated machine's true state."""

import collections
import json
from dataclasses import asdict, dataclass
from pathlib import Path

from cg_description.model_file import write_atomically

TAIL = 0.5  # s before the end over which a lean counts as that of the end


@dataclass(frozen=True)
class Outcome:
    """How it fared.

    Attributes:
        duration: How long the machine ran, s.
        stance: The leg that stands at the end.
        largest_lean: Of the stance leg over the whole run, rad.
        last_lean: The same over the last TAIL, rad.
        fell_at: When it fell, s; None if it did not.
        stepped_at: When the stance leg changed, s.
    """

    duration: float
    stance: str
    largest_lean: float
    last_lean: float
    fell_at: float | None = None
    stepped_at: tuple[float, ...] = ()

    @classmethod
    def load(cls, path: Path) -> 'Outcome':
        """The outcome that `save` wrote.

        Raises:
            OSError: There is none.
        """
        entries = json.loads(path.read_text(encoding='utf-8'))
        return cls(**entries | {'stepped_at': tuple(entries['stepped_at'])})

    def save(self, path: Path) -> None:
        """Write it as JSON."""
        write_atomically(path, json.dumps(asdict(self)))


class Standing:
    """Watches one run of a robot that is to stand.

    Args:
        fall_angle: Lean of the stance leg in rad beyond which the robot has fallen.
        stance: The leg that stands at the start.
        sample_time: From one look to the next, s.
    """

    def __init__(self, fall_angle: float, stance: str, sample_time: float):
        self._fall_angle, self._stance = fall_angle, stance
        self._time = self._largest = 0.0
        self._tail: collections.deque[float] = collections.deque(maxlen=round(TAIL / sample_time))
        self._fell_at: float | None = None
        self._stepped_at: list[float] = []

    def see(self, time: float, stance: str, lean: float) -> bool:
        """Take one sample in; False if the robot has fallen.

        Args:
            time: From the start, s.
            stance: The leg that stands.
            lean: Its angle from the upward vertical, rad.
        """
        if stance != self._stance:
            self._stance = stance
            self._stepped_at.append(time)
        self._time = time
        self._tail.append(abs(lean))
        self._largest = max(self._largest, abs(lean))
        if self._fell_at is None and abs(lean) > self._fall_angle:
            self._fell_at = time
        return self._fell_at is None

    @property
    def outcome(self) -> Outcome:
        """How it has fared until now."""
        return Outcome(
            self._time,
            self._stance,
            self._largest,
            max(self._tail, default=0.0),
            self._fell_at,
            tuple(self._stepped_at),
        )
