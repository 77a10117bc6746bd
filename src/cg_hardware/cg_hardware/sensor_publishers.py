"""ROS side of the sensors: measurements of a plant become messages, torque messages numbers."""

import math
from typing import Any

from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Int64

from cg_interfaces import channels, topics
from cg_interfaces.ros import MACHINE_QOS, to_stamp


class SensorPublishers:
    """Publishes one measurement on all topics of its mechanism, reusing its messages."""

    def __init__(self, node: Node, mechanism: str, variances: dict[str, float]):
        """Create the publishers.

        Args:
            node: Publishes.
            mechanism: Name of the mechanism, a row of interfaces.md.
            variances: Channel -> variance of its noise, for the covariances of the IMU.
        """
        self.joints = channels.mechanism(mechanism).joints
        walks = mechanism == 'compass_gait'
        self._publish_parts = self._publish_compass_gait if walks else self._publish_joints
        self.applied = JointState(name=list(self.joints))
        self.applied.header.frame_id = channels.mechanism(mechanism).torque.frame_id
        self.publishers: dict[str, Any] = {}
        self._publisher(node, JointState, topics.APPLIED_TORQUE)
        if walks:
            self._prepare_compass_gait(node, variances)
        else:
            self._publisher(node, JointState, topics.JOINT_STATES)
            (self.read,) = channels.mechanism(mechanism).outputs
            self.joint_states = JointState(name=[c.joint for c in self.read.channels])
            self.joint_states.header.frame_id = self.read.frame_id

    def _publisher(self, node: Node, kind: type, topic: str) -> None:
        self.publishers[topic] = node.create_publisher(kind, topic, MACHINE_QOS)

    def _prepare_compass_gait(self, node: Node, variances: dict[str, float]) -> None:
        for kind, topic in (
            (JointState, topics.HIP_ENCODER),
            (Int64, topics.HIP_COUNTS),
            (WrenchStamped, topics.FOOT_CONTACT.format(leg='inner')),
            (WrenchStamped, topics.FOOT_CONTACT.format(leg='outer')),
            (Imu, topics.IMU),
        ):
            self._publisher(node, kind, topic)
        self.imu = Imu()
        self.imu.header.frame_id = 'imu_link'
        self.imu.orientation_covariance[4] = variances.get('imu_angle', 0.0)
        self.imu.angular_velocity_covariance[4] = variances.get('imu_rate', 0.0)
        self.imu.linear_acceleration_covariance[0] = -1.0
        self.encoder = JointState(name=['hip'])
        self.encoder.header.frame_id = 'hip'
        self.contacts = {}
        for leg in ('inner', 'outer'):
            self.contacts[leg] = WrenchStamped()
            self.contacts[leg].header.frame_id = f'{leg}_foot'

    def destroy(self, node: Node) -> None:
        """Take the topics off the graph."""
        for publisher in self.publishers.values():
            node.destroy_publisher(publisher)
        self.publishers.clear()

    def unheard(self, listeners: int, spared: tuple[str, ...] = (topics.HIP_COUNTS,)) -> list[str]:
        """Topics with fewer subscriptions than `listeners`, less those that nobody records."""
        return [
            topic
            for topic, publisher in self.publishers.items()
            if topic not in spared and publisher.get_subscription_count() < listeners
        ]

    def publish_measurement(self, stamp_ns: int, measurement: Any) -> None:
        """Publish what the sensors said at that time."""
        self._publish_parts(to_stamp(stamp_ns), measurement)

    def _send(self, topic: str, message: Any) -> None:
        # Asking is eight times cheaper than publishing to nobody.
        publisher = self.publishers[topic]
        if publisher.get_subscription_count() > 0:
            publisher.publish(message)

    def publish_applied(self, stamp_ns: int, torque: tuple[float, ...]) -> None:
        """Publish the set-points latched at that time, in N m."""
        self.applied.header.stamp = to_stamp(stamp_ns)
        self.applied.effort = list(torque)
        self._send(topics.APPLIED_TORQUE, self.applied)

    def _publish_compass_gait(self, stamp: Any, measurement: Any) -> None:
        self.encoder.header.stamp = stamp
        self.encoder.position = [measurement.outputs['hip_angle']]
        self._send(topics.HIP_ENCODER, self.encoder)
        if 'hip_angle' in measurement.counts:
            counts = Int64(data=int(measurement.counts['hip_angle']))
            self._send(topics.HIP_COUNTS, counts)
        for leg, message in self.contacts.items():
            message.header.stamp = stamp
            message.wrench.force.z = float(measurement.contact.get(leg, 0.0))
            self._send(topics.FOOT_CONTACT.format(leg=leg), message)
        # Last, because controllers and the excitation answer this one.
        half = 0.5 * measurement.outputs['imu_angle']
        self.imu.header.stamp = stamp
        self.imu.orientation.y = math.sin(half)
        self.imu.orientation.w = math.cos(half)
        self.imu.angular_velocity.y = float(measurement.outputs['imu_rate'])
        self._send(topics.IMU, self.imu)

    def _publish_joints(self, stamp: Any, measurement: Any) -> None:
        self.joint_states.header.stamp = stamp
        self.joint_states.position = [measurement.outputs[c.name] for c in self.read.channels]
        self._send(topics.JOINT_STATES, self.joint_states)


def torques_of(message: JointState, joints: tuple[str, ...]) -> list[float]:
    """Efforts of a command in the order of `joints`.

    Raises:
        ValueError: The message names no joints or others, or holds fewer efforts than names.
    """
    names = list(message.name)
    if sorted(names) != sorted(joints):
        raise ValueError(f'command names {names}; expected {list(joints)}')
    if len(message.effort) != len(names):
        raise ValueError(f'command holds {len(message.effort)} efforts for {len(names)} joints')
    return [float(message.effort[names.index(joint)]) for joint in joints]
