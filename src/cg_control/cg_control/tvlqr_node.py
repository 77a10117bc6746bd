"""ROS node of the TVLQR controller: /state in, /torque_command out. Control is in execution.py.

Until a trajectory is started it balances; then it follows the trajectory, and balances on the leg
on which that ends. What it follows is the text on /trajectory/selected; when, is said by
/trajectory: a motion starts, an empty one stops. Every state is answered by the command of its
stamp, zero torque included, so that the same node works in real time and in lock-step.

in    /state, /trajectory, /trajectory/selected
out   /torque_command, /diagnostics
"""

import dataclasses
import json
import math
import time
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory

from cg_control.balancing.balance import BALANCING, WEIGHTS
from cg_control.balancing.live_design import LiveDesign
from cg_control.following.execution import (
    CAUGHT,
    TRACKING,
    ExecutionSettings,
    TrajectoryController,
)
from cg_control.state_message import GAP_S, state_of
from cg_control.trajectories.trajectory import Trajectory, TrajectoryError
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_interfaces import topics
from cg_interfaces.ros import (
    LATCHED_QOS,
    SENSOR_QOS,
    DeclaredSettings,
    publish_status,
    run,
    to_nanoseconds,
    to_stamp,
)
from cg_interfaces.settings import setting

NOMINAL_MODEL = 'compass_gait_mit'


@dataclass(frozen=True)
class TvlqrNodeSettings(ExecutionSettings):
    """Parameters of the TVLQR node."""

    model_file: str = setting(
        '', 'model of the robot, a file or a name; empty for the nominal compass gait'
    )
    sample_rate_hz: float = setting(
        500.0, 'rate of the states', unit='Hz', minimum=10.0, maximum=2000.0
    )
    start_after: float = setting(
        0.0, 'start the selected trajectory unasked, once, after balancing for so long; 0: never',
        unit='s', minimum=0.0, live=True,
    )  # fmt: skip
    await_trajectory: bool = setting(
        False, 'answer no state before a trajectory is selected: a machine that waits for answers '
        'begins with it, however long planning takes',
    )  # fmt: skip


class TvlqrNode(Node):
    """Publishes /torque_command."""

    def __init__(self, **kwargs):
        super().__init__('tvlqr', **kwargs)
        self.started = False
        self.declared = DeclaredSettings(self, TvlqrNodeSettings, at_work=lambda: self.started)
        settings = self.declared.values
        path = model_path(settings.model_file or NOMINAL_MODEL)
        self.model = Model.load(path)
        self.design = LiveDesign(
            path,
            self.model,
            settings,
            1.0 / settings.sample_rate_hz,
            log=self.get_logger().info,
        )
        self.controller = TrajectoryController(self.design.controller, self.model, settings)
        self.trajectory: Trajectory | None = None
        self.problem = 'no trajectory selected yet'
        self._last_ns: int | None = None
        self._reason = 'no state yet'
        self._next_diagnosis = 0.0
        self._balancing_since: int | None = None
        self._started_unasked = False
        self.message = JointState(name=['hip'])
        self.message.header.frame_id = 'hip'
        self.publisher = self.create_publisher(JointState, topics.TORQUE_COMMAND, SENSOR_QOS)
        self.diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        self.create_subscription(JointState, topics.STATE, self.on_state, SENSOR_QOS)
        self.create_subscription(String, '/trajectory/selected', self.on_selected, LATCHED_QOS)
        self.create_subscription(JointTrajectory, '/trajectory', self.on_order, SENSOR_QOS)
        self.add_on_set_parameters_callback(self._judge)
        self.started = True

    def _judge(self, parameters: list) -> SetParametersResult:
        """Refuse settings for which there is no regulator."""
        changes = {p.name: p.value for p in parameters if p.name in WEIGHTS}
        try:
            self.design.judge(dataclasses.replace(self.declared.values, **changes))
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

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

    def _start_unasked(self, stamp_ns: int) -> None:
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

    def on_state(self, message: JointState) -> None:
        """Answer a state."""
        stamp_ns = to_nanoseconds(message.header.stamp)
        if stamp_ns == self._last_ns:
            self.publisher.publish(self.message)
            return
        waiting = self.declared.values.await_trajectory and self.trajectory is None
        if waiting and self._last_ns is None:
            return
        if self._last_ns is not None and not 0 < stamp_ns - self._last_ns < GAP_S * 1e9:
            self.controller.interrupt()
        self._last_ns = stamp_ns
        if self.controller.settings is not self.declared.values:
            self.design.adopt(self.declared.values)
            self.controller.adopt(self.declared.values)
        try:
            stance, x = state_of(message)
        except ValueError as error:
            self.controller.interrupt()
            self._reason = str(error)
            self._send(stamp_ns, 0.0)
            return
        command = self.controller.step(stamp_ns, stance, x)
        self._reason = command.reason
        self._send(stamp_ns, command.torque)
        self._start_unasked(stamp_ns)

    def _send(self, stamp_ns: int, torque: float) -> None:
        self.message.header.stamp = to_stamp(stamp_ns)
        self.message.effort = [torque if math.isfinite(torque) else 0.0]
        self.publisher.publish(self.message)

    def poll(self) -> float:
        """Take over what was sampled, say once a second how it goes."""
        now = time.monotonic()
        self.design.collect()
        if now >= self._next_diagnosis:
            self._next_diagnosis = now + 1.0
            status = DiagnosticStatus(name='tvlqr', hardware_id='torque path')
            mode = self.controller.mode
            well = mode in (BALANCING, TRACKING, CAUGHT)
            status.level = DiagnosticStatus.OK if well else DiagnosticStatus.WARN
            status.message = mode + (f': {self._reason}' if self._reason else '')
            values = {
                'trajectory': json.dumps(self.trajectory.modes if self.trajectory else []),
                'problem': self.problem,
            }
            publish_status(self.diagnostics, status, values)
        return 0.2

    def close(self) -> None:
        """Leave with zero torque, and no process behind."""
        self.design.close()
        if self._last_ns is not None:
            self._send(self._last_ns, 0.0)


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_control tvlqr_node`."""
    return run(TvlqrNode, TvlqrNodeSettings, args)


if __name__ == '__main__':
    raise SystemExit(main())
