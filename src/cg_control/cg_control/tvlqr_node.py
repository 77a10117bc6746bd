"""ROS node of the TVLQR controller.

Control is in following/execution.py, what it shares with other nodes in state_feedback.py.

Until a trajectory is started it balances; then it follows the trajectory, and balances on the leg
on which that ends. What it follows is the text on /trajectory/selected; when, is said by
/trajectory: a motion starts, an empty one stops.

in    /state, /applied_torque, /trajectory, /trajectory/selected
out   /torque_command, /diagnostics
"""

import json
from dataclasses import dataclass
from typing import Any

from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from cg_control.balancing.balance import BALANCING
from cg_control.following.execution import (
    CAUGHT,
    TRACKING,
    ExecutionSettings,
    TrajectoryController,
)
from cg_control.state_feedback import FeedbackNode, FeedbackSettings
from cg_control.trajectories.trajectory import Trajectory, TrajectoryError
from cg_interfaces.ros import LATCHED_QOS, SENSOR_QOS, run
from cg_interfaces.settings import setting


@dataclass(frozen=True)
class TvlqrNodeSettings(ExecutionSettings, FeedbackSettings):
    """Parameters of the TVLQR node."""

    start_after: float = setting(
        0.0, 'start the selected trajectory unasked, once, after balancing for so long; 0: never',
        unit='s', minimum=0.0, live=True,
    )  # fmt: skip
    await_trajectory: bool = setting(
        False, 'answer no state before a trajectory is selected: a machine that waits for answers '
        'begins with it, however long planning takes',
    )  # fmt: skip


class TvlqrNode(FeedbackNode):
    """Publishes /torque_command."""

    well = BALANCING, TRACKING, CAUGHT
    controller: TrajectoryController

    def __init__(self, **kwargs: Any):
        super().__init__('tvlqr', TvlqrNodeSettings, **kwargs)
        self.trajectory: Trajectory | None = None
        self.problem = 'no trajectory selected yet'
        self._balancing_since: int | None = None
        self._started_unasked = False
        self.create_subscription(String, '/trajectory/selected', self.on_selected, LATCHED_QOS)
        self.create_subscription(JointTrajectory, '/trajectory', self.on_order, SENSOR_QOS)
        self.started = True

    def law(self) -> TrajectoryController:
        """Follow a trajectory, balance before and after."""
        return TrajectoryController(self.design.controller, self.model, self.declared.values)

    def interrupt(self) -> None:
        """It balances anew."""
        self.controller.interrupt()

    def adopt(self, settings: TvlqrNodeSettings) -> None:
        """Take over settings that have changed."""
        self.design.adopt(settings)
        self.controller.adopt(settings)

    def ready(self) -> bool:
        """Once a trajectory is there, where it is to wait for one."""
        return self.trajectory is not None or not self.declared.values.await_trajectory

    def answered(self, stamp_ns: int) -> None:
        """Start unasked, where that is wanted."""
        after = self.declared.values.start_after
        if after == 0.0 or self._started_unasked or self.trajectory is None:
            return
        if self.controller.mode != BALANCING:
            self._balancing_since = None
            return
        if self._balancing_since is None:
            self._balancing_since = stamp_ns
        if stamp_ns - self._balancing_since >= after * 1e9:
            self._started_unasked = True
            self._start()

    def figures(self) -> dict[str, Any]:
        """What is selected, and what is wrong with it."""
        modes = self.trajectory.modes if self.trajectory else []
        return {'trajectory': json.dumps(modes), 'problem': self.problem}

    def on_selected(self, message: String) -> None:
        """Take over the selected trajectory, if it is this robot's."""
        try:
            self.trajectory = Trajectory.from_text(message.data, self.model)
            self.problem = ''
        except TrajectoryError as error:
            self.trajectory, self.problem = None, str(error)
            self.get_logger().error(f'trajectory refused: {error}')

    def on_order(self, message: JointTrajectory) -> None:
        """Start or stop."""
        if not message.points:
            self.controller.stop()
            return
        self._start()

    def _start(self) -> None:
        problem = self.problem
        if self.trajectory is not None:
            problem = self.controller.start(self.trajectory)
        if problem:
            self.get_logger().error(f'trajectory not started: {problem}')


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_control tvlqr_node`."""
    return run(TvlqrNode, TvlqrNodeSettings, args)


if __name__ == '__main__':
    raise SystemExit(main())
