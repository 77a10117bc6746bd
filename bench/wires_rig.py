"""A robot on its wires that a person brings back after a fault, for benches.

One robot is started, and serves as long as a person can make it stand again: hold it, reset, take
the zero where the drive was lost, arm, enable, let go. Nodes that were killed are started again.
"""

import contextlib
import os
import select
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.srv import SetParameters
from rclpy.client import Client
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.parameter import Parameter
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / f'src/cg_{p}/test') for p in ('bringup', 'hardware')]

from emulated_robot import Emulated  # noqa: E402
from wired_robot import Person, options_in  # noqa: E402

from cg_bringup.robot_run import robot_nodes  # noqa: E402
from cg_bringup.runs import NodeOf  # noqa: E402
from cg_bringup.supervisor import Supervisor, supervised  # noqa: E402
from cg_interfaces import topics  # noqa: E402
from cg_interfaces.domains import own_domain  # noqa: E402

START = (0.03, 0.03)  # rad of the legs when a person lets go
PATIENCE = 60.0  # s for a robot to stand, from cold
UPRIGHT = 0.03  # rad of lean that is standing still
LOOKS, LOOK = 4, 0.12  # how often it is seen to stand still, and s between two looks
TRIES = 6
ANSWER = 3.0  # s for a service, before it is called once more
DEVICES, NODES = 20, 10  # real-time priorities of a robot that goes first


class Lost(RuntimeError):
    """A person could not bring the robot to where it should be."""


class Operator(Person):
    """A person who knows what to press, and hears diagnostics.

    Attributes:
        said: Name in /diagnostics -> when it was heard last (monotonic, s), its line, its figures.
    """

    def __init__(self) -> None:
        super().__init__()
        self.said: dict[str, tuple[float, str, dict[str, str]]] = {}
        node = self.node
        node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, self.on_diagnostics, 50)
        self.stop = node.create_publisher(Bool, topics.EMERGENCY_STOP, 10)
        self._clients = {
            name: node.create_client(Trigger, name) for name in (
                '/drive/disable', '/drive/enable', '/drive/zero', '/safety_gate/arm',
                '/safety_gate/reset', '/safety_gate/stop',
            )
        }  # fmt: skip
        self._settings: dict[str, Client] = {}
        self._executor = EventsExecutor()
        self._executor.add_node(node)

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        """Keep what each said last."""
        now = time.monotonic()
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            self.said[status.name] = (now, status.message, values)

    def until(self, condition: Callable[[], Any], patience: float = PATIENCE) -> None:
        """Listen until a condition holds.

        Raises:
            Lost: It never did.
        """
        deadline = time.monotonic() + patience
        while not condition():
            if time.monotonic() > deadline:
                raise Lost(f'after {patience:g} s the robot is still {self.stage or "silent"}')
            self._executor.spin_once(timeout_sec=0.005)

    def call(self, service: str) -> Any:
        """Press a button; the future of the answer."""
        self.until(self._clients[service].service_is_ready)
        return self._clients[service].call_async(Trigger.Request())

    def press(self, service: str) -> Trigger.Response:
        """Press a button, once more if nothing answers: a process that died may still be known."""
        for _ in range(10):
            future = self.call(service)
            with contextlib.suppress(Lost):
                self.until(future.done, ANSWER)
                return future.result()
        raise Lost(f'{service} does not answer')

    def set(self, node: str, name: str, value: bool) -> None:
        """Set a parameter."""
        if node not in self._settings:
            self._settings[node] = self.node.create_client(SetParameters, f'{node}/set_parameters')
        client = self._settings[node]
        self.until(client.service_is_ready)
        parameter = Parameter(name, value=value).to_parameter_msg()
        self.until(client.call_async(SetParameters.Request(parameters=[parameter])).done)


class Rig:
    """A robot on wires, and the person beside it.

    Attributes:
        robot: The emulated devices.
        person: Who presses.
        supervisor: Of the nodes.
        nodes: Their names and parameters.
        log: What the nodes say.
        first: Whether nodes go before what others do on this machine.
        beside: What else there is, by name.
    """

    def __init__(
        self, robot: Emulated, person: Operator, supervisor: Supervisor,
        nodes: dict[str, NodeOf], log: Path, first: bool,
    ):  # fmt: skip
        self.robot, self.person, self.supervisor = robot, person, supervisor
        self.nodes, self.log, self.first = nodes, log, first
        self.put_first(*nodes)
        if first:
            go_first(robot.process, DEVICES)
        self.beside: dict[str, Any] = {}
        self._helpers: dict[str, subprocess.Popen] = {}

    def report(self) -> dict[str, Any]:
        """How the robot is."""
        return self.robot.report()

    def dead(self) -> list[str]:
        """Nodes that have ended."""
        processes = self.supervisor.processes.items()
        return [name for name, process in processes if process.poll() is not None]

    def start(self, name: str) -> None:
        """Start a node again that has ended, and wait until it says how it goes."""
        self.supervisor.processes[name].wait()
        began = time.monotonic()
        self.supervisor.start(name)
        self.put_first(name)
        if name in ('drive', 'imu', 'observer', 'balance', 'safety_gate'):
            said = self.person.said
            self.person.until(lambda: said.get(name, (0.0,))[0] > began)

    def helper(self, *words: str, between: bool = False) -> subprocess.Popen:
        """A Python process beside the nodes, or between them; it has said that it is there."""
        name = ' '.join(words)
        if name not in self._helpers:
            process = subprocess.Popen(
                [sys.executable, *words], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
            )
            self._helpers[name] = process
            if between and self.first:
                go_first(process, NODES)
            self._hear(process)
        return self._helpers[name]

    def ask(self, process: subprocess.Popen, words: str) -> str:
        """Tell a helper to do something; what it says when it does."""
        assert process.stdin is not None
        process.stdin.write(words + '\n')
        process.stdin.flush()
        return self._hear(process)

    def _hear(self, process: subprocess.Popen) -> str:
        assert process.stdout is not None
        self.person.until(lambda: select.select([process.stdout], [], [], 0.0)[0])
        return process.stdout.readline().strip()

    def put_first(self, *names: str) -> None:
        """Have nodes go before what others do on this machine."""
        for name in names if self.first else ():
            go_first(self.supervisor.processes[name], NODES)

    @contextlib.contextmanager
    def devices_first(self) -> Iterator[None]:
        """Devices go before all else on this machine, as those that have their own processors."""
        pid = self.robot.process.pid
        before = os.sched_getscheduler(pid), os.sched_getparam(pid)
        go_first(self.robot.process, DEVICES)
        try:
            yield
        finally:
            os.sched_setscheduler(pid, *before)

    def stands(self) -> bool:
        """Whether nobody needs to bring it back."""
        report = self.report()
        enabled = report['state'] == 'operation enabled' and not report['held']
        return enabled and self.person.stage == 'active' and abs(report['lean']) < UPRIGHT

    def bring_back(self) -> int:
        """Make it stand, whatever has happened to it; all processes are there.

        Returns:
            How often a person had to try: a busy host makes it fall before it stands.

        Raises:
            Lost: It does not.
        """
        for tries in range(1, TRIES + 1):
            try:
                self._make_ready()
                self._stand()
                return tries
            except Lost as lost:
                told = str(lost)
        raise Lost(told)

    def _make_ready(self) -> None:
        """Held where it begins, armed, and enabled, at which the person lets it go."""
        person = self.person
        person.press('/drive/disable')
        self.robot.ask('stand')
        person.until(lambda: self._is_in_place() and 'balance' in person.said)
        if 'fallen' in person.said['balance'][1]:
            person.set('/balance', 'armed', False)
            person.set('/balance', 'armed', True)
        deadline = time.monotonic() + PATIENCE
        enabled = False
        while not enabled:
            if time.monotonic() > deadline:
                raise Lost(f'it is {person.stage}')
            stage = person.stage.partition(':')[0]
            if stage == 'fault':
                person.press('/safety_gate/reset')
            elif stage == 'idle':
                person.press('/safety_gate/arm')
            elif stage == 'active':
                enabled = self._enable()
            elif 'drive' in person.stage:
                person.wait(1.0)
                if 'drive' not in person.stage:
                    continue
                # One that was switched off is looked for anew when somebody wants it.
                if person.press('/drive/enable').success:
                    raise Lost('it was let go too soon')
                person.wait(1.0)
            person.wait(0.05)

    def _enable(self) -> bool:
        answer = self.person.press('/drive/enable')
        if not answer.success:
            if 'zero' in answer.message:
                self.person.press('/drive/zero')
                self.person.wait(0.5)  # the observer starts anew
            return False
        with contextlib.suppress(Lost):
            self.person.until(lambda: self.report()['state'] == 'operation enabled', 1.0)
            return True
        return False

    def _is_in_place(self) -> bool:
        self.person.wait(0.02)
        report = self.report()
        away = max(abs(report['hip']), abs(report['lean'] - START[0]))
        return report['held'] and away < 2e-3

    def _stand(self) -> None:
        """Wait until it stands still."""
        still = 0
        deadline = time.monotonic() + 8.0
        while still < LOOKS:
            self.person.wait(LOOK)
            report = self.report()
            if report['state'] != 'operation enabled' or report['held']:
                raise Lost(f'the drive is {report["state"]}, the robot {self.person.stage}')
            if time.monotonic() > deadline:
                raise Lost(f'it leans by {report["lean"]:.3f} rad')
            still = still + 1 if abs(report['lean']) < UPRIGHT else 0

    def go_on(self) -> None:
        """Continue what was stopped."""
        for process in self.supervisor.processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)

    def close(self) -> None:
        """End what was started beside the nodes."""
        for process in self._helpers.values():
            process.kill()
            process.communicate()


def go_first(process: subprocess.Popen, priority: int) -> None:
    """Have a process, and what it starts from now on, go before all ordinary work."""
    os.sched_setscheduler(process.pid, os.SCHED_RR, os.sched_param(priority))


@contextlib.contextmanager
def rig(
    log: Path,
    seed: int = 1,
    first: bool = False,
    change: Callable[[dict[str, NodeOf]], None] = lambda nodes: None,
    begin: Callable[['Rig'], object] = lambda rig: None,
    words: tuple[str, ...] = (),
    rate: float = 500.0,
) -> Iterator[Rig]:
    """A robot that stands.

    Args:
        log: Gets what the nodes say, appended.
        seed: Of the emulated devices.
        change: Of the nodes, before they are started.
        begin: What else must be there for the robot to stand.
        words: More arguments of the emulation.
        first: Real-time priority, so that what others do on this machine hardly counts.
        rate: Of the robot's loop, in Hz.

    Raises:
        Lost: It does not stand.
    """
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix='cg_wires_')))
        log.parent.mkdir(parents=True, exist_ok=True)
        output: IO[str] = stack.enter_context(log.open('a'))
        stack.enter_context(own_domain())
        nodes = robot_nodes(replace(options_in(folder), rate=rate))
        change(nodes)
        state = *map(str, START), '0', '0'
        robot = Emulated(folder, '--state', *state, '--seed', str(seed), *words)
        # Not entered, only left: nodes must not inherit the priority that it gives its owner.
        stack.push(robot)
        supervisor = stack.enter_context(supervised(nodes, output))
        rclpy.init()
        stack.callback(rclpy.try_shutdown)
        person = Operator()
        stack.callback(person.node.destroy_node)
        it = Rig(robot, person, supervisor, nodes, log, first)
        stack.callback(it.close)
        stack.callback(it.go_on)
        person.until(lambda: person.stage.startswith('idle'))
        begin(it)
        it.bring_back()
        yield it


@contextlib.contextmanager
def load(processes: int) -> Iterator[None]:
    """So many processes that want a core all the time."""
    busy = [
        # In sessions of their own, among which processors are shared out.
        subprocess.Popen([sys.executable, '-c', 'while True: pass'], start_new_session=True)
        for _ in range(processes)
    ]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()
