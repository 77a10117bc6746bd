"""What is asked of a motion: stance legs, ends, limits, and what it costs."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cg_control.transcription import Structure
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
        effort: Weight of u^2, 1/((N m)^2 s).
        time: Weight of the duration, 1/s.
        slope: Fall of the ground ahead, rad.
        retraction: The swing foot may go this deep below the ground before it is ahead by 2 cm;
            infinite: it is not looked at, as on blocks. m.
        reach: Least step length, m.
        approach: Least rate at which the foot lands, m/s: the instant of a grazing impact is
            not defined well.
    """

    modes: tuple[str, ...]
    start: Box = UPRIGHT
    goal: Box | Ellipsoid = UPRIGHT
    periodic: bool = False
    torque_limit: float | None = None
    rate_limit: float = math.inf
    durations: tuple[float, float] = (0.1, 2.0)
    effort: float = 0.01
    time: float = 0.1
    slope: float = 0.0
    retraction: float = math.inf
    reach: float = 0.1
    approach: float = 0.05

    def __post_init__(self):
        object.__setattr__(self, 'modes', tuple(self.modes))
        for mode in self.modes:
            if mode not in STANCES:
                raise ValueError(f'modes: {mode!r} is not one of {", ".join(STANCES)}')
        if self.torque_limit is not None and not self.torque_limit >= 0:
            raise ValueError(f'torque_limit is {self.torque_limit}; it must not be negative')
        low, high = self.durations
        if not 0 < low < high:
            raise ValueError(f'durations are {self.durations}; they must be positive, increasing')
        if not self.rate_limit > 0 or not self.retraction >= 0:
            raise ValueError('rate_limit must be positive and retraction not negative')

    def structure(self, intervals: int, elastic: bool = False) -> Structure:
        """What has to be compiled for this task."""
        return Structure(
            self.modes,
            (intervals,) * len(self.modes),
            periodic=self.periodic,
            rate_limited=math.isfinite(self.rate_limit),
            clearance=math.isfinite(self.retraction),
            region=isinstance(self.goal, Ellipsoid),
            elastic=elastic,
        )
