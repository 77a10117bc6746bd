"""What a mechanism is: coordinates, energies, joints and what its sensors see."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

import casadi as ca

from cg_dynamics.parameter import Parameter
from cg_dynamics.rig import Setup

Symbols = Mapping[str, ca.SX]


@dataclass(frozen=True)
class Kinematics:
    """Coordinates of a mechanism in one set-up, reduced to those that are free to move.

    Attributes:
        names: Names of the free coordinates s.
        basis: q = basis s + offset, shape (n, m): which full coordinate follows which free one.
        offset: Where coordinates are that do not move, shape (n, 1), or 0 for all.
    """

    names: tuple[str, ...]
    basis: ca.DM
    offset: ca.DM = field(default_factory=lambda: ca.DM(0))


@dataclass(frozen=True)
class PointMass:
    """What an effect ties to a body.

    Attributes:
        body: Name of the body.
        mass: In kg.
        place: In the frame of the body, m, shape (3, 1).
    """

    body: str
    mass: ca.SX
    place: ca.SX


class Mechanism(ABC):
    """A rigid-body mechanism in the textbook sense, M(q) dv/dt + b(q, v) = B u.

    Attributes:
        name: Name in model files.
        coordinates: Names of the full coordinates q.
        joints: Actuated joint -> row B_j with joint angle = B_j q; a torque on the joint is the
            generalised force B_j' tau.
        passive: Joint without a drive -> its row; friction acts there as well. Only a mechanism
            that names its joints has any.
        couplings: Motor that turns with several joints -> joint -> ratio; each has a row among
            `joints` or `passive`.
        inputs: Input channels, one per actuated joint in the order of `joints`: torques,
            or forces along joints that slide.
        outputs: Output channels, in order.
        output_units: Unit of each output channel.
        sensor_kinds: Output channel -> 'encoder', 'inclinometer' or 'gyro'.
        bodies: Bodies that a payload or a spring can be tied to.
        parameters: Declared parameters.
        sliding: Coordinates that are lengths in m; the others are angles in rad.
        dimensions: Of the space in which it moves: 2 in the x-z plane, 3.
    """

    name: str
    coordinates: tuple[str, ...]
    joints: Mapping[str, tuple[float, ...]]
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    output_units: tuple[str, ...]
    sensor_kinds: Mapping[str, str]
    bodies: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    passive: Mapping[str, tuple[float, ...]] = MappingProxyType({})
    couplings: Mapping[str, Mapping[str, float]] = MappingProxyType({})
    sliding: tuple[str, ...] = ()
    dimensions: int = 2

    @property
    def identity(self) -> str:
        """Name under which what was compiled for a mechanism is found again."""
        return self.name

    def robot(self) -> dict[str, Any] | None:
        """What a model file has to say of it beyond its name (model_file.ROBOT)."""
        return None

    @property
    def all_joints(self) -> dict[str, tuple[float, ...]]:
        """Every joint -> its row, those with a drive first."""
        return {**self.joints, **self.passive}

    def slides(self, joint: str) -> bool:
        """Whether a joint moves along a line: its position is in m, what acts on it in N."""
        row = self.all_joints[joint]
        return any(
            share and q in self.sliding for q, share in zip(self.coordinates, row, strict=True)
        )

    def inertia_at(self, joint: str) -> float:
        """What a drive has to turn at a joint, kg m^2 (kg): where its effects set out follows it.

        About one for the mechanisms of this project, whose effects state their starts as such.
        """
        return 1.0

    @property
    def input_units(self) -> tuple[str, ...]:
        """Unit of each input: N m on a joint that turns, N on one that slides."""
        return tuple('N' if self.slides(joint) else 'N m' for joint in self.joints)

    def told(self, joint: str) -> tuple[str, ...]:
        """Channels of the position and the rate that a drive may be told; empty if none may."""
        return ()

    def output_unit(self, channel: str) -> str:
        """Unit of an output channel."""
        return self.output_units[self.outputs.index(channel)]

    @abstractmethod
    def energies(
        self,
        q: ca.SX,
        v: ca.SX,
        p: Symbols,
        setup: Setup,
        up: ca.SX,
        foot: ca.SX | None = None,
    ) -> tuple[ca.SX, ca.SX]:
        """Kinetic and potential energy in J.

        Args:
            q: Full coordinates, shape (n, 1).
            v: Their rates.
            p: Parameters by name.
            setup: The set-up.
            up: Unit vector against gravity; (x, z) = (0, 1) on level ground.
            foot: Where the foot that stands is moved, (x, z) in m; only a compass gait has one.
        """

    @abstractmethod
    def point(self, body: str, distance, q: ca.SX, p: Symbols, setup: Setup) -> ca.SX:
        """World position (x, z) in m of the point of `body` at `distance` m from its lower
        or proximal end (conventions.md).
        """  # noqa: D205

    @abstractmethod
    def sensors(self, q: ca.SX, v: ca.SX) -> dict[str, ca.SX]:
        """What ideal sensors would report: output channel -> expression."""

    def kinematics(self, setup: Setup) -> Kinematics:
        """Free coordinates in this set-up; all of them unless a mechanism knows fixtures."""
        return Kinematics(self.coordinates, ca.DM.eye(len(self.coordinates)))

    def up(self, setup: Setup) -> ca.SX:
        """Unit vector against gravity where nothing tilts the ground."""
        return ca.SX([0, 1])

    def recursion(
        self,
        q: ca.SX,
        v: ca.SX,
        a: ca.SX,
        p: Symbols,
        up: ca.SX,
        loads: Sequence[PointMass] = (),
    ) -> tuple[ca.SX, ca.SX] | None:
        """Mass matrix M(q), shape (n, n), and the forces M a + b that a takes, shape (n, 1).

        A mechanism of many joints has them by recursion, with the loads that its bodies carry; for
        None they are derived from the energies.
        """
        return None

    def consistency(self, p: Mapping[str, Any]) -> list[Any]:
        """Expressions that are positive if and only if real bodies have these parameters."""
        return []
