"""Balance, follow a trajectory when told to, balance where it ends: the one-step rebalance, live.

Idle and balancing are the balance controller's (balance.py). A trajectory starts only if the leg
that stands is its first one and the state is near its start; it ends in the balance law of its
last leg, which goes on until the next start or stop. Torque is zero at once when a state is not
finite, late, or that of a fallen robot.
"""

from dataclasses import dataclass

import numpy as np

from cg_control.balancing.balance import (
    BALANCING,
    FALLEN,
    BalanceController,
    BalanceSettings,
    Command,
)
from cg_control.following.nodes import Nodes
from cg_control.following.tracking import Tracker, TrackingSettings, wrong_leg
from cg_control.trajectories.trajectory import Trajectory
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_interfaces.settings import setting

TRACKING, CAUGHT = 'tracking', 'caught'


@dataclass(frozen=True)
class ExecutionSettings(TrackingSettings, BalanceSettings):
    """Parameters of the controller that follows trajectories."""

    start_tolerance: float = setting(
        0.1, 'largest distance of an angle from the start of a trajectory, rates a tenth as much',
        unit='rad', minimum=0.0, maximum=1.0, live=True,
    )  # fmt: skip


class TrajectoryController:
    """A balance controller that can follow trajectories.

    Args:
        balance: Of both legs.
        model: The robot as it is known.
        settings: May be replaced between steps by `adopt`.
    """

    def __init__(self, balance: BalanceController, model: Model, settings: ExecutionSettings):
        self.balance, self.model, self.settings = balance, model, settings
        self._tracker: Tracker | None = None
        self._fallen = False
        self._state: tuple[str, np.ndarray] | None = None

    def adopt(self, settings: ExecutionSettings) -> None:
        """New settings from the next step on; those of the balance controller are its own."""
        self.settings = settings
        if self._tracker is not None:
            self._tracker.settings = settings

    @property
    def mode(self) -> str:
        """'tracking', 'caught' (balancing after the end), or that of the balance controller."""
        if self._tracker is not None:
            return CAUGHT if self._tracker.done else TRACKING
        return FALLEN if self._fallen else self.balance.mode

    def start(self, trajectory: Trajectory, at: float = 0.0) -> str:
        """Begin a trajectory at the next step; says why it cannot, or nothing.

        Args:
            trajectory: With gains; of this model.
            at: Time into it at which to begin, s.
        """
        if self._state is None:
            return 'no state yet'
        if self._fallen or self.mode not in (BALANCING, CAUGHT):
            return f'the robot is {self.mode}, not balancing'
        stance, x = self._state
        if not 0.0 <= at <= trajectory.duration:
            return f'at is {at} s; the trajectory takes {trajectory.duration:.3g} s'
        begin = trajectory.phases[0].start + at
        problem = wrong_leg(trajectory, stance, begin)
        if problem:
            return problem
        away = np.abs(x - trajectory.at(begin).state) * [1, 1, 0.1, 0.1]
        if away.max() > self.settings.start_tolerance:
            return (
                f'the robot is {away.max():.3g} rad from the start of the trajectory, allowed '
                f'are {self.settings.start_tolerance:g}'
            )
        last = trajectory.modes[-1]
        try:
            gain = self.balance.gains[last][:4]
            nodes = Nodes.of(trajectory, self.model, gain, self.settings.late)
            tracker = Tracker(nodes, self.model, self.settings)
            tracker.begin(*nodes.locate(begin))
        except ValueError as error:
            return str(error)
        self._tracker = tracker
        return ''

    def stop(self) -> None:
        """Leave the trajectory; the balance controller engages again if it can."""
        self._tracker = None
        self._fallen = False
        self.balance.stop()

    def interrupt(self) -> None:
        """States were missing: what was known of the motion is void."""
        self.stop()
        self._state = None

    def step(self, stamp_ns: int, stance: str, x: np.ndarray) -> Command:
        """The torque for a state; arguments as `BalanceController.step`."""
        x = np.asarray(x, float)
        self._state = (stance, x[:4].copy())
        if self._tracker is None:
            if self._fallen:
                return Command(0.0, FALLEN, 'fallen on a trajectory; stop it to balance again')
            return self.balance.step(stamp_ns, stance, x)
        reason = ''
        if not np.isfinite(x).all():
            reason = 'the state is not finite'
        elif abs(x[STANCES.index(stance)]) > self.settings.fall_angle:
            reason = 'fallen on a trajectory; stop it to balance again'
        elif not self.settings.armed:
            reason = 'not armed'
        if reason:
            self.stop()
            self._fallen = True
            return Command(0.0, FALLEN, reason)
        torque = self._tracker.torque(stamp_ns * 1e-9, stance, x)
        limit = self.balance.torque_limit
        reason = 'the foot landed where none should' if self._tracker.left(stance) else ''
        return Command(min(max(torque, -limit), limit), self.mode, reason)


__all__ = ['CAUGHT', 'TRACKING', 'ExecutionSettings', 'TrajectoryController']
