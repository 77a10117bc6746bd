"""ROS node of the experimenter of a real robot: goes through its checklist, or an experiment.

The robot is running already (`ros2 run cg_bringup robot`). The experimenter asks the safety gate
for torque like any controller, as the owner `experimenter`, and presses the buttons that a person
would: arm, enable, stop. However it ends, torque is zero, the robot disarmed, the drive disabled,
and every setting what it was. What it does is in cg_hardware.checklist and wired_experiment.py.

in    /imu, /hip_encoder, /applied_torque, /torque_command, /drive_enabled, /foot_contact/inner,
      /foot_contact/outer, /robot_state, /diagnostics, /recorder/progress
out   /torque_request/experimenter, /emergency_stop, /experiment
"""

import os
import queue
import stat
import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as Late
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import WrenchStamped
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import GetParameters, SetParameters
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Bool, Header, String
from std_srvs.srv import Trigger

from cg_bringup import operating
from cg_bringup.wired_experiment import EXPERIMENTER
from cg_hardware.checklist.measuring import Heard, Track
from cg_hardware.checklist.robot import Device, Hands, Quit, Refused, Skipped, Torque
from cg_hardware.checklist.sensing import CHANNELS
from cg_hardware.emulators.wires import HANDS
from cg_interfaces import channels, topics
from cg_interfaces.ros import (
    LATCHED_QOS,
    MACHINE_QOS,
    SENSOR_QOS,
    DeclaredSettings,
    run,
    to_nanoseconds,
)
from cg_interfaces.settings import setting

POLL = 0.005  # s
PRIORITY = -10  # niceness, where it may be had: as the drive's, whose answers it times
LOOK = 0.02  # s between two looks at what was heard
THERE = 5.0  # s in which a service or a controller is there
ANSWERED = 5.0  # s in which a service answers
ENABLED = 5.0  # s in which a drive is led to operation enabled
INTERRUPTED = 130  # exit status
FAREWELL = 2.0  # s for the last orders
OWNER = 'experimenter'
REQUESTS = f'{topics.TORQUE_REQUEST}/{OWNER}'
BUTTONS = (
    '/imu/zero', '/imu/find_axis', '/drive/zero', '/drive/enable', '/drive/disable',
    '/safety_gate/arm', '/safety_gate/disarm', '/safety_gate/reset', '/safety_gate/stop',
)  # fmt: skip
FOR_EXPERIMENTS = topics.IMU, topics.HIP_ENCODER, topics.DRIVE_ENABLED
TYPES = {'/foot_contact/inner': WrenchStamped, '/foot_contact/outer': WrenchStamped, '/imu': Imu}


class Interrupted(Exception):
    """The node is told to end; `close` sees to the robot."""


@dataclass(frozen=True)
class ExperimenterSettings(operating.TaskSettings):
    """Parameters of the experimenter node: those of its task."""

    yes: bool = setting(False, 'nobody is asked: an emulated robot has hands of its own')


class ExperimenterNode(Node):
    """Hears the robot and presses its buttons, for a task in another thread."""

    eagerness = 10  # messages taken between two polls

    def __init__(self, **kwargs):
        super().__init__('experimenter', **kwargs)
        self.finished, self.exit_status = False, 0
        self.declared = DeclaredSettings(self, ExperimenterSettings)
        self.settings: ExperimenterSettings = self.declared.values  # type: ignore[assignment]
        self.mechanism = channels.mechanism('compass_gait')
        self.stage, self.emulated = '', False
        self.recorded = False
        self._heard: dict[str, Track] = {}
        self._forget()
        self._last: dict[str, float] = {}
        self._devices: dict[str, Device] = {}
        self._torque: Torque | None = None
        self._torque_since: int | None = None
        self._torqued = False  # the last torque that was asked for is not zero
        self._orders: queue.Queue[tuple[Callable[[], Any], Future]] = queue.Queue()
        self._due: list[tuple[float, str]] = []
        self._changed: list[tuple[str, str, Any]] = []  # node, setting, value before
        self._in_control = False
        self._hands: Path | None = None
        self._ended = threading.Event()
        self._worker: threading.Thread | None = None
        self._buttons = {name: self.create_client(Trigger, name) for name in BUTTONS}
        for node in ('imu', 'drive', 'safety_gate'):
            ask, name = f'/{node}/get_parameters', f'/{node}/set_parameters'
            self._buttons[ask] = self.create_client(GetParameters, ask)
            if node == 'safety_gate':
                self._buttons[name] = self.create_client(SetParameters, name)
        self.requests: Any = self.create_publisher(JointState, REQUESTS, SENSOR_QOS)
        self.message = JointState(name=list(self.mechanism.joints))
        self.message.header.frame_id = self.mechanism.torque.frame_id
        wanted = CHANNELS if self.settings.task == 'checklist' else FOR_EXPERIMENTS
        for topic in wanted:  # samples at 500 Hz cost: none for nothing
            heard = partial(self.on_sample, topic, CHANNELS[topic])
            self.create_subscription(TYPES.get(topic, JointState), topic, heard, MACHINE_QOS)
        self.create_subscription(String, topics.ROBOT_STATE, self.on_stage, LATCHED_QOS)
        self.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, self.on_diagnostics, 10)
        self.create_subscription(Header, topics.RECORDER_PROGRESS, self.on_recorder, SENSOR_QOS)
        self.stop = self.create_publisher(Bool, topics.EMERGENCY_STOP, 10)
        self.note = self.create_publisher(String, topics.EXPERIMENT, LATCHED_QOS)

    # What is heard, in the thread that spins

    def on_sample(self, topic: str, names: tuple[str, ...], message: Any) -> None:
        """Keep a sample; a measurement of the IMU is answered with the torque that is wanted."""
        stamp, now = to_nanoseconds(message.header.stamp), time.time_ns()
        if isinstance(message, WrenchStamped):
            values = {names[0]: message.wrench.force.z}
        elif topic == topics.DRIVE_ENABLED:
            values = {names[0]: message.position[0]}
        elif topic in (topics.APPLIED_TORQUE, topics.TORQUE_COMMAND):
            values = {names[0]: message.effort[0]}
        else:
            values = channels.extract(message, self.mechanism.topics[topic])
        for name, value in values.items():
            self._heard[name].add(stamp, now, value)
            self._last[name] = value
        if topic == topics.IMU:
            self._answer(stamp)

    def _answer(self, stamp_ns: int) -> None:
        if self._torque is None or self.requests is None:
            return
        if self._torque_since is None:
            self._torque_since = stamp_ns
        self._send(stamp_ns, self._torque((stamp_ns - self._torque_since) / 1e9))

    def _send(self, stamp_ns: int, torque: float) -> None:
        self.message.header.stamp.sec, self.message.header.stamp.nanosec = divmod(
            stamp_ns, 1_000_000_000
        )
        self.message.effort = [float(torque)]
        self._torqued = torque != 0.0
        self.requests.publish(self.message)

    def on_stage(self, message: String) -> None:
        """The gate says in which stage the robot is."""
        self.stage = message.data

    def on_recorder(self, message: Header) -> None:
        """A recorder hears everything."""
        self.recorded = True

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        """What devices tell of themselves."""
        for status in message.status:
            self._devices[status.name] = Device(
                status.message, status.level != DiagnosticStatus.ERROR,
                {value.key: value.value for value in status.values}, status.hardware_id,
            )  # fmt: skip

    def poll(self) -> float:
        """Carry out what the task ordered."""
        if self._worker is None:
            self._worker = threading.Thread(target=self._work, daemon=True)
            self._worker.start()
        while not self._orders.empty():
            order, answer = self._orders.get()
            try:
                answer.set_result(order())
            except Exception as error:
                answer.set_exception(error)
        now = time.monotonic()
        for due in [due for due in self._due if due[0] <= now]:
            self._due.remove(due)
            self._move_hands(due[1])
        return POLL

    def _work(self) -> None:
        self.exit_status = 1
        try:
            self.exit_status = operating.carry_out(self, self.settings)
        except (Refused, ValueError, OSError) as error:
            self.say(f'error: {error}')
        except Interrupted:
            self.exit_status = INTERRUPTED
        except Quit as ended:
            self.say(str(ended))
        finally:
            self.finished = True

    # What the task asks for, in its own thread: cg_hardware.checklist.robot.Robot

    def say(self, text: str) -> None:
        """Tell the person something."""
        telling = EXPERIMENTER if self.settings.task == 'experiment' else ''
        print(f'{telling}{text}', flush=True)

    def ask(self, text: str, hands: Hands = ()) -> None:
        """Have a person do something; the emulated robot has hands of its own."""
        if text and not self.settings.yes:
            self._ask(text)
        if self._hands is not None:
            self._due += [(time.monotonic() + after, words) for after, words in hands]

    def _ask(self, text: str) -> None:
        print(f'{text}\n  [Enter: done, s: skip, q: quit] ', end='', flush=True)
        said = sys.stdin.readline()
        word = said.strip().lower()[:1]
        if not said or word == 'q':
            raise Quit('ended by the person' if said else 'nobody answers; --yes asks nobody')
        if word == 's':
            raise Skipped('left out by the person')

    def listen(
        self,
        seconds: float,
        torque: Torque | None = None,
        until: Callable[[Heard], bool] | None = None,
        more: bool = False,
    ) -> Heard:
        """What comes within so many seconds, while a torque is requested."""

        def begin() -> None:
            if not more:
                self._forget()
            self._torque, self._torque_since = torque, None

        self._do(begin)
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            self._wait(min(LOOK, max(0.0, deadline - time.monotonic())))
            if until is not None and until(self._series()):
                break
        return self._series()

    def _forget(self) -> None:
        self._heard = {name: Track() for names in CHANNELS.values() for name in names}

    def _series(self) -> Heard:
        return {name: track.series() for name, track in self._heard.items()}

    def publishers_of(self, topic: str) -> list[str]:
        """Names of the nodes that publish a topic."""
        return self._do(
            lambda: [info.node_name for info in self.get_publishers_info_by_topic(topic)]
        )

    def device(self, name: str) -> Device | None:
        """What a device last told."""
        return self._devices.get(name)

    def setting(self, node: str, name: str) -> Any:
        """A parameter of a node."""
        request = GetParameters.Request(names=[name])
        (found,) = self._request(GetParameters, f'/{node}/get_parameters', request).values
        value = parameter_value_to_python(found)
        if value is None:
            raise Refused(f'{node} has no parameter {name}')
        return value

    def change(self, node: str, name: str, value: Any) -> None:
        """Set a parameter of a node; `rest` sets it back."""
        before = self.setting(node, name)
        self._set(node, name, value)
        self._changed.append((node, name, before))

    def _set(self, node: str, name: str, value: Any) -> None:
        request = SetParameters.Request(parameters=[parameter(name, value)])
        (result,) = self._request(SetParameters, f'/{node}/set_parameters', request).results
        if not result.successful:
            raise Refused(f'{node} refuses {name} {value}: {result.reason}')

    def press(self, button: str) -> str:
        """Call a service that people call."""
        answer = self._request(Trigger, button, Trigger.Request())
        if not answer.success:
            raise Refused(f'{button}: {answer.message}')
        return answer.message

    def take_control(self) -> None:
        """Be the one that the gate listens to, arm, and enable the drive."""
        if self.requests is None:
            self.requests = self._do(
                lambda: self.create_publisher(JointState, REQUESTS, SENSOR_QOS)
            )
        self._until(
            lambda: self.requests.get_subscription_count() > 0, THERE,
            f'the safety gate does not listen to {REQUESTS}: is its parameter `owners` set?',
        )  # fmt: skip
        self._in_control = True
        self._last.pop('enabled', None)
        self.change('safety_gate', 'owner', OWNER)
        self.press('/safety_gate/arm')
        self.press('/drive/enable')
        self._until(lambda: self._last.get('enabled') == 1.0, ENABLED,
                    'the drive is not enabled')  # fmt: skip

    def stop_by_topic(self) -> None:
        """Press the emergency stop by its topic."""
        self._do(lambda: self.stop.publish(Bool(data=True)))

    def leave(self) -> None:
        """Vanish as a controller."""

        def leave() -> None:
            if self.requests is not None:
                self.destroy_publisher(self.requests)
                self.requests = None

        self._do(leave)

    def rest(self) -> None:
        """Zero torque, disarmed, disabled, no fault, every setting as it was."""

        def quiet() -> None:
            self._torque = None
            if self._torqued and self.requests is not None:
                self._send(time.time_ns(), 0.0)

        self._do(quiet)
        for kind, name, request in self._last_orders():
            try:
                self._request(kind, name, request)
            except Refused as refused:
                self.say(f'at the end of the step: {refused}')

    def _last_orders(self) -> list[tuple[Any, str, Any]]:
        """What takes torque and control off; nothing where there was none."""
        orders: list[tuple[Any, str, Any]] = []
        if self._in_control:
            orders = [
                (Trigger, f'/{button}', Trigger.Request())
                for button in ('safety_gate/disarm', 'drive/disable', 'safety_gate/reset')
            ]
        for node, name, before in reversed(self._changed):
            request = SetParameters.Request(parameters=[parameter(name, before)])
            orders.append((SetParameters, f'/{node}/set_parameters', request))
        self._in_control, self._changed = False, []
        return orders

    def now_ns(self) -> int:
        """The host's clock."""
        return time.time_ns()

    # What only experiments need

    def announce(self, note: str) -> None:
        """Publish the recording note."""
        self._do(lambda: self.note.publish(String(data=note)))

    def await_recorder(self, patience: float) -> None:
        """Wait until a recorder hears everything."""
        self._until(lambda: self.recorded, patience, 'no recorder hears the robot')

    def find_hands(self) -> None:
        """See whether the robot is emulated, by what lies beside the line of its IMU."""
        try:
            path = Path(str(self.setting('imu', 'port'))).parent / HANDS
        except Refused:
            return
        if path.exists() and stat.S_ISFIFO(path.stat().st_mode):
            self._hands, self.emulated = path, True

    # Between the threads

    def _do(self, order: Callable[[], Any]) -> Any:
        """Have the thread that spins do something; its answer."""
        answer: Future = Future()
        self._orders.put((order, answer))
        while True:
            self._check()
            try:
                return answer.result(timeout=0.1)
            except Late:
                continue

    def _check(self) -> None:
        if self._ended.is_set():
            raise Interrupted

    def _wait(self, seconds: float) -> None:
        if self._ended.wait(seconds):
            raise Interrupted

    def _until(self, condition: Callable[[], bool], patience: float, otherwise: str) -> None:
        deadline = time.monotonic() + patience
        while not condition():
            if time.monotonic() > deadline:
                raise Refused(otherwise)
            self._wait(0.01)

    def _request(self, kind: Any, name: str, request: Any) -> Any:
        client = self._buttons[name]
        self._until(client.service_is_ready, THERE, f'{name} is not there')
        # A server may not have matched yet who waits for its answer. Buttons are pressed once.
        for last in (True,) if kind is Trigger else (False, False, True):
            future = self._do(lambda: client.call_async(request))
            try:
                self._until(future.done, ANSWERED, f'{name} does not answer')
            except Refused:
                if last:
                    raise
            else:
                return future.result()

    def _move_hands(self, words: str) -> None:
        assert self._hands is not None
        pipe = os.open(self._hands, os.O_WRONLY | os.O_NONBLOCK)
        try:
            os.write(pipe, f'{words}\n'.encode())
        finally:
            os.close(pipe)

    def close(self) -> None:
        """Leave with zero torque, disarmed and disabled, whatever the task was at."""
        self._ended.set()
        self._torque = None
        if self.requests is not None:
            self._send(time.time_ns(), 0.0)
        waiting = []
        for _, name, request in self._last_orders():
            client = self._buttons[name]
            if client.service_is_ready():
                waiting.append(client.call_async(request))
        if waiting:
            executor = EventsExecutor()
            executor.add_node(self)
            deadline = time.monotonic() + FAREWELL
            while time.monotonic() < deadline and not all(future.done() for future in waiting):
                executor.spin_once(timeout_sec=0.02)
            executor.remove_node(self)
        if self._worker is not None:
            self._worker.join(0.5)


def parameter(name: str, value: Any) -> ParameterMessage:
    """A parameter as its service takes it."""
    return Parameter(name, value=value).to_parameter_msg()


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_bringup experimenter_node`."""
    return run(ExperimenterNode, ExperimenterSettings, args, PRIORITY)


if __name__ == '__main__':
    raise SystemExit(main())
