"""ROS node of the safety gate: /torque_request in, /torque_command out. Logic in safety.py.

Put it between a controller and the hardware by remapping the controller's output:

    ros2 run cg_control balance_node --ros-args -r /torque_command:=/torque_request

Every request that passes is sent on at once with its own stamp, so that lock-step works through
the gate. It listens to the measurements as well, because their stamps are the clock by which a
request is dated ahead or old. When requests stop for longer than `stale_after`, zero torque is
sent until they come back. That zero carries the stamp of the last request, so that a machine that
was held up does not take it for one from the future, and a machine in lock-step not for an answer.
The hardware has a watchdog of its own behind the gate.

in    /torque_request, /imu, or /joint_states of a pendulum
out   /torque_command, /diagnostics
"""

import time
from dataclasses import dataclass

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState

from cg_hardware.safety import GateSettings, TorqueGate
from cg_hardware.sensor_publishers import torques_of
from cg_interfaces import channels, topics
from cg_interfaces.ros import (
    SENSOR_QOS,
    DeclaredSettings,
    Throttled,
    publish_status,
    run,
    to_nanoseconds,
)
from cg_interfaces.settings import setting


@dataclass(frozen=True)
class GateNodeSettings(GateSettings):
    """Parameters of the gate node."""

    mechanism: str = setting('compass_gait', 'mechanism whose joints are guarded')


class SafetyGateNode(Node):
    """Passes torque requests on, within limits."""

    def __init__(self, **kwargs):
        super().__init__('safety_gate', **kwargs)
        self.declared = DeclaredSettings(self, GateNodeSettings, at_work=lambda: self.started)
        self.started = True
        mechanism = self.declared.values.mechanism
        self.joints = channels.mechanism(mechanism).joints
        self.gate = TorqueGate(self.declared.values, self.joints)
        self.publisher = self.create_publisher(JointState, topics.TORQUE_COMMAND, SENSOR_QOS)
        self.diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        self.requests = self.create_subscription(
            JointState, topics.TORQUE_REQUEST, self.on_request, SENSOR_QOS
        )
        measurement = channels.mechanism(mechanism).measurement
        self.measurements = self.create_subscription(
            Imu if measurement == topics.IMU else JointState,
            measurement,
            self.on_measurement,
            SENSOR_QOS,
        )
        self.message = JointState(name=list(self.joints))
        self.message.header.frame_id = channels.mechanism(mechanism).torque.frame_id
        self._measured_ns: int | None = None
        self._stale = True
        self.doubts = 0  # since the node started
        self._told = 0
        self._warn = Throttled(self.get_logger().warning)
        self._next_diagnosis = 0.0

    def on_measurement(self, message: Imu | JointState) -> None:
        """Note how far the clock of the machine is."""
        self._measured_ns = to_nanoseconds(message.header.stamp)

    def _measured(self, stamp_ns: int) -> int:
        """Stamp of the last measurement.

        Before the first one there is only the wall clock to tell what is dated ahead. It does not
        tell what is old: in lock-step the clock of the machine starts at 1 s.
        """
        if self._measured_ns is not None:
            return self._measured_ns
        return min(stamp_ns, time.time_ns())

    def on_request(self, request: JointState) -> None:
        """Judge a request and pass on what may act."""
        self.gate.settings = self.declared.values
        self.gate.publishers = self.requests.get_publisher_count()
        now, stamp_ns = time.monotonic_ns(), to_nanoseconds(request.header.stamp)
        try:
            torques = torques_of(request, self.joints)
            judgement = self.gate.offer(torques, stamp_ns, now, self._measured(stamp_ns))
        except ValueError as error:
            self.gate.drop(str(error))
            judgement = self.gate.torque(now)
        if judgement.doubt:
            self._doubt(judgement.doubt)
        if judgement.refused:
            return
        self._stale = False
        self.message.header.stamp = request.header.stamp
        self._send(self.gate.torque(now).torque)

    def poll(self) -> float:
        """Send zero torque while requests are missing."""
        now = time.monotonic_ns()
        self.gate.publishers = self.requests.get_publisher_count()
        judgement = self.gate.torque(now)
        if judgement.doubt and not self._stale:
            self._stale = True
            self._doubt(judgement.doubt)
            self._send(judgement.torque)
        if now / 1e9 > self._next_diagnosis:
            self._next_diagnosis = now / 1e9 + 1.0
            self._publish_diagnostics()
        return 0.25 * self.declared.values.stale_after

    def _send(self, torque: tuple[float, ...]) -> None:
        self.message.effort = list(torque)
        self.publisher.publish(self.message)

    def _doubt(self, reason: str) -> None:
        self.doubts += 1
        self._warn(f'torque request: {reason}')

    def _publish_diagnostics(self) -> None:
        status = DiagnosticStatus(name='safety_gate', hardware_id='torque path')
        news = self.doubts - self._told
        status.level = DiagnosticStatus.WARN if news else DiagnosticStatus.OK
        status.message = 'no requests' if self._stale else 'passing'
        if self.gate.rivalry:
            status.level, status.message = DiagnosticStatus.ERROR, self.gate.rivalry
        values = {'requests_in_doubt': news, 'publishers': self.gate.publishers}
        publish_status(self.diagnostics, status, values)
        self._told = self.doubts

    def close(self) -> None:
        """Leave with zero torque, in the place of the last request, if there was one."""
        if self.message.effort:
            self._send((0.0,) * len(self.joints))


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_hardware safety_gate_node`."""
    return run(SafetyGateNode, GateNodeSettings, args)


if __name__ == '__main__':
    raise SystemExit(main())
