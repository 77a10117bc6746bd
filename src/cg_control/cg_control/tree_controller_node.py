"""ROS node that follows a tree.

The law is in trees/recovery.py, what it shares with other nodes in state_feedback.py.

The tree is the file that /tree/selected names. A thread loads it, and the robot follows it from
the next state on; a tree of another model, or a file that has changed since, is refused, and the
one before stays. Until the first one is there, states are not answered. On /diagnostics: mode,
node, depth and branch, what look-ups, previews and answers took.

in    /state, /applied_torque, /tree/selected, /cmd_vel
out   /torque_command, /tree/node, /tree/reference, /diagnostics
"""

import collections
import math
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import Twist
from std_msgs.msg import Int32, String

from cg_control.answer_age import percentiles
from cg_control.balancing.balance import BALANCING
from cg_control.state_feedback import FeedbackNode, FeedbackSettings
from cg_control.trees.recovery import FOLLOWING, KEPT, RecoverySettings, TreeController
from cg_control.trees.tree_files import TreeSelection
from cg_control.trees.tree_loader import TreeLoader
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_interfaces.ros import LATCHED_QOS, SENSOR_QOS, run
from cg_interfaces.settings import setting

SHOWN = 0.05  # s between words about where the reference is, for people to look at


@dataclass(frozen=True)
class TreeControllerSettings(RecoverySettings, FeedbackSettings):
    """Parameters of the tree controller."""

    grown_for: str = setting(
        '', 'model that the tree was grown for, a file or a name, where more is known by now than '
        'when it was grown; empty for that of model_file',
    )  # fmt: skip
    demand_timeout: float = setting(
        1.0, 'age of a /cmd_vel after which the robot stops; 0: never', unit='s', minimum=0.0,
        maximum=3600.0, live=True,
    )  # fmt: skip
    await_tree: bool = setting(
        True, 'answer no state until the first tree is there; otherwise with zero torque'
    )


class TreeControllerNode(FeedbackNode):
    """Publishes /torque_command."""

    well = BALANCING, FOLLOWING
    controller: TreeController

    def __init__(self, **kwargs: Any):
        super().__init__('tree_controller', TreeControllerSettings, **kwargs)
        before = self.declared.values.grown_for
        grown_for = Model.load(model_path(before)) if before else self.model
        self.loader = TreeLoader(self.model, grown_for, self.sample_time)
        self.problem = 'no tree selected yet'
        self._selection: TreeSelection | None = None
        self._demanded_ns: int | None = None
        self._shown = -1
        self._began = 0.0
        self._spent: collections.deque[float] = collections.deque(maxlen=KEPT)
        self._slow = 0
        self._referred_ns = 0
        self.node_publisher = self.create_publisher(Int32, '/tree/node', SENSOR_QOS)
        self.reference_publisher = self.create_publisher(Int32, '/tree/reference', SENSOR_QOS)
        self.create_subscription(String, '/tree/selected', self.on_selected, LATCHED_QOS)
        self.create_subscription(Twist, '/cmd_vel', self.on_speed, 10)
        self.started = True

    def law(self) -> TreeController:
        """Come home along a tree, balance there."""
        return TreeController(self.design.controller, self.declared.values)

    def interrupt(self) -> None:
        """It looks for a way home anew."""
        self.controller.interrupt()

    def adopt(self, settings: TreeControllerSettings) -> None:
        """Take over settings that have changed, with the speed among them."""
        self.controller.demand = self._demanded_ns = None
        self.design.adopt(settings)
        self.controller.adopt(settings)

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

    def ready(self) -> bool:
        """Once a tree is there, where it is to wait for one."""
        self._collect()
        return bool(self.controller.tree) or not self.declared.values.await_tree

    def before(self, stamp_ns: int) -> None:
        """Take over a tree; stop where nobody says any more how fast to walk."""
        self._began = time.perf_counter()
        self._collect()
        patience = self.declared.values.demand_timeout
        if self._demanded_ns is None or not patience:
            return
        if stamp_ns - self._demanded_ns > 1e9 * patience:
            self.controller.demand = 0.0

    def answered(self, stamp_ns: int) -> None:
        """Show where the reference is, and keep what the answer took."""
        if self.controller.entered != self._shown:
            self._shown = self.controller.entered
            self.node_publisher.publish(Int32(data=self._shown))
        if not 0 <= stamp_ns - self._referred_ns < 1e9 * SHOWN:
            self._referred_ns = stamp_ns
            self.reference_publisher.publish(Int32(data=self.controller.node))
        spent = time.perf_counter() - self._began
        self._spent.append(spent)
        self._slow += spent > self.sample_time

    def on_speed(self, message: Twist) -> None:
        """A speed that is wanted, until it is too old or a parameter is set."""
        speed = message.linear.x
        if not math.isfinite(speed):
            self.get_logger().error(f'/cmd_vel refused: linear.x is {speed}')
            return
        # It does not walk backwards: there it stands.
        self.controller.demand, self._demanded_ns = max(speed, 0.0), self._last_ns

    def poll(self) -> float:
        """Take over what was sampled or loaded, say once a second how it goes."""
        self._collect()
        pause = super().poll()
        return pause if self.controller.tree else 0.02

    def problem_now(self) -> bool:
        """No tree, or answers that took longer than a sample."""
        return bool(self.problem or self._slow)

    def figures(self) -> dict[str, Any]:
        """Where it is, and what finding that took."""
        controller = self.controller
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
        self._slow = 0
        # A copy first: percentiles of thousands take a while.
        for name, times in (
            ('lookup', controller.lookup_times),
            ('preview', controller.preview_times),
            ('answer', self._spent),
        ):
            if times:
                values |= percentiles(name, 'us', 1e6 * np.array(times), 1)
        return values


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_control tree_controller_node`."""
    return run(TreeControllerNode, TreeControllerSettings, args)


if __name__ == '__main__':
    raise SystemExit(main())
