"""ROS node of the safety gate: /torque_request in, /torque_command out. Logic in safety.py.

Put it between a controller and the hardware by remapping the controller's output:

    ros2 run cg_control balance_node --ros-args -r /torque_command:=/torque_request

Every request that passes is sent on at once with its own stamp, so that lock-step works through
the gate. When requests stop for longer than `stale_after`, zero torque is sent until they come
back; the hardware has a watchdog of its own behind it.
"""

import time
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.node import Node
from sensor_msgs.msg import JointState

from cg_dynamics.ros import SENSOR_QOS, DeclaredSettings, run, to_stamp
from cg_dynamics.settings import setting
from cg_hardware import topics
from cg_hardware.safety import GateSettings, TorqueGate
from cg_hardware.sensor_publishers import torques_of


@dataclass(frozen=True)
class GateNodeSettings(GateSettings):
    """Parameters of the gate node."""

    mechanism: str = setting(
        'compass_gait', 'mechanism whose joints are guarded', choices=tuple(topics.JOINTS)
    )


class SafetyGateNode(Node):
    """Passes torque requests on, within limits."""

    def __init__(self, **kwargs):
        super().__init__('safety_gate', **kwargs)
        self.declared = DeclaredSettings(self, GateNodeSettings, at_work=lambda: self.started)
        self.started = True
        self.joints = topics.joints_of(self.declared.values.mechanism)
        self.gate = TorqueGate(self.declared.values, self.joints)
        self.publisher = self.create_publisher(JointState, topics.TORQUE_COMMAND, SENSOR_QOS)
        self.diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        self.create_subscription(JointState, topics.TORQUE_REQUEST, self.on_request, SENSOR_QOS)
        self.message = JointState(name=list(self.joints))
        self.message.header.frame_id = topics.TORQUE_FRAME[self.declared.values.mechanism]
        self._stale = True
        self._doubts = 0
        self._next_diagnosis = 0.0

    def on_request(self, request: JointState) -> None:
        """Judge a request and pass on what may act."""
        self.gate.settings = self.declared.values
        now = time.monotonic_ns()
        try:
            judgement = self.gate.offer(torques_of(request, self.joints), now)
        except ValueError as error:
            self.gate.drop(str(error))
            judgement = self.gate.torque(now)
        if judgement.doubt:
            self._doubt(judgement.doubt)
        self._stale = False
        self.message.header.stamp = request.header.stamp
        self._send(self.gate.torque(now).torque)

    def poll(self) -> float:
        """Send zero torque while requests are missing."""
        now = time.monotonic_ns()
        judgement = self.gate.torque(now)
        if judgement.doubt and not self._stale:
            self._stale = True
            self._doubt(judgement.doubt)
            self.message.header.stamp = to_stamp(time.time_ns())
            self._send(judgement.torque)
        if now / 1e9 > self._next_diagnosis:
            self._next_diagnosis = now / 1e9 + 1.0
            self._publish_diagnostics()
        return 0.25 * self.declared.values.stale_after

    def _send(self, torque: tuple[float, ...]) -> None:
        self.message.effort = list(torque)
        self.publisher.publish(self.message)

    def _doubt(self, reason: str) -> None:
        self._doubts += 1
        self.get_logger().warning(f'torque request: {reason}', throttle_duration_sec=1.0)

    def _publish_diagnostics(self) -> None:
        status = DiagnosticStatus(name='safety_gate', hardware_id='torque path')
        status.level = DiagnosticStatus.WARN if self._doubts else DiagnosticStatus.OK
        status.message = 'no requests' if self._stale else 'passing'
        status.values = [KeyValue(key='requests_in_doubt', value=str(self._doubts))]
        array = DiagnosticArray(status=[status])
        array.header.stamp = to_stamp(time.time_ns())
        self.diagnostics.publish(array)
        self._doubts = 0

    def close(self) -> None:
        """Leave with zero torque."""
        self.message.header.stamp = to_stamp(time.time_ns())
        self._send((0.0,) * len(self.joints))


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_hardware safety_gate_node`."""
    return run(SafetyGateNode, args)


if __name__ == '__main__':
    raise SystemExit(main())
