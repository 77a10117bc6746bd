"""ROS node of the balance controller: /state in, /torque_command out. The law is in balance.py.

Every state is answered by the command of its stamp, zero torque included, so that the same node
works in real time and in lock-step. The gains are made when the node starts, and anew when a scale
is set; a setting without a regulator is refused, the gains stay as they were. New gains act at the
next state, and their basin follows (live_design.py): no parameter delays an answer.

It also watches the loop: the age of the measurement when the drive latched the torque that answers
it, and how many deadlines of `deadline` were missed, on /diagnostics.

in    /state, /applied_torque
out   /torque_command, /diagnostics
"""

import dataclasses
import math
import time
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from sensor_msgs.msg import JointState

from cg_control.answer_age import AnswerAges
from cg_control.balancing.balance import BALANCING, WEIGHTS, BalanceSettings
from cg_control.balancing.live_design import LiveDesign
from cg_control.state_message import GAP_S, state_of
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_interfaces import topics
from cg_interfaces.ros import (
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
class BalanceNodeSettings(BalanceSettings):
    """Parameters of the balance node."""

    model_file: str = setting(
        '', 'model to design on, a file or a name; empty for the nominal compass gait'
    )
    elastic: bool = setting(
        False, 'design on the transmission too; the observer must have the same model'
    )
    sample_rate_hz: float = setting(
        500.0, 'rate of the states', unit='Hz', minimum=10.0, maximum=2000.0
    )
    deadline: float = setting(
        0.004,
        'age of a measurement at which the torque that answers it is late',
        unit='s',
        minimum=0.0001,
        maximum=1.0,
        live=True,
    )


class BalanceNode(Node):
    """Publishes /torque_command."""

    def __init__(self, **kwargs):
        super().__init__('balance', **kwargs)
        self.started = False
        self.declared = DeclaredSettings(self, BalanceNodeSettings, at_work=lambda: self.started)
        settings = self.declared.values
        path = model_path(settings.model_file or NOMINAL_MODEL)
        self.design = LiveDesign(
            path,
            Model.load(path),
            settings,
            1.0 / settings.sample_rate_hz,
            settings.elastic,
            self.get_logger().info,
        )
        self.controller = self.design.controller
        self.add_on_set_parameters_callback(self._judge)
        self.message = JointState(name=['hip'])
        self.message.header.frame_id = 'hip'
        self._last_ns: int | None = None
        self._reason = 'no state yet'
        self._ages = AnswerAges()
        self._next_diagnosis = 0.0
        self.publisher = self.create_publisher(JointState, topics.TORQUE_COMMAND, SENSOR_QOS)
        self.diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        self.create_subscription(JointState, topics.STATE, self.on_state, SENSOR_QOS)
        self.create_subscription(JointState, topics.APPLIED_TORQUE, self.on_applied, SENSOR_QOS)
        self.started = True

    def _judge(self, parameters: list) -> SetParametersResult:
        """Refuse settings for which there is no regulator."""
        changes = {p.name: p.value for p in parameters if p.name in WEIGHTS}
        try:
            self.design.judge(dataclasses.replace(self.declared.values, **changes))
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    # The loop

    def on_state(self, message: JointState) -> None:
        """Answer a state."""
        stamp_ns = to_nanoseconds(message.header.stamp)
        if stamp_ns == self._last_ns:
            self.publisher.publish(self.message)
            return
        if self._last_ns is not None and not 0 < stamp_ns - self._last_ns < GAP_S * 1e9:
            self.controller.stop()
        self._last_ns = stamp_ns
        if self.controller.settings is not self.declared.values:
            self.design.adopt(self.declared.values)
        torque, self._reason = 0.0, ''
        try:
            stance, x = state_of(message)
        except ValueError as error:
            self.controller.stop()
            self._reason = str(error)
        else:
            command = self.controller.step(stamp_ns, stance, x)
            torque, self._reason = command.torque, command.reason
        self._send(stamp_ns, torque)

    def _send(self, stamp_ns: int, torque: float) -> None:
        self.message.header.stamp = to_stamp(stamp_ns)
        self.message.effort = [torque if math.isfinite(torque) else 0.0]
        self.publisher.publish(self.message)
        self._ages.sent(stamp_ns, self.message.effort[0])

    def on_applied(self, message: JointState) -> None:
        """Note how old the measurement was when its torque was latched."""
        if len(message.effort) == 1:
            deadline = self.declared.values.deadline
            self._ages.latched(to_nanoseconds(message.header.stamp), message.effort[0], deadline)

    def poll(self) -> float:
        """Take over what was sampled, say once a second how it goes."""
        now = time.monotonic()
        self.design.collect()
        if now >= self._next_diagnosis:
            self._next_diagnosis = now + 1.0
            self._publish_diagnostics()
        return 0.2

    def _publish_diagnostics(self) -> None:
        status = DiagnosticStatus(name='balance', hardware_id='torque path')
        well = self.controller.mode == BALANCING and not self._ages.missed
        status.level = DiagnosticStatus.OK if well else DiagnosticStatus.WARN
        status.message = self.controller.mode + (f': {self._reason}' if self._reason else '')
        values = {'falls': self.controller.falls}
        values |= self._ages.figures(self.declared.values.deadline)
        publish_status(self.diagnostics, status, values)

    def close(self) -> None:
        """Leave with zero torque, and no process behind."""
        self.design.close()
        if self._last_ns is not None:
            self._send(self._last_ns, 0.0)


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_control balance_node`."""
    return run(BalanceNode, BalanceNodeSettings, args)


if __name__ == '__main__':
    raise SystemExit(main())
