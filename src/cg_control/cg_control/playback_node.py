"""ROS node that plays a nominal torque back, open loop (the thesis's Fig. 4-2 and 4-6).

Each measurement is answered by the torque of its stamp: the first one after a motion came on
/trajectory is its time zero. Before, after, and when an empty motion stops it, the torque is zero.
No state is looked at: keep the robot from falling.

in    /imu (its stamps), /trajectory
out   /torque_command
"""

from dataclasses import dataclass

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState
from trajectory_msgs.msg import JointTrajectory

from cg_dynamics.rig import STANCES
from cg_interfaces import topics
from cg_interfaces.ros import SENSOR_QOS, DeclaredSettings, run, to_nanoseconds, to_stamp
from cg_interfaces.settings import Settings, setting


@dataclass(frozen=True)
class PlaybackSettings(Settings):
    """Parameters of the playback node."""

    torque_limit: float = setting(
        40.0, 'largest torque that is played', unit='N m', minimum=0.0, live=True
    )
    share: float = setting(
        1.0, 'of the nominal torque that is played', minimum=0.0, maximum=1.0, live=True
    )


class Recital:
    """A nominal torque over time.

    Args:
        message: Its points have `effort` of the inner legs; times must not decrease.

    Raises:
        ValueError: naming what is wrong with the message.
    """

    def __init__(self, message: JointTrajectory):
        if 'inner' not in message.joint_names:
            raise ValueError(
                f'trajectory of {list(message.joint_names)}; expected {list(STANCES)}'
            )
        row = list(message.joint_names).index('inner')
        if any(len(point.effort) != len(message.joint_names) for point in message.points):
            raise ValueError('trajectory without an effort for each joint in every point')
        self.time = np.array([
            p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points
        ])  # fmt: skip
        self.torque = np.array([point.effort[row] for point in message.points])
        if not np.isfinite(self.torque).all() or (np.diff(self.time) < 0).any():
            raise ValueError('trajectory with efforts or times that make no sense')

    def at(self, t: float) -> float:
        """Torque in N m at t s from the start; zero outside."""
        return float(np.interp(t, self.time, self.torque, left=0.0, right=0.0))


class PlaybackNode(Node):
    """Publishes /torque_command."""

    def __init__(self, **kwargs):
        super().__init__('playback', **kwargs)
        self.declared = DeclaredSettings(self, PlaybackSettings)
        self.recital: Recital | None = None
        self.start_ns: int | None = None
        self.last_ns: int | None = None
        self.message = JointState(name=['hip'])
        self.message.header.frame_id = 'hip'
        self.publisher = self.create_publisher(JointState, topics.TORQUE_COMMAND, SENSOR_QOS)
        self.create_subscription(JointTrajectory, '/trajectory', self.on_order, SENSOR_QOS)
        self.create_subscription(Imu, topics.IMU, self.on_measurement, SENSOR_QOS)

    def on_order(self, message: JointTrajectory) -> None:
        """Start or stop."""
        self.recital = self.start_ns = None
        if not message.points:
            return
        try:
            self.recital = Recital(message)
        except ValueError as error:
            self.get_logger().error(f'not played: {error}')

    def on_measurement(self, message: Imu) -> None:
        """Answer a measurement."""
        self.last_ns = to_nanoseconds(message.header.stamp)
        if self.recital is None:
            self._send(0.0)
            return
        if self.start_ns is None:
            self.start_ns = self.last_ns
        settings = self.declared.values
        torque = settings.share * self.recital.at((self.last_ns - self.start_ns) * 1e-9)
        self._send(min(max(torque, -settings.torque_limit), settings.torque_limit))

    def _send(self, torque: float) -> None:
        self.message.header.stamp = to_stamp(self.last_ns)
        self.message.effort = [torque]
        self.publisher.publish(self.message)

    def close(self) -> None:
        """Leave with zero torque."""
        if self.last_ns is not None:
            self._send(0.0)


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_control playback_node`."""
    return run(PlaybackNode, PlaybackSettings, args)


if __name__ == '__main__':
    raise SystemExit(main())
