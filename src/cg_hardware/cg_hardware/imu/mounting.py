"""How an IMU sits on the inner legs: which of its axes is the hip's, with which sign and zero."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

AXES = ('roll', 'pitch', 'yaw')  # angles about the device's x, y, z
STILL = 2e-3  # rad: standard deviation of the lean of legs that stand still, with room
FEWEST = 50  # samples that a zero is averaged over
LEANED = 0.1  # rad that the legs must lean to tell an axis from the two others
CLEAR = 3.0  # times that the lean about one axis exceeds that about the others


class MountingError(ValueError):
    """What was recorded tells no zero, or no axis."""


@dataclass(frozen=True)
class Mounting:
    """From the device's axes to the lean of the inner legs.

    Attributes:
        axis: Which of the device's angles is the lean: 'roll', 'pitch' or 'yaw'.
        sign: 1.0, or -1.0 where the device counts a forward lean negative.
        zero: Angle in rad that it reads when the legs are upright, sign applied.
    """

    axis: str = 'pitch'
    sign: float = 1.0
    zero: float = 0.0

    def lean(self, euler: Sequence[float]) -> float:
        """Lean of the inner legs in rad, positive forward, in (-pi, pi]."""
        angle = self.sign * euler[AXES.index(self.axis)] - self.zero
        return math.pi - (math.pi - angle) % (2 * math.pi)

    def rate(self, rates: Sequence[float]) -> float:
        """Its rate in rad/s."""
        return self.sign * rates[AXES.index(self.axis)]


@dataclass(frozen=True)
class Zero:
    """A zero, and how well it was taken.

    Attributes:
        angle: In rad, sign applied.
        still: Standard deviation of the samples in rad.
        samples: How many.
    """

    angle: float
    still: float
    samples: int


def zero_of(angles: Sequence[float]) -> Zero:
    """The zero from angles read while the legs stood upright, in rad.

    Raises:
        MountingError: Too few, or the legs moved.
    """
    if len(angles) < FEWEST:
        raise MountingError(f'{len(angles)} samples came, at least {FEWEST} are needed')
    found = np.unwrap(np.asarray(angles, float))
    still = float(found.std())
    if still > STILL:
        raise MountingError(
            f'the legs moved: the angle varies by {1e3 * still:.2g} mrad, at most '
            f'{1e3 * STILL:g} mrad are allowed'
        )
    return Zero(float(found.mean()), still, len(found))


def mounting_of(upright: Sequence[float], forward: Sequence[float]) -> Mounting:
    """The axis and its sign, from the Euler angles upright and leaning forward.

    Args:
        upright: Roll, pitch, yaw in rad of legs that stand upright.
        forward: The same of legs that lean forward, by some tenths of a rad.

    Raises:
        MountingError: The lean is too small, or about no single axis.
    """
    moved = np.asarray(forward, float) - np.asarray(upright, float)
    moved = (moved + math.pi) % (2 * math.pi) - math.pi
    k = int(np.argmax(np.abs(moved)))
    others = np.delete(np.abs(moved), k).max()
    if abs(moved[k]) < LEANED or abs(moved[k]) < CLEAR * others:
        told = ', '.join(f'{axis} {x:+.2f} rad' for axis, x in zip(AXES, moved, strict=True))
        raise MountingError(
            f'no single axis leaned: {told}; one must lean by {LEANED} rad at least, and '
            f'{CLEAR:g} times as far as the others'
        )
    sign = math.copysign(1.0, moved[k])
    return Mounting(AXES[k], sign, sign * float(upright[k]))
