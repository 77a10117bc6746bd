"""How old a measurement was when the drive latched the torque that answers it."""

import collections

import numpy as np

REMEMBERED = 20  # answers that may still be on their way
KEPT = 5000  # ages


class AnswerAges:
    """Ages of the last answers.

    Attributes:
        missed: Deadlines, since `figures` was asked for the last time.
    """

    def __init__(self) -> None:
        self.missed = 0
        self._ages: collections.deque[float] = collections.deque(maxlen=KEPT)
        self._sent: collections.OrderedDict[int, float] = collections.OrderedDict()

    def __len__(self) -> int:
        return len(self._ages)

    def sent(self, stamp_ns: int, torque: float) -> None:
        """Note an answer, a torque in N m, to the measurement of that instant."""
        self._sent[stamp_ns] = torque
        while len(self._sent) > REMEMBERED:
            self._sent.popitem(last=False)

    def latched(self, stamp_ns: int, torque: float, deadline: float) -> None:
        """Note that the drive has latched a torque.

        Args:
            stamp_ns: When, on the clock of the measurements.
            torque: In N m.
            deadline: Age in s at which it is late.
        """
        answered = [stamp for stamp, sent in self._sent.items() if sent == torque]
        # Equal torques (zero, the limit) do not tell which of them was latched.
        if len(answered) == 1 and answered[0] <= stamp_ns:
            age = (stamp_ns - answered[0]) * 1e-9
            self._ages.append(age)
            self.missed += age > deadline

    def figures(self, deadline: float) -> dict[str, str | int]:
        """What /diagnostics says of them: deadlines missed since the last call, ages in ms."""
        found: dict[str, str | int] = {
            'missed_deadlines': self.missed,
            'deadline_ms': f'{1e3 * deadline:.3f}',
        }
        self.missed = 0
        if self._ages:
            found |= percentiles('age', 'ms', 1e3 * np.array(self._ages), 3)
        return found


def percentiles(name: str, unit: str, values: np.ndarray, digits: int) -> dict[str, str | int]:
    """Median, 99 % and largest of some values, as /diagnostics says them."""
    return {
        f'{name}_p50_{unit}': f'{np.percentile(values, 50):.{digits}f}',
        f'{name}_p99_{unit}': f'{np.percentile(values, 99):.{digits}f}',
        f'{name}_max_{unit}': f'{values.max():.{digits}f}',
    }
