"""Whether a robot may be torqued, as one word that a person can read. Pure; no ROS.

    unconfigured --devices are heard--> idle --arm--> armed --requests pass--> active
    armed, active --disarm--> idle
    armed, active --something is wrong--> fault --reset--> idle

Torque passes while `armed` or `active`, and in no other stage. A fault is latched: what caused it
may be over, and still a person must look, reset, and arm. A robot without `arming`, as a simulated
one, is armed by itself, and its faults end with their cause, but for the emergency stop's.
"""

import math
from dataclasses import dataclass
from enum import Enum


class Stage(Enum):
    """Of the robot."""

    UNCONFIGURED = 'unconfigured'
    IDLE = 'idle'
    ARMED = 'armed'
    ACTIVE = 'active'
    FAULT = 'fault'


@dataclass(frozen=True)
class Signs:
    """What can be seen of a robot at one instant.

    Attributes:
        silent: Devices that are not heard, by name.
        lean: Of the stance leg in rad, NaN where nobody tells.
        stopped: Somebody holds the emergency stop.
        requests: Torque requests come, and pass as they are or limited.
        doubt: Why a request was refused just now; empty if none was.
    """

    silent: tuple[str, ...] = ()
    lean: float = math.nan
    stopped: bool = False
    requests: bool = False
    doubt: str = ''


class Lifecycle:
    """The stage of a robot, and why.

    Args:
        arming: Whether a person must arm it.
        fall_angle: Lean in rad beyond which the robot has fallen; 0: it never has.

    Attributes:
        stage: Now.
        reason: Why it is in that stage, for people; empty where that is plain.
    """

    def __init__(self, arming: bool, fall_angle: float = 0.0):
        self.arming, self.fall_angle = arming, fall_angle
        self.stage = Stage.UNCONFIGURED if arming else Stage.ARMED
        self.reason = 'nothing is heard yet' if arming else ''
        self._stopped = False
        self._last = Signs()

    @property
    def passes(self) -> bool:
        """Whether torque may pass."""
        return self.stage in (Stage.ARMED, Stage.ACTIVE)

    @property
    def line(self) -> str:
        """Stage and reason in one line."""
        return f'{self.stage.value}: {self.reason}' if self.reason else self.stage.value

    def see(self, signs: Signs) -> None:
        """Go to the stage that follows from what is seen."""
        self._last = signs
        if signs.stopped:
            self.stop()
            return
        wrong = self._wrong(signs)
        if self.stage == Stage.UNCONFIGURED or (self.stage == Stage.IDLE and signs.silent):
            missing = ', '.join(signs.silent)
            self._go(Stage.UNCONFIGURED if missing else Stage.IDLE,
                     f'{missing} not heard' if missing else '')  # fmt: skip
        elif self.stage == Stage.FAULT:
            if not self.arming and not wrong and not self._stopped:
                self._go(Stage.ARMED)
        elif self.passes and wrong:
            self._go(Stage.FAULT, wrong)
        elif self.passes:
            self._go(Stage.ACTIVE if signs.requests else Stage.ARMED)

    def _wrong(self, signs: Signs) -> str:
        """Why nothing may be torqued now; empty if it may."""
        if signs.silent:
            return f'{", ".join(signs.silent)} not heard'
        if self.fall_angle and abs(signs.lean) > self.fall_angle:
            return f'the robot has fallen: the stance leg leans by {signs.lean:.2f} rad'
        if self.arming and self.stage == Stage.ACTIVE:
            if signs.doubt:
                return signs.doubt
            if not signs.requests:
                return 'torque requests stopped'
        return ''

    def arm(self) -> str:
        """A person lets torque pass; why not, or empty."""
        if self.stage != Stage.IDLE:
            return f'only an idle robot can be armed; this one is {self.line}'
        if wrong := self._wrong(self._last):
            return f'not armed: {wrong}'
        self._go(Stage.ARMED, 'waits for torque requests')
        return ''

    def disarm(self) -> str:
        """A person wants no torque; why not, or empty."""
        if self.passes:
            self._go(Stage.IDLE, 'disarmed')
        return ''

    def reset(self) -> str:
        """A person has looked at a fault; why it stays, or empty."""
        if self.stage != Stage.FAULT:
            return f'there is no fault; the robot is {self.line}'
        self._stopped = False
        self._go(Stage.IDLE if self.arming else Stage.ARMED)
        return ''

    def stop(self) -> None:
        """The emergency stop, of whatever robot: latched until a person resets it."""
        self._stopped = True
        self._go(Stage.FAULT, 'emergency stop')

    def _go(self, stage: Stage, reason: str = '') -> None:
        if not stage == self.stage == Stage.ARMED:  # which keeps what it waits for
            self.stage, self.reason = stage, reason
