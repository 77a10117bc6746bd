"""ROS node of the observer: sensors and applied torque in, /state out.

The estimation is in high_gain.py and its rivals, the gathering of messages in samples.py. A state
is published for every measurement, with its stamp, as long as both positions are fresh; a
repeated measurement (lock-step) is answered by the same state.

in    /imu, /hip_encoder, /applied_torque, /foot_contact/inner, /foot_contact/outer
out   /state, /diagnostics
"""

import time
from dataclasses import dataclass
from functools import partial

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from sensor_msgs.msg import Imu, JointState

from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_estimation.estimator import Estimate
from cg_estimation.observer_settings import ObserverSettings, make_estimator, tune
from cg_estimation.samples import Gatherer
from cg_interfaces import channels, topics
from cg_interfaces.ros import (
    SENSOR_QOS,
    DeclaredSettings,
    Throttled,
    publish_status,
    run,
    to_nanoseconds,
    to_stamp,
)
from cg_interfaces.settings import setting

ROBOT = channels.mechanism('compass_gait')
LOADED = 0.5  # N, or the 1 of a plain switch
NO_DRIVE = 1.0  # s after the first sample without a publisher of the applied torque
REPEATED_START = 1_000_000_000  # ns behind the last stamp that mean a new run


@dataclass(frozen=True)
class ObserverNodeSettings(ObserverSettings):
    """Parameters of the observer node."""

    stance: str = setting(
        'contacts', 'the leg that stands, or that the foot contacts tell it',
        choices=('contacts', *STANCES),
    )  # fmt: skip


class ObserverNode(Node):
    """Publishes /state."""

    def __init__(self, **kwargs):
        super().__init__('observer', **kwargs)
        self.started = False
        self.declared = DeclaredSettings(self, ObserverNodeSettings, at_work=lambda: self.started)
        settings = self.declared.values
        path = model_path(settings.model_file or NOMINAL_MODEL)
        told = settings.stance == 'contacts'
        model = Model.load(path)
        self.estimator = make_estimator(
            settings, model, Setup(stance='inner' if told else settings.stance)
        )
        self.gatherer = Gatherer(contacts=told)
        # Other states of effects, of sensors say, are of no use to a controller.
        self._angles, self._rates = [0, 1], [2, 3]
        estimated = self.estimator.state_names
        rotors = [f'{e.label}.{e.states[0]}' for e in model.effects if e.elastic]
        if rotors and rotors[0] in estimated:
            rotor = estimated.index(rotors[0])
            self._angles, self._rates = [0, 1, rotor], [2, 3, rotor + 1]
        self.message = JointState(name=[*STANCES, channels.ROTOR][: len(self._angles)])
        self._published = 0
        self._warn_stance = Throttled(self.get_logger().warning)
        self._warn_blind = Throttled(self.get_logger().warning)
        self._withheld = 0
        self._longest = 0.0
        self._next_diagnosis = 0.0
        self._last_ns = 0
        self._begun = False
        self._first_heard: float | None = None
        self.publisher = self.create_publisher(JointState, topics.STATE, SENSOR_QOS)
        self.diagnostics = self.create_publisher(DiagnosticArray, topics.DIAGNOSTICS, 10)
        self.applied = self.create_subscription(
            JointState, topics.APPLIED_TORQUE, self.on_torque, SENSOR_QOS
        )
        for kind, topic, heard in (
            (JointState, topics.HIP_ENCODER, self.on_encoder),
            *(
                (WrenchStamped, topics.FOOT_CONTACT.format(leg=leg), partial(self.on_contact, leg))
                for leg in STANCES
            ),
            (Imu, topics.IMU, self.on_imu),
        ):
            self.create_subscription(kind, topic, heard, SENSOR_QOS)
        self.started = True

    def on_torque(self, message: JointState) -> None:
        """The drive has latched a torque."""
        if list(message.name) == ['hip'] and len(message.effort) == 1:
            self.gatherer.add_torque(to_nanoseconds(message.header.stamp), message.effort[0])
            self._use()

    def on_encoder(self, message: JointState) -> None:
        """Hip angle."""
        self._read(message, ROBOT.topics[topics.HIP_ENCODER])

    def on_contact(self, leg: str, message: WrenchStamped) -> None:
        """Foot contact."""
        stamp = to_nanoseconds(message.header.stamp)
        self.gatherer.add_contact(stamp, leg, message.wrench.force.z > LOADED)
        self._use()

    def on_imu(self, message: Imu) -> None:
        """Lean of the inner legs, interfaces.md, and its rate."""
        self._read(message, ROBOT.topics[topics.IMU])

    def _read(self, message: Imu | JointState, topic: channels.Topic) -> None:
        try:
            outputs = channels.extract(message, topic)
        except ValueError as error:
            self.get_logger().warning(f'{topic.name}: {error}', throttle_duration_sec=1.0)
            return
        if outputs or topic.name == topics.IMU:
            self._take(to_nanoseconds(message.header.stamp), outputs)

    def _take(self, stamp_ns: int, outputs: dict[str, float]) -> None:
        if stamp_ns < self._last_ns - REPEATED_START:
            self.gatherer.restart()
            self.estimator.reset()
            self._last_ns, self._begun = 0, False
        if stamp_ns == self._last_ns and 'imu_angle' in outputs:
            self.publisher.publish(self.message)
            return
        self.gatherer.add(stamp_ns, outputs)
        self._use()

    def _use(self) -> None:
        if not self._begun and not self._hears_the_drive():
            return
        for measurement in self.gatherer.due():
            if not self._begun and self.declared.values.stance == 'contacts':
                if measurement.stance is None:
                    self._warn_stance(
                        'the foot contacts do not tell which leg stands; no state is published'
                    )
                    continue
            self._begun = True
            start = time.perf_counter()
            settings = self.declared.values
            tune(self.estimator, settings)
            estimate = self.estimator.step(
                measurement.stamp_ns,
                measurement.torque,
                self.estimator.forward(measurement.outputs, measurement.late),
                measurement.stance,
            )
            self._publish(estimate, settings.longest_blind)
            self._last_ns = measurement.stamp_ns
            self._longest = max(self._longest, time.perf_counter() - start)

    def _hears_the_drive(self) -> bool:
        """True if the drive is heard, or there is none: discovery takes its time."""
        now = time.monotonic()
        self._first_heard = self._first_heard or now
        return self.applied.get_publisher_count() > 0 or now > self._first_heard + NO_DRIVE

    def _publish(self, estimate: Estimate, longest_blind: float) -> None:
        if not estimate.blind <= longest_blind:
            self._withheld += 1
            self._warn_blind(f'no position for {estimate.blind:.3g} s; no state is published')
            return
        x = estimate.x
        self.message.header.stamp = to_stamp(estimate.stamp_ns)
        self.message.header.frame_id = f'{estimate.stance}_foot'
        self.message.position = [float(x[i]) for i in self._angles]
        self.message.velocity = [float(x[i]) for i in self._rates]
        self.publisher.publish(self.message)
        self._published += 1

    def poll(self) -> float:
        """Say once a second how it goes."""
        now = time.monotonic()
        if now >= self._next_diagnosis:
            self._next_diagnosis = now + 1.0
            status = DiagnosticStatus(name='observer', hardware_id='state')
            ill = self._withheld or self.estimator.restarts
            status.level = DiagnosticStatus.WARN if ill else DiagnosticStatus.OK
            status.message = 'observing' if self._published else 'no measurements'
            counts = {
                'published': self._published,
                'withheld': self._withheld,
                'restarts': self.estimator.restarts,
                'samples_out_of_order': self.estimator.ignored,
                'longest_step_ms': f'{1e3 * self._longest:.3f}',
            }
            publish_status(self.diagnostics, status, counts)
            self._published = self._withheld = self.estimator.restarts = 0
            self._longest = 0.0
        return max(0.0, self._next_diagnosis - now)


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_estimation observer_node`."""
    return run(ObserverNode, ObserverNodeSettings, args)


if __name__ == '__main__':
    raise SystemExit(main())
