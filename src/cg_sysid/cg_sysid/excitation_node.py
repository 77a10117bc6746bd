"""ROS node of the excitation: answers each measurement with the torque of its stamp.

The signal is in excitation.py. The first measurement heard is time zero of the signal; each
answer carries the stamp of the measurement that it answers, so that the same node drives the
machine in real time and in lock-step. After `duration` it goes on answering with zero torque,
unless told to exit.

in    /imu, or another `measurement_topic`
out   /torque_command
"""

import dataclasses
from dataclasses import dataclass

from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState

from cg_interfaces import topics
from cg_interfaces.ros import SENSOR_QOS, DeclaredSettings, run, to_stamp
from cg_interfaces.settings import setting
from cg_interfaces.stamps import stamp_of
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal

MEASUREMENT_TYPES = {
    topics.IMU: Imu, topics.HIP_ENCODER: JointState, topics.JOINT_STATES: JointState,
}  # fmt: skip
RETRY = 0.005  # s


@dataclass(frozen=True)
class ExcitationNodeSettings(ExcitationSettings):
    """Parameters of the excitation node."""

    measurement_topic: str = setting(
        topics.IMU, 'topic whose stamps are answered', choices=tuple(MEASUREMENT_TYPES)
    )
    joints: tuple[str, ...] = setting(('hip',), 'joints of the command, in model order')
    frame_id: str = setting('hip', 'frame of the command')
    listeners: int = setting(
        1, 'subscriptions that the command must have before the first answer', minimum=0
    )
    exit_when_done: bool = setting(False, 'end the process after `duration`')

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.joints:
            raise ValueError('joints is empty; name at least one')


class ExcitationNode(Node):
    """Publishes /torque_command."""

    def __init__(self, **kwargs):
        super().__init__('excitation', **kwargs)
        self.finished = False
        self.declared = DeclaredSettings(self, ExcitationNodeSettings)
        settings = self.declared.values
        # Joints of one machine are excited by independent signals.
        self.signals = [
            make_signal(dataclasses.replace(settings, seed=settings.seed + 1000 * index))
            for index in range(len(settings.joints))
        ]
        self.start_ns: int | None = None
        self.unanswered_ns: int | None = None
        self.matched = False
        self.message = JointState(name=list(settings.joints))
        self.message.header.frame_id = settings.frame_id
        self.publisher = self.create_publisher(JointState, topics.TORQUE_COMMAND, SENSOR_QOS)
        self.create_subscription(
            MEASUREMENT_TYPES[settings.measurement_topic],
            settings.measurement_topic,
            self.on_measurement,
            SENSOR_QOS,
            raw=True,
        )

    def on_measurement(self, serialised: bytes) -> None:
        """Answer a measurement."""
        stamp_ns = stamp_of(serialised)
        if not self.matched:
            # An answer sent before the listeners are matched would be lost.
            self.unanswered_ns = stamp_ns
            self.poll()
            return
        self._answer(stamp_ns)

    def poll(self) -> float:
        """Send the answer that had to wait for its listeners."""
        if self.matched or self.unanswered_ns is None:
            return 1.0
        if self.publisher.get_subscription_count() < self.declared.values.listeners:
            return RETRY
        self.matched = True
        self._answer(self.unanswered_ns)
        return 1.0

    def _answer(self, stamp_ns: int) -> None:
        if self.start_ns is None or stamp_ns < self.start_ns:
            self.start_ns = stamp_ns
        time = (stamp_ns - self.start_ns) / 1e9
        self._send(stamp_ns, [signal(time) for signal in self.signals])
        if time >= self.declared.values.duration and self.declared.values.exit_when_done:
            self.finished = True

    def _send(self, stamp_ns: int, torques: list[float]) -> None:
        self.last_ns = stamp_ns
        self.message.header.stamp = to_stamp(stamp_ns)
        self.message.effort = torques
        self.publisher.publish(self.message)

    def close(self) -> None:
        """Leave with zero torque."""
        if self.start_ns is not None and not self.finished:
            self._send(self.last_ns, [0.0] * len(self.signals))


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_sysid excitation_node`."""
    return run(ExcitationNode, ExcitationNodeSettings, args)


if __name__ == '__main__':
    raise SystemExit(main())
