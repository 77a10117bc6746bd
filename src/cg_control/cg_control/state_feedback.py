"""What the nodes of all state feedbacks have in common: /state in, /torque_command out.

Every state is answered by the command of its stamp, zero torque included, so that the same node
works in real time and in lock-step. A state that cannot be read, or that comes after a gap, ends
what the law was at; until then it goes on from where it was. The balance controller that all of
them have is designed when the node starts, and anew when a weight is set; a setting without a
regulator is refused, the gains stay as they were. New gains act at the next state, and their basin
follows (live_design.py): no parameter delays an answer.

It also watches the loop: the age of the measurement when the drive latched the torque that answers
it, and how many deadlines of `deadline` were missed, on /diagnostics.

in    /state, /applied_torque
out   /torque_command, /diagnostics
"""

import abc
import dataclasses
import math
import time
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from sensor_msgs.msg import JointState

from cg_control.answer_age import AnswerAges
from cg_control.balancing.balance import WEIGHTS, BalanceSettings
from cg_control.balancing.live_design import LiveDesign
from cg_control.state_message import GAP_S, state_of
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_interfaces import topics
from cg_interfaces.ros import (
    SENSOR_QOS,
    DeclaredSettings,
    publish_status,
    to_nanoseconds,
    to_stamp,
)
from cg_interfaces.settings import setting


@dataclass(frozen=True)
class FeedbackSettings(BalanceSettings):
    """Parameters of every state feedback, beside those of the balance controller."""

    model_file: str = setting(
        '', 'model of the robot, a file or a name; empty for the nominal compass gait'
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


class FeedbackNode(Node, abc.ABC):
    """Publishes /torque_command.

    A node of its own says which law it follows (`law`), what ends it (`interrupt`), and how to
    take over new settings (`adopt`); the other hooks do nothing here.

    Args:
        name: Of the node, and of its status on /diagnostics.
        kind: Its settings, FeedbackSettings among them.
        kwargs: Of rclpy's Node.

    Attributes:
        controller: The law: `step(stamp_ns, stance, x)` is a command, `settings` those it follows.
    """

    controller: Any
    well: tuple[str, ...]  # modes of the law in which nothing is wrong

    def __init__(self, name: str, kind: type[FeedbackSettings], **kwargs: Any):
        super().__init__(name, **kwargs)
        self.started = False
        self.declared = DeclaredSettings(self, kind, at_work=lambda: self.started)
        settings = self.declared.values
        path = model_path(settings.model_file or NOMINAL_MODEL)
        self.model = Model.load(path)
        self.sample_time = 1.0 / settings.sample_rate_hz
        self.design = LiveDesign(
            path, self.model, settings, self.sample_time, self.elastic(), self.get_logger().info
        )
        self.controller = self.law()
        self.message = JointState(name=['hip'])
        self.message.header.frame_id = 'hip'
        self._last_ns: int | None = None
        self._reason = 'no state yet'
        self._ages = AnswerAges()
        self._next_diagnosis = 0.0
        self.add_on_set_parameters_callback(self._judge)
        self.publisher = self.create_publisher(JointState, topics.TORQUE_COMMAND, SENSOR_QOS)
        self.diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        self.create_subscription(JointState, topics.STATE, self.on_state, SENSOR_QOS)
        self.create_subscription(JointState, topics.APPLIED_TORQUE, self.on_applied, SENSOR_QOS)

    # What a node of its own says

    def elastic(self) -> bool:
        """Whether to design on the transmission too."""
        return False

    @abc.abstractmethod
    def law(self) -> Any:
        """The controller, around that of `design`."""

    @abc.abstractmethod
    def interrupt(self) -> None:
        """End what the law was at: what comes next has nothing to do with what was."""

    def adopt(self, settings: Any) -> None:
        """Take over settings that have changed."""
        self.design.adopt(settings)

    def ready(self) -> bool:
        """Whether the first state is to be answered yet."""
        return True

    def before(self, stamp_ns: int) -> None:
        """What has to be done before a state is answered."""

    def answered(self, stamp_ns: int) -> None:
        """What has to be done when a state has been answered."""

    def problem_now(self) -> bool:
        """Whether something is wrong that the mode does not say."""
        return False

    def figures(self) -> dict[str, Any]:
        """What /diagnostics tells besides."""
        return {}

    # The loop

    def on_state(self, message: JointState) -> None:
        """Answer a state."""
        stamp_ns = to_nanoseconds(message.header.stamp)
        if stamp_ns == self._last_ns:
            self.publisher.publish(self.message)
            return
        if self._last_ns is None and not self.ready():
            return
        self.before(stamp_ns)
        if self._last_ns is not None and not 0 < stamp_ns - self._last_ns < GAP_S * 1e9:
            self.interrupt()
        self._last_ns = stamp_ns
        if self.controller.settings is not self.declared.values:
            self.adopt(self.declared.values)
        torque, self._reason = 0.0, ''
        try:
            stance, x = state_of(message)
        except ValueError as error:
            self.interrupt()
            self._reason = str(error)
        else:
            command = self.controller.step(stamp_ns, stance, x)
            torque, self._reason = command.torque, command.reason
        self._send(stamp_ns, torque)
        self.answered(stamp_ns)

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

    def _judge(self, parameters: list) -> SetParametersResult:
        """Refuse settings for which there is no regulator."""
        changes = {p.name: p.value for p in parameters if p.name in WEIGHTS}
        try:
            self.design.judge(dataclasses.replace(self.declared.values, **changes))
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def poll(self) -> float:
        """Take over what was sampled, say once a second how it goes."""
        now = time.monotonic()
        self.design.collect()
        if now >= self._next_diagnosis:
            self._next_diagnosis = now + 1.0
            self._publish_diagnostics()
        return 0.2

    def _publish_diagnostics(self) -> None:
        mode = self.controller.mode
        well = mode in self.well and not self._ages.missed and not self.problem_now()
        status = DiagnosticStatus(name=self.get_name(), hardware_id='torque path')
        status.level = DiagnosticStatus.OK if well else DiagnosticStatus.WARN
        status.message = mode + (f': {self._reason}' if self._reason else '')
        values = self.figures() | self._ages.figures(self.declared.values.deadline)
        publish_status(self.diagnostics, status, values)

    def close(self) -> None:
        """Leave with zero torque, and no process behind."""
        self.design.close()
        if self._last_ns is not None:
            self._send(self._last_ns, 0.0)
