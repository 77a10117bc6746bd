"""What a checklist and an experiment need of a robot that is running: hear it, press its buttons.

The live one is the experimenter node of cg_bringup; tests have one in memory. Torque is asked of
the safety gate, as any controller asks it, and by no other way.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

from cg_hardware.checklist.measuring import Heard

Torque = Callable[[float], float]
# What the hands of an emulated robot do: after so many s, these words (emulators/robot.py).
Hands = Sequence[tuple[float, str]]


class Refused(Exception):
    """The robot did not do what was asked of it; the message says what it said."""


class Skipped(Exception):
    """A person wants to leave this out, or nobody answers."""


class Quit(Exception):
    """A person wants to end it here."""


@dataclass(frozen=True)
class Device:
    """What a device tells of itself on /diagnostics.

    Attributes:
        state: In words.
        well: Whether it finds no error.
        values: Figures and texts by name.
        hardware: What it is connected as, such as `node 1`.
    """

    state: str
    well: bool
    values: Mapping[str, str] = field(default_factory=dict)
    hardware: str = ''

    def number(self, name: str) -> float:
        """A figure; NaN where it is not told."""
        try:
            return float(self.values.get(name, 'nan'))
        except ValueError:
            return float('nan')

    @property
    def identity(self) -> str:
        """Model and serial number, as the device says them, or what it is connected as.

        Empty where that is a path of this host, which says nothing of the device.
        """
        said = ' '.join(filter(None, (self.values.get('model'), self.values.get('serial'))))
        return said or ('' if '/' in self.hardware else self.hardware)


class Robot(Protocol):
    """A robot that is running.

    Attributes:
        stage: Of the safety gate: unconfigured, idle, armed, active or fault, and why.
        emulated: Whether its devices are emulated.
    """

    stage: str
    emulated: bool

    def say(self, text: str) -> None:
        """Tell the person something."""

    def ask(self, text: str, hands: Hands = ()) -> None:
        """Have a person do something, or emulated hands.

        Raises:
            Skipped: Nobody will.
            Quit: The person has had enough.
        """

    def listen(
        self,
        seconds: float,
        torque: Torque | None = None,
        until: Callable[[Heard], bool] | None = None,
        more: bool = False,
    ) -> Heard:
        """What comes within so many seconds, by channel.

        Args:
            seconds: How long, at most.
            torque: Requested meanwhile and until the next listening, in N m, as a function of the
                time in s since the beginning.
            until: Ends it early; asked now and then.
            more: Whether it goes on with the last listening, and tells what came then as well.
        """

    def publishers_of(self, topic: str) -> list[str]:
        """Names of the nodes that publish a topic."""

    def device(self, name: str) -> Device | None:
        """What `imu`, `drive` or `safety_gate` last told; None if it is not heard."""

    def setting(self, node: str, name: str) -> Any:
        """A parameter of a node.

        Raises:
            Refused: There is no such node or parameter.
        """

    def change(self, node: str, name: str, value: Any) -> None:
        """Set a parameter of a node; `rest` sets it back.

        Raises:
            Refused: with the reason.
        """

    def press(self, button: str) -> str:
        """Call a service such as /safety_gate/arm; what it answered.

        Raises:
            Refused: It said no, and why.
        """

    def take_control(self) -> None:
        """Be the one that the gate listens to, arm, and enable the drive.

        Raises:
            Refused: with what the robot said.
        """

    def stop_by_topic(self) -> None:
        """Press the emergency stop by its topic."""

    def leave(self) -> None:
        """Vanish as a controller whose process has died: no publisher of a request is left."""

    def rest(self) -> None:
        """Zero torque, disarmed, disabled, no fault, every setting as it was."""

    def now_ns(self) -> int:
        """The host's clock."""
