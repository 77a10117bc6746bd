"""ROS node of the motor drive: CiA 402, cyclic synchronous torque, over CAN. Its words: drive/.

Torque acts only while a person has called ~/enable and nothing has gone wrong since. A fault of
the drive, an emergency object, a silent drive, a bus that is gone, a command that is no number,
names another joint, or is older than `stale_after` (safety.py) make it zero. After the first four
only ~/enable brings it back, after a bad command the next good one.

The bus is opened by python-can, so `interface` and `channel` are what that takes: socketcan and
can0, slcan and /dev/ttyACM1, or any adapter that it knows.

in    /torque_command
out   /hip_encoder, /hip_encoder/counts, /applied_torque, /drive_enabled, /foot_contact/inner,
      /foot_contact/outer, /diagnostics
"""

import math
import time
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Int64
from std_srvs.srv import Trigger

from cg_hardware.drive.can_drive import Answer, CanDrive, DriveError
from cg_hardware.drive.cia402 import State
from cg_hardware.safety import GateSettings, TorqueGate
from cg_hardware.sensor_publishers import torques_of
from cg_interfaces import channels, topics
from cg_interfaces.ros import (
    MACHINE_QOS,
    SENSOR_QOS,
    DeclaredSettings,
    Throttled,
    publish_status,
    run,
    to_nanoseconds,
    to_stamp,
)
from cg_interfaces.settings import setting

NANOSECONDS = 1_000_000_000
RETRY = 1.0  # s between attempts to find the drive
WITHIN = 0.0012  # s after a SYNC in which the drive answers, as a rule
PRIORITY = -10  # niceness, where it may be had
MOST_BEHIND = 5  # cycles that a late node leaves out rather than catches up


@dataclass(frozen=True)
class DriveSettings(GateSettings):
    """Parameters of the drive node: those of the gate, and the bus."""

    interface: str = setting('socketcan', "python-can's name of the adapter")
    channel: str = setting('can0', 'of the adapter')
    bitrate: int = setting(1_000_000, 'of the bus', unit='bit/s', minimum=10_000)
    node_id: int = setting(1, 'number of the drive on the bus', minimum=1, maximum=126)
    sign: float = setting(
        1.0, '1, or -1 where positive torque of the drive turns the joint backward',
        minimum=-1.0, maximum=1.0,
    )  # fmt: skip
    gear: float = setting(
        1.0, 'torque at the joint per torque of the motor', minimum=1e-3, maximum=1e4
    )
    counts_per_turn: float = setting(
        20_000.0, 'counts of the encoder per turn of the joint; negative where it counts backward'
    )

    inner_foot: int = setting(
        16, 'bit of the digital inputs (0x60FD) that is the switch of the inner feet, -1 for none',
        minimum=-1, maximum=31,
    )  # fmt: skip
    outer_foot: int = setting(
        17, 'bit of the digital inputs that is the switch of the outer feet, -1 for none',
        minimum=-1, maximum=31,
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if abs(self.sign) != 1.0:
            raise ValueError(f'sign is {self.sign:g}; it must be 1 or -1')
        if not 1 <= abs(self.counts_per_turn) < math.inf:
            raise ValueError(f'counts_per_turn is {self.counts_per_turn:g}; 1 or more are needed')

    @property
    def bus(self) -> dict:
        """What python-can opens."""
        return {'interface': self.interface, 'channel': self.channel, 'bitrate': self.bitrate}


class DriveNode(Node):
    """The drive of the hip, and its encoder."""

    eagerness = 3  # messages taken between two cycles even when the node is late

    def __init__(self, **kwargs):
        super().__init__('drive', **kwargs)
        self.drive: CanDrive | None = None
        self.declared = DeclaredSettings(self, DriveSettings)
        body = channels.mechanism('compass_gait')
        self.joints = body.joints
        self.gate = TorqueGate(self.settings, self.joints)
        self.encoder = JointState(name=['hip'])
        self.encoder.header.frame_id = 'hip'
        self.applied = JointState(name=list(self.joints))
        self.applied.header.frame_id = body.torque.frame_id
        self.switch = JointState(name=['enabled'])
        self.switch.header.frame_id = body.torque.frame_id
        bits = {'inner': self.settings.inner_foot, 'outer': self.settings.outer_foot}
        self.feet = {leg: bit for leg, bit in bits.items() if bit >= 0}
        self.contact = WrenchStamped()
        self.counts_per_turn = self.settings.counts_per_turn
        self.out = {
            topic: self.create_publisher(kind, topic, MACHINE_QOS)
            for topic, kind in (
                (topics.HIP_ENCODER, JointState), (topics.HIP_COUNTS, Int64),
                (topics.APPLIED_TORQUE, JointState), (topics.DRIVE_ENABLED, JointState),
                *((topics.FOOT_CONTACT.format(leg=leg), WrenchStamped) for leg in self.feet),
            )
        }  # fmt: skip
        self.diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        self.commands = self.create_subscription(
            JointState, topics.TORQUE_COMMAND, self.on_command, SENSOR_QOS
        )
        for name, answer in (
            ('enable', self.on_enable), ('disable', self.on_disable), ('zero', self.on_zero),
        ):  # fmt: skip
            self.create_service(Trigger, f'~/{name}', answer)
        self.zero_counts = 0
        self._counts: int | None = None
        self._enabled: bool | None = None
        self._retry_at = self._next_diagnosis = 0.0
        self._next_ns = 0
        self._cycles = self._answers = self._doubts = self._left_out = self._longest_ns = 0
        self._problem = 'not looked for yet'
        self._warn = Throttled(self.get_logger().warning)

    @property
    def settings(self) -> DriveSettings:
        """The present settings."""
        return self.declared.values

    # What is due between messages

    def poll(self) -> float:
        """Publish what the drive said, and carry out the cycle that is due."""
        now = time.monotonic()
        if now >= self._next_diagnosis:
            self._next_diagnosis = now + 1.0
            self._publish_diagnostics()
        if self.drive is None:
            if now >= self._retry_at:
                self._find()
            return 0.05
        late_ns = time.monotonic_ns() - self._next_ns
        if late_ns >= 0:
            self._cycle(late_ns)
        while self.drive is not None and self.drive.answers:
            self._publish(self.drive.answers.popleft())
        return max(0.0, (self._next_ns - time.monotonic_ns()) / NANOSECONDS)

    def _find(self) -> None:
        try:
            s = self.settings
            self.drive = CanDrive(s.bus, s.node_id, s.sign, s.gear)
        except DriveError as error:
            self._problem = str(error)
            self._warn(self._problem)
            self._retry_at = time.monotonic() + RETRY
            return
        self.drive.disable('nobody has called ~/enable')
        self._problem, self._enabled = '', None
        self._next_ns = time.monotonic_ns()

    def _lose(self, problem: str) -> None:
        assert self.drive is not None
        self.drive.close()
        self.drive = None
        self._problem = problem
        self._switched(False)
        self._warn(f'{problem}; torque is zero until ~/enable')
        self._retry_at = time.monotonic() + RETRY

    def _cycle(self, late_ns: int) -> None:
        """Command, SYNC."""
        assert self.drive is not None
        period = self.settings.sample_ns
        self._longest_ns = max(self._longest_ns, late_ns)
        self._next_ns += period
        if late_ns > MOST_BEHIND * period:
            self._left_out += late_ns // period
            self._next_ns = time.monotonic_ns() + period
        self.gate.settings = self.settings
        self.gate.publishers = self.commands.get_publisher_count()
        if not self.drive.enabled:
            self.gate.drop('the drive is not enabled')
        judgement = self.gate.torque(time.time_ns())
        before = self.drive.reason
        try:
            self.drive.cycle(judgement.torque[0])
        except DriveError as error:
            self._lose(str(error))
            return
        self.drive.await_answer(WITHIN)
        if self.drive.reason and self.drive.reason != before:
            self.get_logger().error(f'{self.drive.reason}; torque is zero until ~/enable')
        self._cycles += 1

    # What goes out

    def _publish(self, answer: Answer) -> None:
        """What the drive said at one SYNC."""
        stamp = to_stamp(answer.sync_ns)
        self._answers += 1
        self._counts = answer.counts
        counts = answer.counts - self.zero_counts
        self.encoder.header.stamp = self.applied.header.stamp = self.contact.header.stamp = stamp
        self.encoder.position = [2 * math.pi * counts / self.counts_per_turn]
        self._send(topics.HIP_ENCODER, self.encoder)
        self._send(topics.HIP_COUNTS, Int64(data=counts))
        self.applied.effort = [answer.torque]
        self._send(topics.APPLIED_TORQUE, self.applied)
        for leg, bit in self.feet.items():
            self.contact.header.frame_id = f'{leg}_foot'
            self.contact.wrench.force.z = float(answer.inputs >> bit & 1)
            self._send(topics.FOOT_CONTACT.format(leg=leg), self.contact)
        self._switched(answer.state == State.ENABLED, answer.sync_ns)

    def _send(self, topic: str, message: Any) -> None:
        # Asking is eight times cheaper than publishing to nobody.
        if self.out[topic].get_subscription_count() > 0:
            self.out[topic].publish(message)

    def _switched(self, enabled: bool, stamp_ns: int | None = None) -> None:
        if enabled != self._enabled:
            self._enabled = enabled
            self.switch.header.stamp = to_stamp(stamp_ns or time.time_ns())
            self.switch.position = [float(enabled)]
            self.out[topics.DRIVE_ENABLED].publish(self.switch)

    # What comes in

    def on_command(self, message: JointState) -> None:
        """Take in a torque command."""
        self.gate.publishers = self.commands.get_publisher_count()
        now = time.time_ns()
        try:
            torques = torques_of(message, self.joints)
            judgement = self.gate.offer(torques, to_nanoseconds(message.header.stamp), now)
            doubt = judgement.doubt
        except ValueError as error:
            doubt = str(error)
            self.gate.drop(doubt)
        if doubt:
            self._doubts += 1
            self._warn(f'torque command: {doubt}')

    def on_enable(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """A person wants torque: out of a fault as well.

        A drive that was switched off has lost its set-up: it is looked for anew.
        """
        if self.drive is not None and self.drive.state is None:
            self._lose('the drive is silent and is looked for anew')
        response.success = self.drive is not None
        response.message = self._problem or 'the drive is led to operation enabled'
        if self.drive is not None:
            self.gate.drop('just enabled')
            self.drive.enable()
        return response

    def on_disable(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """A person wants no torque."""
        if self.drive is not None:
            self.drive.disable('~/disable was called')
        response.success, response.message = True, 'torque is zero until ~/enable'
        return response

    def on_zero(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """The legs are parallel now: the hip's angle is zero here."""
        if self.drive is None or self._counts is None or self.drive.wanted:
            response.success = False
            response.message = self._problem or 'not while the drive is enabled: call ~/disable'
            return response
        self.zero_counts = self._counts
        response.success, response.message = True, f'zero at {self.zero_counts} counts'
        self.get_logger().info(response.message)
        return response

    def _publish_diagnostics(self) -> None:
        status = DiagnosticStatus(name='drive', hardware_id=f'node {self.settings.node_id}')
        state = self.drive.state if self.drive else None
        enabled = self.drive is not None and self.drive.enabled
        status.level = DiagnosticStatus.OK if enabled else DiagnosticStatus.WARN
        status.message = state.value if state else 'silent'
        if self.drive is not None and self.drive.reason:
            status.message += f': {self.drive.reason}'
        if self._problem or state in (State.FAULT, State.REACTING):
            status.level = DiagnosticStatus.ERROR
            status.message = self._problem or status.message
        if self.gate.rivalry:
            status.level, status.message = DiagnosticStatus.ERROR, self.gate.rivalry
        publish_status(self.diagnostics, status, {
            'cycles': self._cycles, 'answers': self._answers, 'commands_in_doubt': self._doubts,
            'cycles_left_out': self._left_out,
            'latest_cycle_ms': f'{self._longest_ns / 1e6:.2f}',
        })  # fmt: skip
        self._cycles = self._answers = self._doubts = self._left_out = self._longest_ns = 0

    def close(self) -> None:
        """Leave the drive without torque."""
        if self.drive is not None:
            self.drive.disable('the node ends')
            self.drive.close()


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_hardware drive_node`."""
    return run(DriveNode, DriveSettings, args, niceness=PRIORITY)


if __name__ == '__main__':
    raise SystemExit(main())
