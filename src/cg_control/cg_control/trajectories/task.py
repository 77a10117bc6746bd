"""What is asked of a motion: stance legs, ends, limits, and what it costs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cg_control.trajectories.transcription import PIECES, Structure
from cg_dynamics.rig import STANCES


@dataclass(frozen=True)
class Box:
    """A set of states between bounds; equal bounds make a point.

    Attributes:
        lower: (q_inner, q_outer) and rates, shape (4,); -inf where free.
        upper: As `lower`.
    """

    lower: np.ndarray
    upper: np.ndarray

    def __post_init__(self):
        for name in ('lower', 'upper'):
            value = np.array(getattr(self, name), float)
            if value.shape != (4,) or np.isnan(value).any():
                raise ValueError(
                    f'{name} of a set of states must be 4 numbers (q_inner, q_outer and rates), '
                    f'got {value.tolist()}'
                )
            object.__setattr__(self, name, value)
        if not (self.lower <= self.upper).all():
            raise ValueError('a set of states has lower bounds above its upper bounds')

    @classmethod
    def point(cls, x: Sequence[float] | np.ndarray) -> 'Box':
        """One state."""
        x = np.array(x, float)
        if x.shape != (4,) or not np.isfinite(x).all():
            raise ValueError(
                f'a state must be 4 finite numbers (q_inner, q_outer and rates), got {x.tolist()}'
            )
        return cls(x, x)

    @classmethod
    def anywhere(cls) -> 'Box':
        """Any state."""
        return cls(np.full(4, -np.inf), np.full(4, np.inf))

    @property
    def center(self) -> np.ndarray:
        """Middle of the bounds, 0 where there are none."""
        with np.errstate(invalid='ignore'):
            middle = (self.lower + self.upper) / 2
        return np.where(np.isfinite(middle), middle, 0.0)


@dataclass(frozen=True)
class Ellipsoid:
    """The states with (x - center)' form (x - center) <= 1, as a basin of attraction.

    Attributes:
        center: Shape (4,).
        form: Shape (4, 4), symmetric, positive definite.
    """

    center: np.ndarray
    form: np.ndarray


@dataclass(frozen=True)
class Stretch:
    """Any point x0(s) of a stretch of a branch, 0 <= s <= length: a goal that slides.

    The rest of the way along the stretch is part of the cost, with the weights of the task: so
    the motion joins where that is cheapest, and costs of stretches of one length compare.

    Attributes:
        stance: Leg that stands.
        node: Nodes at which its pieces begin, at most PIECES of them, shape (n,).
        span: Time to the next node, s, shape (n,).
        edges: (u0, x0) on the way there as powers of the time since the node, shape (n, 4, 5).
        form: Points with (x - x0(s))' form (x - x0(s)) <= 1 count as well, shape (4, 4),
            symmetric, positive definite; None: x0(s) itself is met.
    """

    stance: str
    node: np.ndarray
    span: np.ndarray
    edges: np.ndarray
    form: np.ndarray | None = None

    def __post_init__(self):
        n = len(self.node)
        if not 1 <= n <= PIECES:
            raise ValueError(f'a stretch has {n} pieces; allowed are 1 to {PIECES}')
        shapes = {'span': (n,), 'edges': (n, 4, 5)}
        if self.form is not None:
            shapes['form'] = (4, 4)
        for name, shape in shapes.items():
            value = np.array(getattr(self, name), float)
            if value.shape != shape or not np.isfinite(value).all():
                raise ValueError(f'{name} of a stretch must be finite numbers of shape {shape}')
            object.__setattr__(self, name, value)
        if not (self.span > 0).all():
            raise ValueError('each piece of a stretch must last')

    @property
    def length(self) -> float:
        """In s."""
        return float(self.span.sum())

    def place(self, s: float) -> tuple[int, float]:
        """Where x0(s) is: a node, and the time since in s; what `Nodes.grafted` takes."""
        piece, since = self._piece(s)
        return int(self.node[piece]), since

    def at(self, s: float) -> np.ndarray:
        """x0(s), shape (4,)."""
        piece, since = self._piece(s)
        return since ** np.arange(4.0) @ self.edges[piece][:, 1:]

    @property
    def center(self) -> np.ndarray:
        """Its middle in time."""
        return self.at(self.length / 2)

    def _piece(self, s: float) -> tuple[int, float]:
        starts = np.cumsum(self.span) - self.span
        piece = max(int(np.searchsorted(starts, s, side='right')) - 1, 0)
        return piece, float(np.clip(s - starts[piece], 0.0, self.span[piece]))


Goal = Box | Ellipsoid | Stretch
UPRIGHT = Box.point(np.zeros(4))


@dataclass(frozen=True)
class Task:
    """What is asked of a motion.

    Attributes:
        modes: Stance leg of each phase.
        start: States to start from.
        goal: States to end in; for a periodic motion bounds that its end must keep.
        periodic: The motion ends with an impact after which it begins anew.
        torque_limit: In N m; None takes the model's.
        rate_limit: Of the torque, N m/s.
        durations: Shortest and longest phase, s.
        total: Shortest and longest motion as a whole, s; None: as long as its phases may be.
        effort: Weight of u^2, 1/((N m)^2 s).
        time: Weight of the duration, 1/s.
        slope: Fall of the ground ahead, rad.
        retraction: The swing foot may go this deep below the ground before it is ahead by 2 cm;
            infinite: it is not looked at, as on blocks. m.
        reach: Least step length, horizontally, m.
        farthest: Greatest step length, horizontally, m.
        approach: Least rate at which the foot lands, m/s: the instant of a grazing impact is
            not defined well.
    """

    modes: tuple[str, ...]
    start: Box = UPRIGHT
    goal: Goal = UPRIGHT
    periodic: bool = False
    torque_limit: float | None = None
    rate_limit: float = math.inf
    durations: tuple[float, float] = (0.1, 2.0)
    total: tuple[float, float] | None = None
    effort: float = 0.01
    time: float = 0.1
    slope: float = 0.0
    retraction: float = math.inf
    reach: float = 0.1
    farthest: float = math.inf
    approach: float = 0.05

    def __post_init__(self):
        object.__setattr__(self, 'modes', tuple(self.modes))
        for mode in self.modes:
            if mode not in STANCES:
                raise ValueError(f'modes: {mode!r} is not one of {", ".join(STANCES)}')
        if self.torque_limit is not None and not self.torque_limit >= 0:
            raise ValueError(f'torque_limit is {self.torque_limit}; it must not be negative')
        if isinstance(self.goal, Stretch) and self.periodic:
            raise ValueError('a periodic motion has no stretch to end on')
        if isinstance(self.goal, Stretch) and self.goal.stance != self.modes[-1]:
            raise ValueError(
                f'the goal is a stretch on the {self.goal.stance} leg, the motion ends on the '
                f'{self.modes[-1]} leg'
            )
        low, high = self.durations
        if not 0 < low < high:
            raise ValueError(f'durations are {self.durations}; they must be positive, increasing')
        if self.total is not None and not 0 < self.total[0] <= self.total[1]:
            raise ValueError(f'total is {self.total}; it must be positive, not decreasing')
        if not self.reach <= self.farthest:
            raise ValueError(f'reach is {self.reach}, above farthest, {self.farthest}')
        if not self.rate_limit > 0 or not self.retraction >= 0:
            raise ValueError('rate_limit must be positive and retraction not negative')

    def structure(
        self, intervals: int, elastic: bool = False, given_back: tuple[str, ...] = ()
    ) -> Structure:
        """What has to be compiled for this task; arguments as the attributes of a structure."""
        return Structure(
            self.modes,
            (intervals,) * len(self.modes),
            periodic=self.periodic,
            rate_limited=math.isfinite(self.rate_limit),
            clearance=math.isfinite(self.retraction),
            clocked=self.total is not None,
            goal=self._kind(),
            elastic=elastic,
            given_back=given_back,
        )

    def _kind(self) -> str:
        if isinstance(self.goal, Stretch):
            return 'stretch' if self.goal.form is None else 'tube'
        return 'region' if isinstance(self.goal, Ellipsoid) else 'box'
