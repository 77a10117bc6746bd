"""What the drive node needs of a drive, and how a drive is chosen by its name.

A driver is a class that is made of the node's settings and has the methods of `Drive`. It is named
in the entry points of its package, and chosen by the node's parameter `driver`:

    entry_points={'cg_hardware.drives': ['mine = my_package.my_drive:MyDrive']}     # setup.py
    ros2 run cg_hardware drive_node --ros-args -p driver:=mine

skeleton.py is one to begin with.
"""

from collections import deque
from importlib.metadata import EntryPoint, entry_points
from typing import Any, Protocol

from cg_hardware.drive.can_drive import Answer, CanDrive
from cg_hardware.drive.cia402 import State
from cg_hardware.drive.objects import Objects
from cg_hardware.drive.procedure import Procedure

GROUP = 'cg_hardware.drives'
CIA402 = 'cia402'


class Drive(Protocol):
    """One drive, behind whatever wire.

    Attributes:
        answers: What it said in each cycle since they were last taken, oldest first.
        wanted: Whether it is led to the state in which torque acts.
        reason: Why no torque acts, in words; empty while nothing is wrong.
        outputs: Digital outputs that are wanted, as bits: feet that are drawn in.
        objects: Object dictionary of a CANopen drive; None elsewhere, where nothing is read of it.
        procedure: By which a CANopen drive seeks its index; None elsewhere.
    """

    answers: deque[Answer]
    wanted: bool
    reason: str
    outputs: int
    procedure: Procedure | None

    @property
    def objects(self) -> Objects | None:
        """Object dictionary; None of a drive that has none."""

    @property
    def state(self) -> State | None:
        """Of the drive, in the words of CiA 402; None while it is silent."""

    @property
    def enabled(self) -> bool:
        """Whether torque acts."""

    def enable(self) -> None:
        """A person wants torque: out of a fault as well."""

    def disable(self, reason: str) -> None:
        """No torque until `enable`."""

    def cycle(self, torque: float) -> None:
        """One cycle: send the torque in N m at the joint, ask for an answer.

        Raises:
            DriveError: The wire is gone.
        """

    def await_answer(self, timeout_s: float) -> None:
        """Wait until the answer is in `answers`, or so long."""

    def close(self) -> None:
        """Leave the drive without torque; once more does nothing."""


def found(name: str) -> EntryPoint | None:
    """Where the driver of that name is; None for our own.

    Raises:
        ValueError: There is none; the message lists those there are.
    """
    if name == CIA402:
        return None
    others = {entry.name: entry for entry in entry_points(group=GROUP)}
    if name not in others:
        known = ', '.join((CIA402, *sorted(others)))
        raise ValueError(f'driver is {name!r}; there are {known} (entry points {GROUP})')
    return others[name]


def make(settings: Any, outputs: int) -> Drive:
    """The drive that the settings of the node describe.

    Args:
        settings: Of the node.
        outputs: Digital outputs that will be set, as bits.

    Raises:
        DriveError: It is not there.
        ValueError: There is no such driver.
    """
    entry = found(settings.driver)
    if entry is not None:
        return entry.load()(settings)
    s = settings
    return CanDrive(s.bus, s.node_id, s.sign, s.gear, s.watch, outputs)
