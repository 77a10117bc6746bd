"""ROS node of the safety gate: /torque_request in, /torque_command out. Logic in safety.py.

Put it between a controller and the hardware by remapping the controller's output:

    ros2 run cg_control balance_node --ros-args -r /torque_command:=/torque_request

Every request that passes is sent on at once with its own stamp, so that lock-step works through
the gate. It listens to the measurements as well, because their stamps are the clock by which a
request is dated ahead or old. When requests stop for longer than `stale_after`, zero torque is
sent until they come back. That zero carries the stamp of the last request, so that a machine that
was held up does not take it for one from the future, and a machine in lock-step not for an answer.
The hardware has a watchdog of its own behind the gate.

It also keeps the stage of the robot (lifecycle.py) on /robot_state, one line for people: torque
passes while the robot is armed or active. Where several controllers live side by side, `owners`
names them and `owner`, which may change at any time, is the one that is listened to. With
`arming`, as robot.launch.py has it, a person must call ~/arm, and after a fault ~/reset first.
~/stop, or true on /emergency_stop, is the emergency stop: torque zero until ~/reset.

in    /torque_request, /emergency_stop, /imu, or /joint_states of a pendulum; with `arming`
      /applied_torque; with `fall_angle` /state
out   /torque_command, /robot_state, /diagnostics
"""

import math
import time
from dataclasses import dataclass, replace
from functools import partial

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger

from cg_hardware.lifecycle import Lifecycle, Signs, Stage
from cg_hardware.safety import GateSettings, TorqueGate
from cg_hardware.sensor_publishers import torques_of
from cg_interfaces import channels, topics
from cg_interfaces.ros import (
    LATCHED_QOS,
    SENSOR_QOS,
    DeclaredSettings,
    Throttled,
    publish_status,
    run,
    to_nanoseconds,
)
from cg_interfaces.settings import setting

SILENCE = 0.1  # s after which a device counts as silent


@dataclass(frozen=True)
class GateNodeSettings(GateSettings):
    """Parameters of the gate node."""

    mechanism: str = setting('compass_gait', 'mechanism whose joints are guarded')
    arming: bool = setting(
        False, 'a person must call ~/arm before torque passes, and after faults'
    )
    owners: tuple[str, ...] = setting(
        (),
        'controllers that may ask, each on /torque_request/NAME; empty: one, on /torque_request',
    )
    owner: str = setting('', 'the one of `owners` that is listened to', live=True)
    fall_angle: float = setting(
        0.0, 'lean of the stance leg at which the robot has fallen; 0: it never has', unit='rad',
        minimum=0.0, live=True,
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.owner not in (self.owners or ('',)):
            raise ValueError(
                f'owner is {self.owner!r}; owners has {", ".join(self.owners) or "nobody"}'
            )


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
        # Who may ask -> what comes from there; '' where there is one controller only.
        self.requests = {
            owner: self.create_subscription(
                JointState, f'{topics.TORQUE_REQUEST}/{owner}'.rstrip('/'),
                partial(self.on_request, owner), SENSOR_QOS,
            ) for owner in self.declared.values.owners or ('',)
        }  # fmt: skip
        measurement = channels.mechanism(mechanism).measurement
        self.measurements = self.create_subscription(
            Imu if measurement == topics.IMU else JointState,
            measurement,
            self.on_measurement,
            SENSOR_QOS,
        )
        self.message = JointState(name=list(self.joints))
        self.message.header.frame_id = channels.mechanism(mechanism).torque.frame_id
        settings = self.declared.values
        self.lifecycle = Lifecycle(settings.arming, settings.fall_angle)
        self.stage = self.create_publisher(String, topics.ROBOT_STATE, LATCHED_QOS)
        self.create_subscription(Bool, topics.EMERGENCY_STOP, self.on_emergency_stop, 10)
        for name in ('arm', 'disarm', 'reset', 'stop'):
            self.create_service(Trigger, f'~/{name}', partial(self.on_person, name))
        self._heard = {'imu': -math.inf}  # device -> when, on the monotonic clock, s
        if settings.arming:
            self._heard['drive'] = -math.inf
            self.create_subscription(
                JointState, topics.APPLIED_TORQUE, self.on_applied, SENSOR_QOS
            )
        self._lean = math.nan
        if settings.fall_angle:
            self.create_subscription(JointState, topics.STATE, self.on_state, SENSOR_QOS)
        self._said = ''
        self._measured_ns: int | None = None
        self._stale = True
        self.doubts = 0  # since the node started
        self._told = 0
        self._warn = Throttled(self.get_logger().warning)
        self._next_diagnosis = 0.0

    def on_measurement(self, message: Imu | JointState) -> None:
        """Note how far the clock of the machine is."""
        self._measured_ns = to_nanoseconds(message.header.stamp)
        self._heard['imu'] = time.monotonic()

    def on_applied(self, message: JointState) -> None:
        """The drive is there."""
        self._heard['drive'] = time.monotonic()

    def on_state(self, message: JointState) -> None:
        """Note how far the stance leg leans."""
        leg = message.header.frame_id.removesuffix('_foot')
        if leg in message.name and len(message.position) == len(message.name):
            self._lean = message.position[message.name.index(leg)]

    def on_emergency_stop(self, message: Bool) -> None:
        """Somebody pressed it. Letting it go changes nothing: ~/reset does."""
        if message.data:
            self._stop()

    def on_person(
        self, what: str, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """A person arms, disarms, resets, or stops the robot."""
        problem = self._stop() if what == 'stop' else getattr(self.lifecycle, what)()
        response.success, response.message = not problem, problem or self.lifecycle.line
        self._enforce()
        return response

    def _stop(self) -> str:
        self.lifecycle.stop()
        self._enforce()
        return ''

    def _see(self, doubt: str = '') -> None:
        """Bring the stage up to date."""
        now = time.monotonic()
        silent = ()
        if self.declared.values.arming:
            silent = tuple(name for name, at in self._heard.items() if now - at > SILENCE)
        self.lifecycle.fall_angle = self.declared.values.fall_angle
        self.lifecycle.see(
            Signs(silent=silent, lean=self._lean, requests=not self._stale, doubt=doubt)
        )
        self._enforce()

    def _enforce(self) -> None:
        """No torque in a stage that lets none pass; say the stage when it changes."""
        if not self.lifecycle.passes:
            self.gate.drop(self.lifecycle.line)
            if not self._stale:
                self._stale = True
                if any(self.message.effort):  # a zero that was sent already needs no copy
                    self._send((0.0,) * len(self.joints))
        if self.lifecycle.line != self._said:
            self._said = self.lifecycle.line
            self.stage.publish(String(data=self._said))
            log = self.get_logger()
            fault = self.lifecycle.stage == Stage.FAULT
            # Of one call each, as rclpy wants it.
            log.error(self._said) if fault else log.info(self._said)

    def _measured(self, stamp_ns: int) -> int:
        """Stamp of the last measurement.

        Before the first one there is only the wall clock to tell what is dated ahead. It does not
        tell what is old: in lock-step the clock of the machine starts at 1 s.
        """
        if self._measured_ns is not None:
            return self._measured_ns
        return min(stamp_ns, time.time_ns())

    def _rivals(self) -> int:
        """Publishers on the topic of the one that may ask."""
        return self.requests[self.declared.values.owner].get_publisher_count()

    def on_request(self, owner: str, request: JointState) -> None:
        """Judge a request and pass on what may act.

        A hand-over is one change of the parameter `owner`: what the one before asked for acts
        until the other's first request, or until it is stale.
        """
        self.gate.settings = self.declared.values
        if owner != self.declared.values.owner:
            return
        self.gate.publishers = self._rivals()
        now, stamp_ns = time.monotonic_ns(), to_nanoseconds(request.header.stamp)
        if not self.lifecycle.passes:
            # An answer all the same: a machine in lock-step waits for it.
            self.message.header.stamp = request.header.stamp
            self._send((0.0,) * len(self.joints))
            return
        try:
            torques = torques_of(request, self.joints)
            judgement = self.gate.offer(torques, stamp_ns, now, self._measured(stamp_ns))
        except ValueError as error:
            self.gate.drop(str(error))
            judgement = replace(self.gate.torque(now), unfit=True)
        if judgement.doubt:
            self._doubt(judgement.doubt)
        if judgement.refused:
            return
        self.message.header.stamp = request.header.stamp
        self._stale = False
        self._send(self.gate.torque(now).torque)
        if judgement.unfit:
            self._see(judgement.doubt)

    def poll(self) -> float:
        """Send zero torque while requests are missing."""
        now = time.monotonic_ns()
        self.gate.publishers = self._rivals()
        judgement = self.gate.torque(now)
        if judgement.doubt and not self._stale:
            self._stale = True
            self._doubt(judgement.doubt)
            self._send(judgement.torque)
        self._see()
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
        status.message = self.lifecycle.line
        if self.lifecycle.stage == Stage.FAULT:
            status.level = DiagnosticStatus.ERROR
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
