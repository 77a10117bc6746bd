"""ROS side of the drive: what it says becomes messages."""

import time
from typing import Any

from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import BatteryState, JointState, Temperature
from std_msgs.msg import Int64, String

from cg_hardware.drive.can_drive import Answer
from cg_hardware.drive.cia402 import State
from cg_hardware.drive.settings import DriveSettings
from cg_interfaces import channels, topics
from cg_interfaces.ros import LATCHED_QOS, MACHINE_QOS, to_stamp

NAN = float('nan')


class DrivePublishers:
    """Publishes what a drive said, reusing the messages.

    Args:
        node: Publishes.
        settings: Which inputs are wired, and how the encoder counts.
    """

    def __init__(self, node: Node, settings: DriveSettings):
        body = channels.mechanism('compass_gait')
        self._counts_per_rad, self._switches = settings.counts_per_rad, settings.switches
        self._encoder = JointState(name=['hip'])
        self._encoder.header.frame_id = 'hip'
        self._applied = JointState(name=list(body.joints))
        self._applied.header.frame_id = body.torque.frame_id
        self._switch = JointState(name=['enabled'])
        self._switch.header.frame_id = body.torque.frame_id
        self._contact = WrenchStamped()
        self._battery = BatteryState(
            temperature=NAN, current=NAN, charge=NAN, capacity=NAN, design_capacity=NAN,
            percentage=NAN, present=True, location='DC link of the drive',
        )  # fmt: skip
        self._temperature = Temperature()
        self._temperature.header.frame_id = 'hip'
        self._out: dict[str, Any] = {
            topic: node.create_publisher(kind, topic, MACHINE_QOS)
            for topic, kind in (
                (topics.HIP_ENCODER, JointState), (topics.HIP_COUNTS, Int64),
                (topics.APPLIED_TORQUE, JointState), (topics.DRIVE_ENABLED, JointState),
                (topics.BATTERY_STATE, BatteryState), (topics.DRIVE_TEMPERATURE, Temperature),
                *((topics.FOOT_CONTACT.format(leg=leg), WrenchStamped) for leg in self._switches),
            )
        }  # fmt: skip
        self._zero_state = node.create_publisher(String, topics.ZERO_STATE, LATCHED_QOS)
        self._enabled: bool | None = None

    def answer(self, answer: Answer, zero_counts: int | None) -> None:
        """What the drive said at one SYNC.

        Args:
            answer: That.
            zero_counts: Where the hip's angle is zero; None while nobody can know.
        """
        stamp = to_stamp(answer.sync_ns)
        for message in (self._encoder, self._applied, self._contact):
            message.header.stamp = stamp
        if zero_counts is not None:
            counts = answer.counts - zero_counts
            self._encoder.position = [counts / self._counts_per_rad]
            self._send(topics.HIP_ENCODER, self._encoder)
            self._send(topics.HIP_COUNTS, Int64(data=counts))
        self._applied.effort = [answer.torque]
        self._send(topics.APPLIED_TORQUE, self._applied)
        for leg, bit in self._switches.items():
            self._contact.header.frame_id = f'{leg}_foot'
            self._contact.wrench.force.z = float(answer.inputs >> bit & 1)
            self._send(topics.FOOT_CONTACT.format(leg=leg), self._contact)
        self.enabled(answer.state == State.ENABLED, answer.sync_ns)

    def enabled(self, enabled: bool, stamp_ns: int | None = None) -> None:
        """Whether the drive holds the motor's terminals, when that changes."""
        if enabled != self._enabled:
            self._enabled = enabled
            self._switch.header.stamp = to_stamp(stamp_ns or time.time_ns())
            self._switch.position = [float(enabled)]
            self._out[topics.DRIVE_ENABLED].publish(self._switch)

    def voltage(self, volts: float) -> None:
        """Of the DC link."""
        self._battery.header.stamp = to_stamp(time.time_ns())
        self._battery.voltage = volts
        self._out[topics.BATTERY_STATE].publish(self._battery)

    def temperature(self, celsius: float) -> None:
        """Of the drive."""
        self._temperature.header.stamp = to_stamp(time.time_ns())
        self._temperature.temperature = celsius
        self._out[topics.DRIVE_TEMPERATURE].publish(self._temperature)

    def zero_state(self, line: str) -> None:
        """What is known of the zero, one line for people."""
        self._zero_state.publish(String(data=line))

    def _send(self, topic: str, message: Any) -> None:
        # Asking is eight times cheaper than publishing to nobody.
        if self._out[topic].get_subscription_count() > 0:
            self._out[topic].publish(message)
