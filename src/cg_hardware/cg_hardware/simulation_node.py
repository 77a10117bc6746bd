"""ROS node that stands in for the hardware: the simulated machine behind the real topics.

The machine is cg_dynamics.plant, what may reach its drive is safety.py, and the messages are
made in sensor_publishers.py. This node keeps the clock, in one of two modes.

real_time   Samples are due on the machine's own clock. Each tick publishes the measurement,
            latches the latest command that passes the gate, publishes it as applied, goes on.
lockstep    The measurement stamped t goes out, then nothing moves until the command stamped t
            is there. The same seed and peers give the same messages at any machine load. A peer
            that does not answer in time ends the run, with zero torque.

in    /torque_command, /recorder/progress
out   /applied_torque, /experiment, /diagnostics, /clock (lockstep); of a compass gait /imu,
      /hip_encoder, /hip_encoder/counts, /foot_contact/inner, /foot_contact/outer, of a pendulum
      /joint_states
"""

import math
import time
from datetime import datetime, timezone

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_msgs.msg import Header, String

from cg_description.reading import path_of
from cg_dynamics.errors import SimulationError
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_hardware.safety import GateSettings, TorqueGate
from cg_hardware.sensor_publishers import SensorPublishers, torques_of
from cg_hardware.simulation import (
    LOCKSTEP_EPOCH_NS,
    Pace,
    SimulationSettings,
    build_plant,
    check_fall_angle,
    model_file_of,
    noise_variances,
    read_setup,
    recording_note,
    ticks_of,
)
from cg_hardware.standing import Standing
from cg_interfaces import topics
from cg_interfaces.ros import (
    IDLE_POLL,
    LATCHED_QOS,
    SENSOR_QOS,
    DeclaredSettings,
    Throttled,
    publish_status,
    run,
    to_nanoseconds,
    to_stamp,
)
from cg_interfaces.stamps import NS_PER_S

RECORDER_WINDOW = 40  # samples that a lock-step run may be ahead of its recorders
LATE = 0.02  # s behind the clock that are worth a warning
REPEAT = 0.1  # s between repetitions of the first measurement of a lock-step run
SILENCE = 2.0  # s after which another publisher of the machine's topics counts as dead


class SimulationNode(LifecycleNode):
    """The simulated hardware."""

    eagerness = 3  # messages taken between two samples even when the machine is late

    def __init__(self, **kwargs):
        super().__init__('simulation_node', **kwargs)
        self.plant = None
        self.phase = 'off'  # off, gathering, running, finishing
        self.finished = False
        self.exit_status = 0
        self.declared = DeclaredSettings(
            self, SimulationSettings, at_work=lambda: self.plant is not None
        )
        self.diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        self._next_diagnosis = 0.0
        self._faults = 0
        self._warn = Throttled(self.get_logger().warning)
        self._warn_late = Throttled(self.get_logger().warning)
        self._eavesdropper = None
        self._silent_ghosts = False
        self.standing = None
        if self.settings.autostart:
            self._start()

    @property
    def settings(self) -> SimulationSettings:
        """The present settings."""
        return self.declared.values

    def _start(self) -> None:
        for transition in (self.trigger_configure, self.trigger_activate):
            if transition() != TransitionCallbackReturn.SUCCESS:
                raise ValueError('the simulated hardware could not start; see its log')

    # Lifecycle

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Load model and set-up, bring the topics up."""
        try:
            model = Model.load(model_file_of(self.settings.model_file))
            setup = read_setup(self.settings.setup)
            mechanism = model.mechanism.name
            check_fall_angle(self.settings, mechanism, setup)
            self.make_plant = lambda: build_plant(self.settings, model, setup)
            plant = self.make_plant()
            sensors = SensorPublishers(self, mechanism, noise_variances(model))
        except (ValueError, OSError) as error:
            self.get_logger().error(f'not configured: {error}')
            return TransitionCallbackReturn.FAILURE
        self.plant, self.sensors = plant, sensors
        self.joints = sensors.joints
        self.limit = self.settings.torque_limit or float(model.torque_limit)
        if math.isinf(self.limit):
            self.get_logger().warning('the model states no torque limit; nothing is limited')
        gate = GateSettings(
            torque_limit=self.limit,
            stale_after=self.settings.stale_after,
            sample_rate_hz=self.settings.sample_rate_hz,
        )
        self.gate = TorqueGate(gate, self.joints)
        self.lockstep = self.settings.mode == 'lockstep'
        self.zeroed_ns = LOCKSTEP_EPOCH_NS if self.lockstep else time.time_ns()
        zeroed_at = datetime.fromtimestamp(self.zeroed_ns // NS_PER_S, timezone.utc)
        self.note = recording_note(
            self.settings,
            mechanism,
            setup,
            list(model.mechanism.outputs),
            zeroed_at.strftime('%Y-%m-%dT%H:%M:%SZ'),
        )
        self.clock_publisher = (
            self.create_publisher(Clock, topics.CLOCK, SENSOR_QOS) if self.lockstep else None
        )
        self.note_publisher = self.create_publisher(String, topics.EXPERIMENT, LATCHED_QOS)
        self.command = self.create_subscription(
            JointState, topics.TORQUE_COMMAND, self.on_command, SENSOR_QOS
        )
        self.progress: dict[str, int] = {}
        self.progress_subscription = self.create_subscription(
            Header, topics.RECORDER_PROGRESS, self.on_progress, SENSOR_QOS
        )
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publish the note, then start the clock as soon as all peers are there."""
        self.note_publisher.publish(String(data=self.note))
        self.plant = self.make_plant()
        self.gate.drop('no command yet')
        self.progress.clear()
        self._silent_ghosts = False
        self.standing = None
        if self.settings.fall_angle > 0.0:
            sample_time = 1.0 / self.settings.sample_rate_hz
            self.standing = Standing(self.settings.fall_angle, self.plant.stance, sample_time)
        self.phase = 'gathering'
        self._deadline = time.monotonic() + self.settings.peer_timeout
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop the clock; the motor is without torque."""
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Take everything down that on_configure brought up."""
        self._stop()
        self.sensors.destroy(self)
        for publisher in (self.clock_publisher, self.note_publisher):
            if publisher is not None:
                self.destroy_publisher(publisher)
        self.destroy_subscription(self.command)
        self.destroy_subscription(self.progress_subscription)
        self.plant = None
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop, and end the process."""
        self._stop()
        self.finished = True
        return TransitionCallbackReturn.SUCCESS

    def _stop(self) -> None:
        self.phase = 'off'
        self._stop_eavesdropping()
        if self.plant is not None:
            self.gate.drop('not active')
            self.plant.latch([0.0] * len(self.joints))

    # What is due between messages

    def poll(self) -> float:
        """Do what is due; return the s until this wants to be asked again."""
        now = time.monotonic()
        if now >= self._next_diagnosis:
            self._next_diagnosis = now + 1.0
            self._publish_diagnostics()
        if self.phase == 'gathering':
            return self._gather(now)
        if self.phase == 'finishing':
            return self._finish(now)
        if self.phase == 'running' and self.lockstep:
            return self._poll_lockstep(now)
        if self.phase == 'running':
            return self._poll_real_time()
        return IDLE_POLL

    def _gather(self, now: float) -> float:
        missing = self._missing_peers()
        if missing and now > self._deadline:
            self._fail(f'waited {self.settings.peer_timeout:g} s for {missing}')
        elif not missing:
            self._begin()
        return 0.005

    def _missing_peers(self) -> str:
        if self._another_machine_speaks():
            return (
                f'the end of another machine, which publishes {topics.APPLIED_TORQUE} in this '
                'ROS domain'
            )
        needed = self.settings.recorders
        unheard = self.sensors.unheard(needed)
        if unheard:
            return f'a recorder of {", ".join(unheard)}'
        if len(self.progress) < needed:
            return 'a recorder that says it hears everything'
        if self.lockstep and self.command.get_publisher_count() == 0:
            return f'a publisher of {topics.TORQUE_COMMAND}'
        return ''

    def _another_machine_speaks(self) -> bool:
        # A machine that was killed stays on the graph for a while; it is known by its silence.
        if self._silent_ghosts or self.count_publishers(topics.APPLIED_TORQUE) <= 1:
            self._stop_eavesdropping()
            return False
        now = time.monotonic()
        if self._eavesdropper is None:
            self._heard_at = now
            self._eavesdropper = self.create_subscription(
                JointState, topics.APPLIED_TORQUE, self._on_foreign_torque, SENSOR_QOS
            )
        if now - self._heard_at < SILENCE:
            return True
        self._stop_eavesdropping()
        self._silent_ghosts = True
        return False

    def _on_foreign_torque(self, message: JointState) -> None:
        self._heard_at = time.monotonic()

    def _stop_eavesdropping(self) -> None:
        if self._eavesdropper is not None:
            self.destroy_subscription(self._eavesdropper)
            self._eavesdropper = None

    def _begin(self) -> None:
        self.phase = 'running'
        self._begun = time.monotonic()
        self.total = ticks_of(self.settings.duration, self.settings.sample_rate_hz)
        self.ticks = 0
        self.epoch_ns = LOCKSTEP_EPOCH_NS if self.lockstep else time.time_ns()
        self.pace = Pace(self.settings.sample_rate_hz, time.monotonic_ns())
        self._awaiting_first = self.settings.await_answer and not self.lockstep
        if self.lockstep or self._awaiting_first:
            self._present()

    def _stamp(self) -> int:
        return self.epoch_ns + round(self.ticks * NS_PER_S / self.settings.sample_rate_hz)

    def _publish_measurement(self) -> None:
        self._measured_ns = self._stamp()
        if self.clock_publisher is not None:
            self.clock_publisher.publish(Clock(clock=to_stamp(self._measured_ns)))
        impulse = self.settings.pushes_at(self.ticks)
        if impulse:
            self.plant.push(impulse)
        self._measurement = self.plant.measure()
        self.sensors.publish_measurement(self._measured_ns, self._measurement)

    def _torque(self) -> tuple[float, ...]:
        """What the gate lets act in the sample that was measured last."""
        self.gate.publishers = self.command.get_publisher_count()
        judgement = self.gate.torque(self._measured_ns)
        if judgement.doubt and judgement.doubt != 'no command yet':
            self._doubt(judgement.doubt)
        return judgement.torque

    def _apply(self, torque: tuple[float, ...]) -> bool:
        """Latch, publish what was latched, let one sample time pass; False if the run broke."""
        self.plant.latch(torque)
        self.sensors.publish_applied(self._stamp(), torque)
        try:
            self.plant.advance()
        except SimulationError as error:
            self._fail(str(error))
            return False
        self.ticks += 1
        return self._stands()

    def _stands(self) -> bool:
        """False if the robot has just fallen, which ends the run."""
        plant = self.plant
        if self.standing is None:
            return True
        lean = plant.state[STANCES.index(plant.stance)]
        if self.standing.see(plant.time, plant.stance, lean):
            return True
        self._fail(f'the robot fell at {plant.time:.3f} s')
        return False

    # Real time

    def _poll_real_time(self) -> float:
        if self._awaiting_first:
            now = time.monotonic()
            self._repeat_first(now)
            return self._repeat_at - now
        # One sample at a time, so that a late machine still hears the answers between samples.
        if self.pace.take(time.monotonic_ns()):
            if self.total is not None and self.ticks >= self.total:
                self._begin_to_finish()
                return 0.0
            self._publish_measurement()
            if not self._apply(self._torque()):
                return 0.0
        now_ns = time.monotonic_ns()
        late = self.pace.lateness(now_ns) / NS_PER_S
        if late > LATE:
            self._warn_late(
                f'{late:.3f} s late: too busy a machine for real time; no sample is left out'
            )
        return max(0.0, (self.pace.next_ns - now_ns) / NS_PER_S)

    def on_command(self, message: JointState) -> None:
        """Take in a torque command."""
        if self.phase != 'running':
            return
        stamp_ns = to_nanoseconds(message.header.stamp)
        if self.lockstep and not (self._awaiting and stamp_ns == self._measured_ns):
            return
        self.gate.publishers = self.command.get_publisher_count()
        try:
            torques = torques_of(message, self.joints)
        except ValueError as error:
            self.gate.drop(str(error))
            fit, doubt = False, str(error)
        else:
            judgement = self.gate.offer(torques, stamp_ns, self._measured_ns)
            fit, doubt = not judgement.refused, judgement.doubt
        if self.lockstep:
            self._answered()  # says what is in doubt
            return
        if doubt:
            self._doubt(doubt)
        if self._awaiting_first and fit:
            self._start_clock()

    def _start_clock(self) -> None:
        """Somebody controls the machine; its time begins now."""
        self._awaiting_first = False
        self.gate.drop('no command yet')
        self.epoch_ns = time.time_ns()
        self.pace = Pace(self.settings.sample_rate_hz, time.monotonic_ns())

    # Lock-step

    def _present(self) -> None:
        """Publish the measurement whose answer the machine now waits for."""
        self._publish_measurement()
        self._awaiting = True
        self._held_back = False
        now = time.monotonic()
        # A peer that plans or loads before it controls takes as long to begin as one that starts.
        begins = self.ticks == 0
        self._wait = self.settings.peer_timeout if begins else self.settings.answer_timeout
        self._deadline = now + self._wait
        self._repeat_at = now + REPEAT

    def _answered(self) -> None:
        """Apply what the gate makes of the answer, and go on."""
        self._awaiting = False
        if not self._apply(self._torque()):
            return
        if self.total is not None and self.ticks >= self.total:
            self._begin_to_finish()
        else:
            self._present_when_recorded()

    def _present_when_recorded(self) -> None:
        if self.settings.recorders and self.ticks >= RECORDER_WINDOW:
            behind = self._stamp() - self._recorded_ns()
            if behind > RECORDER_WINDOW * NS_PER_S / self.settings.sample_rate_hz:
                if not self._held_back:
                    self._held_back = True
                    self._wait = self.settings.answer_timeout
                    self._deadline = time.monotonic() + self._wait
                return
        self._present()

    def _recorded_ns(self) -> int:
        if len(self.progress) < self.settings.recorders:
            return 0
        return min(self.progress.values(), default=0)

    def on_progress(self, message: Header) -> None:
        """Note up to which stamp a recorder has stored everything."""
        self.progress[message.frame_id] = to_nanoseconds(message.stamp)
        if self.phase == 'running' and self.lockstep and self._held_back:
            self._present_when_recorded()

    def _repeat_first(self, now: float) -> None:
        # The controller may not have been matched yet when the first measurement went out.
        if now > self._repeat_at:
            self._repeat_at = now + REPEAT
            self.sensors.publish_measurement(self._stamp(), self._measurement)

    def _poll_lockstep(self, now: float) -> float:
        if self._awaiting and self.ticks == 0:
            self._repeat_first(now)
        if now > self._deadline:
            waited = f'{self._wait:g} s'
            if self._awaiting:
                seconds = (self._stamp() - self.epoch_ns) / NS_PER_S
                self._fail(
                    f'no {topics.TORQUE_COMMAND} stamped {self._stamp()} ns (answer to the '
                    f'measurement at {seconds:.3f} s) within {waited}'
                )
            else:
                self._fail(f'a recorder did not store anything for {waited}')
        return IDLE_POLL

    # Ends

    def _begin_to_finish(self) -> None:
        self.plant.latch([0.0] * len(self.joints))
        self.phase = 'finishing'
        self._last_ns = self.epoch_ns + round(
            (self.ticks - 1) * NS_PER_S / self.settings.sample_rate_hz
        )
        self._deadline = time.monotonic() + self.settings.answer_timeout

    def _finish(self, now: float) -> float:
        """Wait for the recorders, then deactivate."""
        behind = self.settings.recorders and self._recorded_ns() < self._last_ns
        if behind and now > self._deadline:
            self._fail('a recorder did not store the last sample')
        elif not behind:
            seconds = time.monotonic() - self._begun
            outputs = self.plant.measure().outputs if self.plant else {}
            where = ', '.join(
                f'{channel} {value:.3f} rad' for channel, value in outputs.items()
                if channel.endswith('angle')
            )  # fmt: skip
            self.get_logger().info(
                f'run is complete: {self.ticks} samples in {seconds:.3f} s; at the end {where}'
            )
            self.phase = 'off'
            self.trigger_deactivate()
            self.finished = self.settings.exit_when_done
        return 0.005

    def _fail(self, reason: str) -> None:
        """Give the run up: zero torque, a clear message, no more measurements."""
        self.get_logger().error(f'{reason}; torque is zero, the run is given up')
        self._faults += 1
        if self.phase == 'running':
            self.sensors.publish_applied(self._stamp(), (0.0,) * len(self.joints))
        self.trigger_deactivate()
        self.exit_status = 1
        self.finished = self.settings.exit_when_done

    def _doubt(self, reason: str) -> None:
        self._faults += 1
        self._warn(f'torque command: {reason}')

    def _publish_diagnostics(self) -> None:
        status = DiagnosticStatus(name='simulation_node', hardware_id='simulation')
        status.level = DiagnosticStatus.WARN if self._faults else DiagnosticStatus.OK
        status.message = self.phase
        values = {'commands_in_doubt': self._faults}
        if self.phase == 'running':
            values['samples'] = self.ticks
            if not self.lockstep:
                values['late_samples'] = self.pace.late
                values['worst_lateness_ms'] = f'{self.pace.worst_ns / 1e6:.3f}'
                if self.pace.late:
                    status.level = DiagnosticStatus.WARN
                self.pace.forget()
            if self.gate.rivalry:
                status.level, status.message = DiagnosticStatus.ERROR, self.gate.rivalry
        publish_status(self.diagnostics, status, values)
        self._faults = 0

    def close(self) -> None:
        """Leave with zero torque, say so on the topic, and how the robot fared in its file."""
        if self.phase == 'running':
            self.sensors.publish_applied(self._stamp(), (0.0,) * len(self.joints))
        self._stop()
        if self.standing is not None and self.settings.outcome_file:
            self.standing.outcome.save(path_of(self.settings.outcome_file))


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_hardware simulation_node`."""
    return run(SimulationNode, SimulationSettings, args)


if __name__ == '__main__':
    raise SystemExit(main())
