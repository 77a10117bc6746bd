"""The set-up of an experiment: what was done to the rig, apart from the robot itself."""

import math
from dataclasses import dataclass
from typing import Any

from cg_dynamics.errors import SetupError

STANCES = ('inner', 'outer')
FIXTURES = ('none', 'inner_fixed', 'outer_fixed', 'legs_tied')


@dataclass(frozen=True)
class Spring:
    """A linear spring from a body to a point of the world.

    Attributes:
        body: The leg pair it is tied to, 'inner' or 'outer'.
        point: Where on the leg, in m from its foot.
        anchor: (x, z) of the other end in m, world frame, origin at the stance foot.
        stiffness: In N/m.
        free_length: In m.
    """

    body: str
    point: float
    anchor: tuple[float, float]
    stiffness: float
    free_length: float


@dataclass(frozen=True)
class Setup:
    """What was done to the rig in one experiment (docs/interfaces.md, "Setup")."""

    stance: str = 'inner'
    fixture: str = 'none'
    springs: tuple[Spring, ...] = ()
    on_blocks: bool = True

    def __post_init__(self):
        _one_of('stance', self.stance, STANCES)
        _one_of('fixture', self.fixture, FIXTURES)
        if self.fixture in ('inner_fixed', 'outer_fixed') and not self.fixture.startswith(
            self.stance
        ):
            raise SetupError(
                f'setup: fixture {self.fixture!r} holds the stance leg upright, '
                f'but stance is {self.stance!r}'
            )

    @property
    def may_step(self) -> bool:
        """False if a fixture or springs, whose anchors stay where they are, forbid a step."""
        return self.fixture == 'none' and not self.springs

    @classmethod
    def from_dict(cls, entries: dict[str, Any]) -> 'Setup':
        """Read a set-up as it stands in a recording note.

        Raises:
            SetupError: naming the entry that is wrong and what is allowed.
        """
        if not isinstance(entries, dict):
            raise SetupError(f'setup: expected a mapping, got {entries!r}')
        _known('setup', entries, cls.__dataclass_fields__)
        values = dict(entries)
        if 'fixture' in values and 'stance' not in values and values['fixture'] != 'legs_tied':
            values['stance'] = 'outer' if values['fixture'] == 'outer_fixed' else 'inner'
        values['springs'] = tuple(
            _spring(entry, f'setup.springs[{index}]')
            for index, entry in enumerate(entries.get('springs') or ())
        )
        return cls(**values)

    def to_dict(self) -> dict[str, Any]:
        """The mapping that `from_dict` reads back."""
        return {
            'stance': self.stance,
            'fixture': self.fixture,
            'springs': [
                {
                    'body': spring.body,
                    'point': spring.point,
                    'anchor': list(spring.anchor),
                    'stiffness': spring.stiffness,
                    'free_length': spring.free_length,
                }
                for spring in self.springs
            ],
            'on_blocks': self.on_blocks,
        }


def _spring(entry: Any, where: str) -> Spring:
    if not isinstance(entry, dict):
        raise SetupError(f'{where}: expected a mapping, got {entry!r}')
    _known(where, entry, Spring.__dataclass_fields__)
    missing = sorted(set(Spring.__dataclass_fields__) - set(entry))
    if missing:
        raise SetupError(f'{where}: {missing[0]!r} is missing')
    _one_of(f'{where}.body', entry['body'], STANCES)
    anchor = entry['anchor']
    if not isinstance(anchor, list | tuple) or len(anchor) != 2:
        raise SetupError(f'{where}.anchor: expected [x, z] in m, got {anchor!r}')
    numbers = {
        name: _number(entry[name], f'{where}.{name}')
        for name in ('point', 'stiffness', 'free_length')
    }
    if numbers['stiffness'] < 0 or numbers['free_length'] < 0:
        raise SetupError(f'{where}: stiffness and free_length must not be negative')
    x, z = (_number(value, f'{where}.anchor') for value in anchor)
    return Spring(body=entry['body'], anchor=(x, z), **numbers)


def _number(value: Any, where: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise SetupError(f'{where}: expected a finite number, got {value!r}')
    return float(value)


def _one_of(where: str, value: Any, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise SetupError(f'{where}: {value!r} is not one of {", ".join(allowed)}')


def _known(where: str, entries: dict, allowed) -> None:
    for key in entries:
        if key not in allowed:
            raise SetupError(f'{where}: unknown entry {key!r}; allowed: {", ".join(allowed)}')
