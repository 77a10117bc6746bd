"""ROS node that follows a tree: /state in, /torque_command out. The law is in recovery.py.

The tree is the file that /tree/selected names. A thread loads it, and the robot follows it from
the next state on; a tree of another model, or a file that has changed since, is refused, and the
one before stays. Until the first one is there, states are not answered; then each is,
by the command of its stamp, zero torque included, so that the same node works in real time and in
lock-step. On /diagnostics: mode, node, depth and branch, what look-ups, previews and answers
took, ages of the measurements and missed deadlines.

in    /state, /applied_torque, /tree/selected
out   /torque_command, /tree/node, /tree/reference, /diagnostics
"""

import collections
import dataclasses
import math
import time
from dataclasses import dataclass

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Twist
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Int32, String

from cg_control.answer_age import AnswerAges, percentiles
from cg_control.balancing.balance import BALANCING, WEIGHTS
from cg_control.balancing.live_design import LiveDesign
from cg_control.state_message import GAP_S, state_of
from cg_control.trees.recovery import FOLLOWING, KEPT, RecoverySettings, TreeController
from cg_control.trees.tree_files import TreeSelection
from cg_control.trees.tree_loader import TreeLoader
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
SHOWN = 0.05  # s between words about where the reference is, for people to look at


@dataclass(frozen=True)
class TreeControllerSettings(RecoverySettings):
    """Parameters of the tree controller."""

    model_file: str = setting(
        '', 'model of the robot, a file or a name; empty for the nominal compass gait'
    )
    grown_for: str = setting(
        '', 'model that the tree was grown for, a file or a name, where more is known by now than '
        'when it was grown; empty for that of model_file',
    )  # fmt: skip
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
    demand_timeout: float = setting(
        1.0, 'age of a /cmd_vel after which the robot stops; 0: never', unit='s', minimum=0.0,
        maximum=3600.0, live=True,
    )  # fmt: skip
    await_tree: bool = setting(
        True, 'answer no state until the first tree is there; otherwise with zero torque'
    )


class TreeControllerNode(Node):
    """Publishes /torque_command."""

    def __init__(self, **kwargs):
        super().__init__('tree_controller', **kwargs)
        self.started = False
        self.declared = DeclaredSettings(
            self, TreeControllerSettings, at_work=lambda: self.started
        )
        settings = self.declared.values
        path = model_path(settings.model_file or NOMINAL_MODEL)
        model = Model.load(path)
        sample_time = 1.0 / settings.sample_rate_hz
        self.design = LiveDesign(path, model, settings, sample_time, log=self.get_logger().info)
        self.controller = TreeController(self.design.controller, settings)
        before = settings.grown_for
        grown_for = Model.load(model_path(before)) if before else model
        self.loader = TreeLoader(model, grown_for, sample_time)
        self.problem = 'no tree selected yet'
        self._selection: TreeSelection | None = None
        self._last_ns: int | None = None
        self._demanded_ns: int | None = None
        self._reason = 'no state yet'
        self._next_diagnosis = 0.0
        self._shown = -1
        self._ages = AnswerAges()
        self._spent: collections.deque[float] = collections.deque(maxlen=KEPT)
        self._slow = 0
        self.message = JointState(name=['hip'])
        self.message.header.frame_id = 'hip'
        self.publisher = self.create_publisher(JointState, topics.TORQUE_COMMAND, SENSOR_QOS)
        self.node_publisher = self.create_publisher(Int32, '/tree/node', SENSOR_QOS)
        self.reference_publisher = self.create_publisher(Int32, '/tree/reference', SENSOR_QOS)
        self._referred_ns = 0
        self.diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        self.create_subscription(JointState, topics.STATE, self.on_state, SENSOR_QOS)
        self.create_subscription(JointState, topics.APPLIED_TORQUE, self.on_applied, SENSOR_QOS)
        self.create_subscription(String, '/tree/selected', self.on_selected, LATCHED_QOS)
        self.create_subscription(Twist, '/cmd_vel', self.on_speed, 10)
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

    # The tree

    def on_selected(self, message: String) -> None:
        """Have the selected tree loaded."""
        try:
            self._selection = TreeSelection.from_text(message.data)
        except ValueError as error:
            self._refuse(error)
        else:
            self.loader.ask(self._selection)

    def _collect(self) -> None:
        """Follow a tree that has been loaded since."""
        try:
            ready = self.loader.collect()
        except ValueError as error:
            self._refuse(error)
            return
        if ready is not None:
            self.controller.take(ready)
            self.problem = ''

    def _refuse(self, error: ValueError) -> None:
        self.problem = str(error)
        self.get_logger().error(f'tree refused: {error}')

    # The loop

    def on_state(self, message: JointState) -> None:
        """Answer a state."""
        stamp_ns = to_nanoseconds(message.header.stamp)
        if stamp_ns == self._last_ns:
            self.publisher.publish(self.message)
            return
        began = time.perf_counter()
        self._collect()
        if self._last_ns is None and self.declared.values.await_tree and not self.controller.tree:
            return
        if self._last_ns is not None and not 0 < stamp_ns - self._last_ns < GAP_S * 1e9:
            self.controller.interrupt()
        self._last_ns = stamp_ns
        self._let_demand_lapse(stamp_ns)
        if self.controller.settings is not self.declared.values:
            self.controller.demand = self._demanded_ns = None
            self.design.adopt(self.declared.values)
            self.controller.adopt(self.declared.values)
        try:
            stance, x = state_of(message)
        except ValueError as error:
            self.controller.interrupt()
            self._reason = str(error)
            self._send(stamp_ns, 0.0)
        else:
            command = self.controller.step(stamp_ns, stance, x)
            self._reason = command.reason
            self._send(stamp_ns, command.torque)
        if self.controller.entered != self._shown:
            self._shown = self.controller.entered
            self.node_publisher.publish(Int32(data=self._shown))
        if not 0 <= stamp_ns - self._referred_ns < 1e9 * SHOWN:
            self._referred_ns = stamp_ns
            self.reference_publisher.publish(Int32(data=self.controller.node))
        spent = time.perf_counter() - began
        self._spent.append(spent)
        self._slow += spent > 1.0 / self.declared.values.sample_rate_hz

    def on_speed(self, message: Twist) -> None:
        """A speed that is wanted, until it is too old or a parameter is set."""
        speed = message.linear.x
        if not math.isfinite(speed):
            self.get_logger().error(f'/cmd_vel refused: linear.x is {speed}')
            return
        # It does not walk backwards: there it stands.
        self.controller.demand, self._demanded_ns = max(speed, 0.0), self._last_ns

    def _let_demand_lapse(self, stamp_ns: int) -> None:
        """Stop where nobody says any more how fast to walk."""
        patience = self.declared.values.demand_timeout
        if self._demanded_ns is None or not patience:
            return
        if stamp_ns - self._demanded_ns > 1e9 * patience:
            self.controller.demand = 0.0

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
        """Take over what was sampled or loaded, say once a second how it goes."""
        now = time.monotonic()
        self.design.collect()
        self._collect()
        if now >= self._next_diagnosis:
            self._next_diagnosis = now + 1.0
            self._publish_diagnostics()
        return 0.2 if self.controller.tree else 0.02

    def _publish_diagnostics(self) -> None:
        controller = self.controller
        status = DiagnosticStatus(name='tree_controller', hardware_id='torque path')
        well = controller.mode in (BALANCING, FOLLOWING)
        well = well and not (self.problem or self._ages.missed or self._slow)
        status.level = DiagnosticStatus.OK if well else DiagnosticStatus.WARN
        status.message = controller.mode + (f': {self._reason}' if self._reason else '')
        values = {
            'tree': self._selection.path if self._selection else '',
            'nodes': len(controller.tree.nodes) if controller.tree else 0,
            'problem': self.problem,
            'node': controller.node,
            'branch': controller.branch,
            'depth': f'{controller.depth:.4g}',
            'to_go_s': f'{controller.to_go:.3f}',
            'switches': controller.switches,
            'speed_m_s': controller.speed,
            'steps_taken': controller.steps_taken,
            'slow_answers': self._slow,
        }
        # A copy first: percentiles of thousands take a while.
        for name, times in (
            ('lookup', controller.lookup_times),
            ('preview', controller.preview_times),
            ('answer', self._spent),
        ):
            if times:
                values |= percentiles(name, 'us', 1e6 * np.array(times), 1)
        values |= self._ages.figures(self.declared.values.deadline)
        self._slow = 0
        publish_status(self.diagnostics, status, values)

    def close(self) -> None:
        """Leave with zero torque, and no process behind."""
        self.design.close()
        if self._last_ns is not None:
            self._send(self._last_ns, 0.0)


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_control tree_controller_node`."""
    return run(TreeControllerNode, TreeControllerSettings, args)


if __name__ == '__main__':
    raise SystemExit(main())
