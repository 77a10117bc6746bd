"""Faults on the live system, seen from the drive: kills, stops, floods, commands dated ahead.

    ./cg exec python bench/faults_live.py [--times 20] [--loads 0 10]      writes a table

The robot balances in real time across its processes, held by springs so that a machine too busy
for real time does not end a run. Each fault hits at a random instant. Times count on the clock of
the drive: from the first sample after the fault to the last one with torque.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import ExternalShutdownException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from sensor_msgs.msg import JointState

from cg_bringup.balance_run import BalanceOptions, balance_nodes
from cg_bringup.runs import NodeOf
from cg_bringup.supervisor import supervised
from cg_description.model_file import write_atomically
from cg_interfaces.domains import own_domain
from cg_interfaces.ros import MACHINE_QOS, SENSOR_QOS, to_nanoseconds, to_stamp
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.records.recover import recover

STALE = 0.02  # s, the watchdog
SAMPLE = 0.002  # s
HELD_UP = 0.5  # s that a stopped process stands still
PATIENCE = 30.0  # s until torque is back
TORQUE = 7.0  # N m of a command that must not act
GOOD = 0.5  # N m of one that must
AHEAD = {'15 ms': 0.015, '3 s': 3.0, '1 h': 3600.0}  # s
FLOOD = 1.0  # s
QUIET = 50  # samples without torque after which the gate has heard of a flood
TARGET = Path(__file__).resolve().parent / 'results/faults_live.md'


class Ear(Node):
    """Hears the drive, and can speak out of turn."""

    def __init__(self):
        super().__init__('ear')
        self.applied: list[tuple[int, float]] = []
        self.said: dict[str, str] = {}
        self.create_subscription(DiagnosticArray, '/diagnostics', self.on_diagnostics, 10)
        self.create_subscription(JointState, '/applied_torque', self.on_applied, MACHINE_QOS)
        self.executor_ = EventsExecutor()
        self.executor_.add_node(self)

    def on_applied(self, message: JointState) -> None:
        """Keep stamp and torque of a sample."""
        self.applied.append((to_nanoseconds(message.header.stamp), message.effort[0]))

    def on_diagnostics(self, message: DiagnosticArray) -> None:
        """Keep what each node said last."""
        self.said |= {status.name: status.message for status in message.status}

    def spin(self, seconds: float) -> None:
        """Listen for so long."""
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self.executor_.spin_once(timeout_sec=min(left, 0.02))

    def until(self, condition: Callable[[], bool], patience: float = PATIENCE) -> bool:
        """Listen until a condition holds; False if it never does."""
        end = time.monotonic() + patience
        while not condition():
            if time.monotonic() > end:
                return False
            self.executor_.spin_once(timeout_sec=0.01)
        return True

    def driven(self) -> bool:
        """True if most of the last samples have torque."""
        return sum(torque != 0.0 for _, torque in self.applied[-40:]) > 20


@dataclass
class Loop:
    """The processes of a live robot."""

    directory: Path
    ear: Ear
    nodes: dict[str, NodeOf]
    contexts: ExitStack
    processes: dict[str, subprocess.Popen] = field(default_factory=dict)
    rival: Any = None
    fresh: bool = True

    def sound(self, last: 'Outcome') -> bool:
        """Whether another fault can follow in this loop."""
        self.fresh, fresh = False, self.fresh
        return fresh or last.back is not None

    def begin(self, name: str) -> None:
        """Start one node, again if need be."""
        with (self.directory / 'log').open('a') as log:
            one = supervised({name: self.nodes[name]}, log)
            self.processes |= self.contexts.enter_context(one).processes


@contextmanager
def running(directory: Path, recorded: bool = False) -> Iterator[Loop]:
    """A robot that balances in a ROS domain of its own."""
    with own_domain():
        rclpy.init()
        ear = Ear()
        nodes = balance_nodes(BalanceOptions(stance='inner', lean=0.0))
        springs = load_experiment('spring_stabilised_inner').setup
        nodes['simulation_node'].parameters['setup'] = yaml.safe_dump(springs.to_dict())
        if recorded:
            bag = {'bag': str(directory / 'bag')}
            nodes = {'recorder': NodeOf('cg_sysid', 'recorder_node', bag)} | nodes
        contexts = ExitStack()
        loop = Loop(directory, ear, nodes, contexts)
        try:
            for name in nodes:
                loop.begin(name)
            if not ear.until(ear.driven, 60.0):
                raise RuntimeError((directory / 'log').read_text())
            yield loop
        finally:
            for process in loop.processes.values():
                if process.poll() is None:
                    process.send_signal(signal.SIGCONT)
            contexts.close()
            ear.destroy_node()
            rclpy.try_shutdown()


@contextmanager
def load(processes: int) -> Iterator[None]:
    """So many processes that want a core all the time."""
    busy = [subprocess.Popen([sys.executable, '-c', 'while True: pass']) for _ in range(processes)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


@dataclass
class Outcome:
    """What one fault did.

    Attributes:
        zero: Last torque after the fault, ms; None where torque should go on.
        back: Until torque was back after the cause had gone, s; None if it never was.
        highest: Largest torque after the fault that was nobody's to command, N m.
    """

    zero: float | None = None
    back: float | None = None
    highest: float = 0.0


def after(loop: Loop, since_ns: int) -> np.ndarray:
    """(stamp, torque) of what was latched after an instant."""
    return np.array([row for row in loop.ear.applied if row[0] > since_ns]).reshape(-1, 2)


def time_to_zero(loop: Loop, since_ns: int, length: float) -> float:
    """Ms after the fault of the last torque within `length` s."""
    end_ns = since_ns + round(length * 1e9)
    loop.ear.until(lambda: loop.ear.applied[-1][0] > end_ns)
    rows = after(loop, since_ns)
    rows = rows[rows[:, 0] <= end_ns]
    acting = rows[rows[:, 1] != 0.0]
    return (acting[-1, 0] - since_ns) * 1e-6 if len(acting) else 0.0


def back_after(loop: Loop) -> float | None:
    """S until most samples have torque again."""
    began, loop.ear.applied[:] = time.monotonic(), loop.ear.applied[-1:]
    if loop.ear.until(loop.ear.driven):
        return time.monotonic() - began
    print(f'no torque: {loop.ear.said}', flush=True)
    return None


def kill(loop: Loop, victim: str) -> Outcome:
    """SIGKILL, and a new process in its place."""
    loop.processes[victim].kill()
    now, zero = time.time_ns(), None
    if victim not in ('simulation_node', 'recorder'):
        zero = time_to_zero(loop, now, 0.3)
    loop.processes[victim].wait()
    back = back_after(loop) if victim == 'recorder' else None
    if victim == 'recorder':  # the loop goes on without it; what it wrote must come back
        parameters = loop.nodes['recorder'].parameters
        recover(Path(parameters['bag']))
        parameters['bag'] += '_'
    loop.begin(victim)
    if victim == 'recorder':
        loop.ear.until(lambda: Path(loop.nodes['recorder'].parameters['bag']).is_dir())
        loop.ear.spin(2.0)
    return Outcome(zero, back if victim == 'recorder' else back_after(loop))


def hold_up(loop: Loop, victim: str) -> Outcome:
    """SIGSTOP for a while, then SIGCONT."""
    loop.processes[victim].send_signal(signal.SIGSTOP)
    now, zero = time.time_ns(), None
    if victim in ('simulation_node', 'recorder'):
        loop.ear.spin(HELD_UP)
    else:
        zero = time_to_zero(loop, now, HELD_UP)
    loop.processes[victim].send_signal(signal.SIGCONT)
    return Outcome(zero, back_after(loop))


def dated_ahead(loop: Loop, topic: str, ahead: float) -> Outcome:
    """Nobody commands, one command is dated into the future, and then a good one comes."""
    silenced = 'balance' if topic == '/torque_request' else 'safety_gate'
    ear = loop.ear
    if loop.processes[silenced].poll() is None:
        loop.processes[silenced].kill()
        loop.processes[silenced].wait()
        loop.rival = ear.create_publisher(JointState, topic, SENSOR_QOS)
        ear.until(lambda: loop.rival.get_subscription_count() > 0)
        # The killed publisher has to be off the graph: with two there is no torque at all.
        ear.until(lambda: ear.count_publishers(topic) == 1)
        ear.spin(0.5)
    now = time.time_ns()
    command = JointState(name=['hip'], effort=[TORQUE])
    command.header.stamp = to_stamp(now + round(ahead * 1e9))
    loop.rival.publish(command)
    ear.spin(ahead + 0.2 if ahead < 10.0 else 0.5)
    highest = float(np.abs(after(loop, now)[:, 1]).max(initial=0.0))
    began = time.monotonic()
    command.effort = [GOOD]

    def good_acts() -> bool:
        command.header.stamp = to_stamp(ear.applied[-1][0])
        loop.rival.publish(command)
        ear.spin(0.002)
        return ear.applied[-1][1] == GOOD

    back = time.monotonic() - began if ear.until(good_acts, 5.0) else None
    ear.spin(0.1)
    return Outcome(None, back, highest)


def flood(loop: Loop, topic: str) -> Outcome:
    """A process publishes on a topic of the torque as fast as it can."""
    shouter = subprocess.Popen([sys.executable, __file__, '--shout', topic])
    loop.ear.until(lambda: loop.ear.count_publishers(topic) == 2)
    # The gate hears of it in its own time; until then the controller's torque acts.
    ear = loop.ear
    ear.until(lambda: not any(torque for _, torque in ear.applied[-QUIET:]), 5.0)
    now = loop.ear.applied[-1][0]
    loop.ear.spin(FLOOD)
    rows = after(loop, now)
    shouter.terminate()
    shouter.wait()
    return Outcome(None, back_after(loop), float(np.abs(rows[:, 1]).max(initial=0.0)))


def shout(topic: str) -> None:
    """The other end of `flood`."""
    rclpy.init()
    publisher = Node('shouter').create_publisher(JointState, topic, SENSOR_QOS)
    command = JointState(name=['hip'], effort=[TORQUE])
    try:
        while rclpy.ok():
            command.header.stamp = to_stamp(time.time_ns())
            publisher.publish(command)
    except (KeyboardInterrupt, ExternalShutdownException, RuntimeError):
        pass


VICTIMS = ('simulation_node', 'observer', 'balance', 'safety_gate', 'recorder')
TOPICS = {'/torque_request': 'in front of the gate', '/torque_command': 'behind the gate'}
FAULTS: dict[str, tuple[Callable[..., Outcome], tuple, bool]] = {
    **{f'{v} killed': (kill, (v,), v == 'recorder') for v in VICTIMS},
    **{f'{v} stopped for {HELD_UP:g} s': (hold_up, (v,), v == 'recorder') for v in VICTIMS},
    **{
        f'command {name} ahead, {where}': (dated_ahead, (topic, ahead), False)
        for topic, where in TOPICS.items()
        for name, ahead in AHEAD.items()
    },
    **{f'flood {where}': (flood, (topic,), False) for topic, where in TOPICS.items()},
}


def row_of(name: str, outcomes: list[Outcome]) -> str:
    """One line of the table."""
    zero = [o.zero for o in outcomes if o.zero is not None]
    back = [o.back for o in outcomes if o.back is not None]
    late = sum(z > 1e3 * (STALE + SAMPLE) for z in zero)
    cells = [
        name,
        str(len(outcomes)),
        f'{max(zero):.0f}' if zero else '',
        str(late) if zero else '',
        f'{max(o.highest for o in outcomes):g}' if 'command' in name or 'flood' in name else '',
        f'{np.median(back):.2f}' if back else '',
        f'{max(back):.2f}' if back else '',
        str(len(outcomes) - len(back)),
    ]
    return f'| {" | ".join(cells)} |'


def campaign(times: int, busy: int, rng: np.random.Generator) -> list[str]:
    """The rows of one load: each fault so many times, in one loop as long as it comes back."""
    rows = []
    for name, (fault, arguments, recorded) in FAULTS.items():
        outcomes: list[Outcome] = []
        while len(outcomes) < times:
            with tempfile.TemporaryDirectory() as folder, running(Path(folder), recorded) as loop:
                with load(busy):
                    # A loop that did not come back is not worth another fault.
                    while len(outcomes) < times and (not outcomes or loop.sound(outcomes[-1])):
                        loop.ear.spin(rng.uniform(0.2, 0.5))
                        outcomes.append(fault(loop, *arguments))
        rows.append(row_of(name, outcomes))
        print(rows[-1], flush=True)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        '--times', type=int, nargs='*', default=[20], help='of each fault, one number a load [20]'
    )
    parser.add_argument('--loads', type=int, nargs='*', default=[0, 10], help='[0 10]')
    parser.add_argument('--faults', default='', help='only those whose names hold this')
    parser.add_argument('--shout', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.shout:
        shout(options.shout)
        return
    for name in list(FAULTS):
        if options.faults not in name:
            del FAULTS[name]
    times = options.times * len(options.loads) if len(options.times) == 1 else options.times
    asked = f'--loads {" ".join(map(str, options.loads))} --times {" ".join(map(str, times))}'
    lines = [
        '# Faults on the live system, seen from the drive',
        '',
        f'`python bench/faults_live.py {asked}`: real time, 500 Hz, each node a process, '
        f'{os.cpu_count()} cores.',
        f'The watchdog is {STALE * 1e3:g} ms, to which one sample of {SAMPLE * 1e3:g} ms comes.',
        '"Last torque" is the worst instant, after the fault, of a sample with torque; "late"',
        'counts those beyond the watchdog. "Wrong torque" is the largest that acted while nobody',
        'was entitled to any. "Back" is until most samples have torque again: after a kill this',
        'is the start of a new process and what DDS takes to give up the old one (5 s); after a',
        'command dated ahead it is until a good one acts.',
    ]
    for busy, count in zip(options.loads, times, strict=True):
        print(f'load {busy}', flush=True)
        rows = campaign(count, busy, np.random.default_rng(busy))
        lines += [
            '',
            f'## {busy} busy processes beside it',
            '',
            '| fault | times | last torque, ms | late | wrong torque, N m | back, median s '
            '| worst | never |',
            '|---|---:|---:|---:|---:|---:|---:|---:|',
            *rows,
        ]
        if not options.faults:
            write_atomically(TARGET, '\n'.join(lines) + '\n')


if __name__ == '__main__':
    main()
