"""ROS node of the motor drive: CiA 402, cyclic synchronous torque, over CAN. Its words: drive/.

Another drive is chosen by `driver`; drive/skeleton.py is a file to begin with.

Torque acts only while a person has called ~/enable and nothing has gone wrong since. A fault of
the drive, an emergency object, a silent drive, a bus that is gone, a drive that is too hot or
whose voltage is out of its limits, a command that is no number, names another joint, or is older
than `stale_after` (safety.py) make it zero. After the first five only ~/enable brings it back,
after a bad command the next good one.

~/enable also wants to know where the hip's angle is zero. An incremental encoder begins anew when
its drive wakes up, so that a person must say: ~/zero (the legs are parallel now), ~/home (the
drive goes to the encoder's index by itself: the motor has voltage) or ~/index_by_hand (a person
turns the hip through the index, without torque). The last two need a robot that is neither armed
nor in a fault, end on ~/disable and on the emergency stop, and answer at once: /drive/zero_state
says how they end.

The bus is opened by python-can, so `interface` and `channel` are what that takes: socketcan and
can0, slcan and /dev/ttyACM1, or any adapter that it knows.

in    /torque_command, /robot_state, /emergency_stop, /foot_retraction/inner,
      /foot_retraction/outer
out   /hip_encoder, /hip_encoder/counts, /applied_torque, /drive_enabled, /foot_contact/inner,
      /foot_contact/outer, /battery_state, /drive/temperature, /drive/zero_state, /diagnostics
"""

import contextlib
import time
from functools import partial

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, String
from std_srvs.srv import Trigger

from cg_hardware.drive import cia402, drivers, zero
from cg_hardware.drive.can_drive import CanDrive
from cg_hardware.drive.cia402 import State
from cg_hardware.drive.feet import FootRetraction
from cg_hardware.drive.homing import Homing
from cg_hardware.drive.index_by_hand import IndexByHand
from cg_hardware.drive.objects import DriveError
from cg_hardware.drive.procedure import Procedure
from cg_hardware.drive.readings import Level, Reading
from cg_hardware.drive.settings import VOLTAGE, DriveSettings
from cg_hardware.drive.zero import EncoderZero
from cg_hardware.drive_publishers import DrivePublishers
from cg_hardware.lifecycle import Stage
from cg_hardware.safety import TorqueGate
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
from cg_interfaces.stamps import NS_PER_S

RETRY = 1.0  # s between attempts to find the drive
WORDLESS = 1.0  # s that a drive may say nothing before it is looked for anew
WITHIN = 0.0012  # s after a SYNC in which the drive answers, as a rule
PRIORITY = -10  # niceness, where it may be had
FAREWELL = 0.5  # s that a procedure is given to leave the drive as it was, when the node ends
MOST_BEHIND = 5  # cycles that a late node leaves out rather than catches up
UNKNOWN = 'unknown: call /drive/zero (legs parallel), /drive/home or /drive/index_by_hand'
# Stages of a robot whose zero may be sought; one that no gate watches has none.
AT_EASE = ('', Stage.UNCONFIGURED.value, Stage.IDLE.value)
LEVELS = {
    Level.OK: DiagnosticStatus.OK,
    Level.WARN: DiagnosticStatus.WARN,
    Level.ERROR: DiagnosticStatus.ERROR,
}


class DriveNode(Node):
    """The drive of the hip, its encoder, and what else is wired to it."""

    eagerness = 3  # messages taken between two cycles even when the node is late

    def __init__(self, **kwargs):
        super().__init__('drive', **kwargs)
        self.drive: drivers.Drive | None = None
        self.declared = DeclaredSettings(self, DriveSettings)
        settings = self.settings
        self.joints = channels.mechanism('compass_gait').joints
        self.gate = TorqueGate(settings, self.joints)
        self.feet = FootRetraction(settings.retractions, settings.retraction_stale_after)
        self.out = DrivePublishers(self, settings)
        self.diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        self.commands = self.create_subscription(
            JointState, topics.TORQUE_COMMAND, self.on_command, SENSOR_QOS
        )
        self.create_subscription(String, topics.ROBOT_STATE, self.on_robot_state, LATCHED_QOS)
        self.create_subscription(Bool, topics.EMERGENCY_STOP, self.on_emergency_stop, 10)
        self.retractions = {
            leg: self.create_subscription(
                Bool, topics.FOOT_RETRACTION.format(leg=leg), partial(self.on_retraction, leg), 10
            )
            for leg in self.feet.bits
        }
        for name, answer in (
            ('enable', self.on_enable), ('disable', self.on_disable), ('zero', self.on_zero),
            ('home', self.on_home), ('index_by_hand', self.on_index_by_hand),
        ):  # fmt: skip
            self.create_service(Trigger, f'~/{name}', answer)
        # Where the hip's angle is zero, as it was last said, and whether that still holds.
        self.zero: EncoderZero | None = None
        if settings.absolute_encoder and settings.zero_file:
            self.zero = zero.read_zero(settings.zero_file)
        self.zero_holds = self.zero is not None
        self.voltage: Reading | None = None
        self.temperature: Reading | None = None
        self._stage, self._stopped = '', False
        self._counts: int | None = None
        self._max_torque: int | None = None  # that the drive must be given back
        self._retry_at = self._heard_at = self._next_diagnosis = 0.0
        self._next_ns = 0
        self._cycles = self._answers = self._doubts = self._left_out = self._longest_ns = 0
        self._problem = 'not looked for yet'
        self._warn = Throttled(self.get_logger().warning)
        self._warn_feet = Throttled(self.get_logger().warning)
        self._tell_zero()

    @property
    def settings(self) -> DriveSettings:
        """The present settings."""
        return self.declared.values

    @property
    def procedure(self) -> Procedure | None:
        """By which the zero is sought now."""
        return self.drive.procedure if self.drive is not None else None

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
            answer = self.drive.answers.popleft()
            self._answers += 1
            self._counts, self._heard_at = answer.counts, now
            self.out.answer(answer, self._zero_counts())
        return max(0.0, (self._next_ns - time.monotonic_ns()) / NS_PER_S)

    def _zero_counts(self) -> int | None:
        """Where the hip's angle is zero; None while the drive's counts may begin anew."""
        if self.procedure is not None and self.procedure.moves_zero:
            return None
        return self.zero.zero_counts if self.zero is not None else 0

    def _find(self) -> None:
        s = self.settings
        try:
            self.drive = drivers.make(s, self.feet.mask)
            if self._max_torque is not None and self.drive.objects is not None:
                self.drive.objects.write(cia402.MAX_TORQUE, 0, self._max_torque, 2)
        except DriveError as error:
            if self.drive is not None:
                self.drive.close()
                self.drive = None
            self._problem = str(error)
            self._warn(self._problem)
            self._retry_at = time.monotonic() + RETRY
            return
        self.drive.disable('nobody has called ~/enable')
        self._problem, self._max_torque = '', None
        objects, period = self.drive.objects, s.readings_period
        if objects is not None:
            self.voltage = Reading(VOLTAGE, objects, period)
            self.temperature = Reading(s.temperature, objects, period) if s.temperature else None
        self._next_ns = time.monotonic_ns()
        self._heard_at = time.monotonic()

    def _lose(self, problem: str) -> None:
        """The drive is looked for anew; until then nobody knows whether it had power."""
        assert self.drive is not None
        news = f'{self.procedure.name} failed: {problem}' if self.procedure else ''
        if isinstance(self.procedure, Homing):
            self._max_torque = self.procedure.max_torque
        self.drive.close()
        self.drive = self.voltage = self.temperature = self._counts = None
        self._problem = problem
        self.zero_holds = self.zero_holds and self.settings.absolute_encoder
        self._tell_zero(news)
        self.out.enabled(False)
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
        self.drive.outputs = self.feet.outputs(time.monotonic(), self.drive.enabled)
        before = self.drive.reason
        try:
            self.drive.cycle(judgement.torque[0])
        except DriveError as error:
            self._lose(str(error))
            return
        self.drive.await_answer(WITHIN)
        self._read()
        if self.drive.reason and self.drive.reason != before:
            self.get_logger().error(f'{self.drive.reason}; torque is zero until ~/enable')
        self._cycles += 1
        if self.procedure is not None and self.procedure.over:
            self._conclude(self.procedure)

    def _read(self) -> None:
        """Publish a reading that has come, and disable a drive whose limit it breaks."""
        assert self.drive is not None
        news = False
        if self.voltage is not None and self.voltage.poll():
            self.out.voltage(self.voltage.value)
            news = True
        if self.temperature is not None and self.temperature.poll():
            self.out.temperature(self.temperature.value)
            news = True
        if news and (self.drive.wanted or self.procedure):
            if problem := self._out_of_limits():
                self.drive.disable(problem)

    def _out_of_limits(self) -> str:
        """Why nothing may be torqued by what was read; empty if it may."""
        for reading, limits in (
            (self.voltage, self.settings.voltage_limits),
            (self.temperature, self.settings.temperature_limits),
        ):
            if reading is not None:
                level, told = reading.judge(limits)
                if level == Level.ERROR:
                    return told
        return ''

    # The zero of the hip

    def _tell_zero(self, news: str = '') -> None:
        line = f'known: {self.zero}' if self.zero_holds else UNKNOWN
        self.out.zero_state(f'{news}; {line}' if news else line)

    def _take_zero(self, found: EncoderZero) -> str:
        """From now on that is the zero; why it could not be kept, or empty."""
        self.zero, self.zero_holds = found, True
        self.get_logger().info(str(found))
        self._tell_zero()
        try:
            if self.settings.zero_file:
                found.save(self.settings.zero_file)
        except OSError as error:
            self.get_logger().error(f'the zero is not kept: {error}')
            return f', but it is not kept: {error}'
        return ''

    def _begin(self, procedure: type[Procedure], response: Trigger.Response) -> Trigger.Response:
        """Seek the zero, if the robot is at ease."""
        problem = self._problem or self._why_not_at_ease()
        if not problem and procedure is Homing and self.settings.absolute_encoder:
            problem = 'an absolute encoder keeps its zero, and homing would move it: call ~/zero'
        elif not problem and not isinstance(self.drive, CanDrive):
            problem = f'a drive of the kind {self.settings.driver} seeks no index: call ~/zero'
        response.success, response.message = not problem, problem
        if problem or not isinstance(self.drive, CanDrive):
            return response
        s, objects = self.settings, self.drive.objects
        if procedure is Homing:
            self.drive.lead_through(Homing(s.homing_plan(self.drive.scale.per_mille), objects))
            told = 'homing: the drive turns the hip'
        else:
            self.drive.lead_through(IndexByHand(objects, s.hand_timeout))
            told = f'index by hand: turn the hip through the index within {s.hand_timeout:g} s'
        self.get_logger().info(told)
        self.out.zero_state(told)
        response.message = f'{told}; {topics.ZERO_STATE} says how it ends'
        return response

    @property
    def _at_ease(self) -> bool:
        return self._stage.partition(':')[0] in AT_EASE

    def _why_not_at_ease(self) -> str:
        """Why the zero may not be sought now; empty if it may."""
        if not self._at_ease:
            return f'not while the robot is {self._stage}'
        if self._stopped:
            return 'not while the emergency stop is pressed'
        if self.procedure is not None:
            return f'{self.procedure.name} is under way: ~/disable ends it'
        if self.drive is not None and self.drive.wanted:
            return 'not while the drive is enabled: call ~/disable'
        return self._out_of_limits()

    def _conclude(self, procedure: Procedure) -> None:
        """A procedure is over."""
        assert self.drive is not None
        if not procedure.tidy:
            self._lose(procedure.failure)
            return
        self.drive.procedure = None
        if procedure.index is None:
            told = f'{procedure.name} failed: {procedure.failure}'
            self.zero_holds = self.zero_holds and not procedure.in_doubt
            self.get_logger().error(told)
            self._tell_zero(told)
            return
        s = self.settings
        counts = procedure.index + round(s.index_offset * s.counts_per_rad)
        method = s.homing_method if isinstance(procedure, Homing) else 0
        self._take_zero(EncoderZero.now(counts, procedure.name, method, s.index_offset))

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

    def on_retraction(self, leg: str, message: Bool) -> None:
        """Draw a foot in, or let it out."""
        rivals = self.retractions[leg].get_publisher_count()
        now = time.monotonic()
        self.feet.ask(leg, message.data and rivals <= 1, now)
        if rivals > 1:
            self._warn_feet(f'{rivals} publishers of the {leg} foot; it is out until one is left')
        elif len(self.feet.retracted(now)) > 1:
            self._warn_feet('both feet are asked to be in; both are out')

    def on_robot_state(self, message: String) -> None:
        """The zero is sought only while the robot is at ease."""
        self._stage = message.data
        if self.procedure is not None and not self._at_ease:
            self.procedure.cancel(f'the robot is {self._stage}')

    def on_emergency_stop(self, message: Bool) -> None:
        """Of the zero that is sought; that of the torque is the gate's."""
        self._stopped = message.data
        if message.data and self.procedure is not None:
            self.procedure.cancel('emergency stop')

    def on_enable(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """A person wants torque: out of a fault as well.

        A drive that was switched off has lost its set-up: it is looked for anew, which takes
        seconds and the zero with it. One that was found or heard a moment ago is not given up
        because a person is impatient, or a host was busy.
        """
        silent = self.drive is not None and self.drive.state is None
        wordless = time.monotonic() - self._heard_at
        if silent and wordless > WORDLESS and self.procedure is None:
            self._lose('the drive is silent and is looked for anew')
        problem = self._problem or self._out_of_limits()
        if silent:
            problem = problem or f'the drive has said nothing for {1000 * wordless:.0f} ms'
        # A robot that is let go now would fall: a node that was killed is known for 5 s more.
        self.gate.publishers = self.commands.get_publisher_count()
        problem = problem or self.gate.rivalry
        if self.procedure is not None:
            problem = f'{self.procedure.name} is under way: ~/disable ends it'
        elif not self.zero_holds:
            problem = problem or f'the zero of the hip is {UNKNOWN}'
        response.success = self.drive is not None and not problem
        response.message = problem or 'the drive is led to operation enabled'
        if self.drive is not None and response.success:
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
        problem = self._problem
        if self.drive is None or self._counts is None:
            problem = problem or 'the drive has said nothing yet'
        elif self.procedure is not None:
            problem = f'{self.procedure.name} is under way: ~/disable ends it'
        elif self.drive.wanted:
            problem = 'not while the drive is enabled: call ~/disable'
        response.success, response.message = not problem, problem
        if self._counts is not None and not problem:
            found = EncoderZero.now(self._counts, zero.PARALLEL)
            response.message = f'{found}{self._take_zero(found)}'
        return response

    def on_home(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """The drive shall look for the zero by itself."""
        return self._begin(Homing, response)

    def on_index_by_hand(
        self, request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """A person turns the hip through the index."""
        return self._begin(IndexByHand, response)

    # How it does

    def _publish_diagnostics(self) -> None:
        status = DiagnosticStatus(name='drive', hardware_id=f'node {self.settings.node_id}')
        state = self.drive.state if self.drive else None
        enabled = self.drive is not None and self.drive.enabled
        status.level = DiagnosticStatus.OK if enabled else DiagnosticStatus.WARN
        status.message = state.value if state else 'silent'
        if self.procedure is not None:
            status.message += f': {self.procedure.name}'
        elif self.drive is not None and self.drive.reason:
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
            'zeroed_at': self.zero.taken_at if self.zero is not None and self.zero_holds else '',
            'zero': f'known: {self.zero}' if self.zero_holds else UNKNOWN,
            'feet_in': ', '.join(self.feet.retracted(time.monotonic())) or 'none',
        })  # fmt: skip
        self._cycles = self._answers = self._doubts = self._left_out = self._longest_ns = 0
        for reading, limits in (
            (self.voltage, self.settings.voltage_limits),
            (self.temperature, self.settings.temperature_limits),
        ):
            if reading is not None:
                level, told = reading.judge(limits)
                what = reading.quantity
                publish_status(
                    self.diagnostics,
                    DiagnosticStatus(
                        name=what.name, hardware_id=status.hardware_id, level=LEVELS[level],
                        message=told,
                    ),
                    {what.unit: f'{reading.value:.4g}'},
                )  # fmt: skip

    def close(self) -> None:
        """Leave the drive without torque."""
        if self.drive is None:
            return
        self.drive.disable('the node ends')
        deadline = time.monotonic() + FAREWELL
        with contextlib.suppress(DriveError):
            # Whatever sought the zero leaves the drive as it was.
            while self.procedure and not self.procedure.over and time.monotonic() < deadline:
                self.drive.cycle(0.0)
                self.drive.await_answer(WITHIN)
        self.drive.close()


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_hardware drive_node`."""
    return run(DriveNode, DriveSettings, args, niceness=PRIORITY)


if __name__ == '__main__':
    raise SystemExit(main())
