"""Orbits of one step length over speed, each planned from its neighbour."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cg_control.orbits.orbit import Orbit, plan_orbit
from cg_control.trajectories.collocation import PlanningError
from cg_dynamics.model import Model

NO_CHANGE = 1e-9  # m/s


@dataclass(frozen=True)
class OrbitLibrary:
    """Orbits of one step length on one slope.

    Attributes:
        orbits: By growing speed.
        slower: Why there are none slower.
        faster: Why there are none faster.
    """

    orbits: tuple[Orbit, ...]
    slower: str
    faster: str

    @property
    def speeds(self) -> np.ndarray:
        """Of the orbits, m/s, shape (n,)."""
        return np.array([orbit.speed for orbit in self.orbits])

    def nearest(self, speed: float) -> Orbit:
        """The orbit whose speed is nearest to one in m/s."""
        return self.orbits[int(np.abs(self.speeds - speed).argmin())]


def orbit_library(
    model: Model,
    step_length: float,
    slope: float = 0.0,
    torque_limit: float | None = None,
    begin: Sequence[float] = (0.25, 0.2, 0.3, 0.15),
    spacing: float = 0.05,
    resolution: float = 0.01,
    bounds: tuple[float, float] = (0.05, 1.0),
) -> OrbitLibrary:
    """Orbits from the slowest to the fastest speed that are reached without a gap.

    Args:
        model: The robot.
        step_length: Along the ground, m.
        slope: Fall of the ground ahead, rad.
        torque_limit: Of the motor, N m; None takes the model's.
        begin: Speeds of the first orbit, m/s, tried in turn.
        spacing: From speed to speed, m/s; halved near the ends, down to `resolution`.
        resolution: To which the ends are found, m/s.
        bounds: Slowest and fastest speed that are looked at, m/s.

    Raises:
        PlanningError: if there is none at the speeds to begin with.
    """
    first = _first(model, begin, step_length, slope, torque_limit)

    def towards(end: float) -> tuple[list[Orbit], str]:
        found, said = [first], f'{end:g} m/s is where the search ends'
        speed, stride = first.speed, math.copysign(spacing, end - first.speed)
        while abs(stride) >= resolution and abs(end - speed) > NO_CHANGE:
            wanted = speed + stride if abs(end - speed) > abs(stride) else end
            try:
                found.append(
                    plan_orbit(model, wanted, step_length, slope, torque_limit, near=found[-1])
                )
                speed = wanted
            except PlanningError as error:
                stride, said = stride / 2, str(error)
        return found[1:], said

    slow, slower = towards(bounds[0])
    fast, faster = towards(bounds[1])
    return OrbitLibrary((*reversed(slow), first, *fast), slower, faster)


def _first(model: Model, speeds: Sequence[float], *demand) -> Orbit:
    for speed in speeds[:-1]:
        try:
            return plan_orbit(model, speed, *demand)
        except PlanningError:
            continue
    return plan_orbit(model, speeds[-1], *demand)
