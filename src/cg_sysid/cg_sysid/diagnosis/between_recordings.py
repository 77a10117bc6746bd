"""A number of the machine that every recording wants another value of, in words.

How it is found is in by_recording.py.
"""

from dataclasses import dataclass
from itertools import pairwise

from cg_sysid.text import measured


@dataclass(frozen=True)
class Wandering:
    """A number that every recording wants another value of.

    Attributes:
        name: Full parameter name.
        unit: Its unit.
        values: Recording -> value and standard deviation, in the order of their names.
        explained: Share of the squared error above the noise that is gone with these values.
    """

    name: str
    unit: str
    values: dict[str, tuple[float, float]]
    explained: float

    @property
    def text(self) -> str:
        """One sentence for people."""
        sizes = [value for value, _ in self.values.values()]
        steps = [b - a for a, b in pairwise(sizes)]
        way = 'falling' if max(steps) < 0 else 'rising' if min(steps) > 0 else 'up and down'
        least, *_, most = sorted(self.values, key=lambda recording: self.values[recording][0])
        between = ' to '.join(
            f'{measured(*self.values[recording], self.unit)} in {recording}'
            for recording in (least, most)
        )
        return (
            f'{self.name} differs from recording to recording, {way} in the order of their names, '
            f'from {between}: a value for each takes away {100 * self.explained:.3g} % of the '
            'error above the noise.'
        )
