"""The set-up of an experiment: what was done to the rig, apart from the robot itself."""

from dataclasses import dataclass
from typing import Any

from cg_description.schema import Flag, Key, ListOf, MapOf, Mapping, Number, Text
from cg_dynamics.errors import SetupError

DOWN = (0.0, 0.0, -1.0)
STANCES = ('inner', 'outer')
FIXTURES = ('none', 'inner_fixed', 'outer_fixed', 'legs_tied')
SPRING = Mapping({
    'body': Key(Text(STANCES), 'the leg pair it is tied to'),
    'point': Key(Number(), 'where on the leg, from its foot', unit='m'),
    'anchor': Key(ListOf(Number(), 2, 2), '[x, z] of the other end', unit='m'),
    'stiffness': Key(Number(0.0), unit='N/m'),
    'free_length': Key(Number(0.0), unit='m'),
})  # fmt: skip
SCHEMA = Mapping({
    'stance': Key(Text(STANCES), default='inner'),
    'fixture': Key(Text(FIXTURES), default='none'),
    'springs': Key(ListOf(SPRING), default=()),
    'on_blocks': Key(Flag(), default=True),
    'locked': Key(
        MapOf(Number()), 'joint of a URDF that something holds -> where', default={},
        unit='rad or m',
    ),
    'gravity': Key(
        ListOf(Number(), 3, 3), 'of a URDF: which way things fall in the frame of its root, '
        '[x, y, z]; the length does not count', default=DOWN,
    ),
})  # fmt: skip


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
    """What was done to the rig in one experiment (interfaces.md, "Setup")."""

    stance: str = 'inner'
    fixture: str = 'none'
    springs: tuple[Spring, ...] = ()
    on_blocks: bool = True
    locked: tuple[tuple[str, float], ...] = ()
    gravity: tuple[float, float, float] = DOWN

    def __post_init__(self):
        _one_of('stance', self.stance, STANCES)
        _one_of('fixture', self.fixture, FIXTURES)
        if not any(self.gravity):
            raise SetupError('setup.gravity: [0, 0, 0] is no direction')
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
        values = SCHEMA.of(entries, '', SetupError, path='setup')
        if 'stance' not in (entries or {}) and values['fixture'] == 'outer_fixed':
            values['stance'] = 'outer'
        values['springs'] = tuple(
            Spring(**{**spring, 'anchor': tuple(spring['anchor'])}) for spring in values['springs']
        )
        values['locked'] = tuple(sorted(values['locked'].items()))
        values['gravity'] = tuple(values['gravity'])
        return cls(**values)

    def to_dict(self) -> dict[str, Any]:
        """The mapping that `from_dict` reads back."""
        only_of_urdfs = {
            **({'locked': dict(self.locked)} if self.locked else {}),
            **({'gravity': list(self.gravity)} if self.gravity != DOWN else {}),
        }
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
            **only_of_urdfs,
        }


def _one_of(where: str, value: Any, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise SetupError(f'{where}: {value!r} is not one of {", ".join(allowed)}')
