"""Where the time goes between a sample and the torque that answers it, on wires and simulated.

    ./cg exec python bench/wires_latency.py [--seconds 60] [--first] [--write]

A robot stands at 500 Hz and is pushed a little every 5 s: first on wires, with emulated devices in
another process, then by the simulation node, with the same observer, controller and gate. Each
stage ends with an instant of its own:

    sample taken   the device's own clock (trace of the emulation)
    on the line    its bytes are written (trace)
    /imu, /state, request, /torque_command
                   their publisher writes them: the source timestamp that DDS puts on each
    PDO, SYNC      they come to the emulated drive (trace); simulated: /applied_torque is written

No node is touched. A listener in the process of this bench takes the messages from the middleware
some times a second, so that it wakes nobody; that they were sent is what counts, not when they are
read. A torque is known by its value: it is that of the newest command of this value which had been
sent. Cycles for which two commands in a row ask for the same are no part of ages, as nobody can
tell one from the other.

`--first` gives nodes and devices real-time priority, for a host that has other work.
"""

import argparse
import bisect
import itertools
import math
import os
import struct
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Imu, JointState
from wires_rig import DEVICES, NODES, ROOT, START, Lost, go_first, rig
from wires_rivals import REQUESTED

from cg_bringup.balance_run import MACHINE, BalanceOptions, balance_nodes
from cg_bringup.supervisor import supervised
from cg_description.model_file import write_atomically
from cg_hardware.imu_node import ImuSettings
from cg_interfaces import topics
from cg_interfaces.domains import own_domain

TABLE = ROOT / 'bench/results/wires_latency.md'
LOG = ROOT / 'build/wires_latency.log'
TRACE = ROOT / 'build/wires_latency.trace'
EPSILON = 0.02  # s, of the observer, on wires as simulated
SETTLED = 5.0  # s that it has stood before anything counts
PUSHED, PUSH = 5.0, 0.2  # s from one push to the next, N s
STANDS = 0.1  # rad of lean
TRIES = 5
LISTENER = 5  # real-time priority, behind all nodes
READ = 0.02  # s from one look of the listener to the next
DEPTH = 2000  # messages, 4 s, that may wait for the listener
PATIENCE = 60.0  # s for messages to come
STAMP = struct.Struct('<iI')
HEADER = 4  # bytes before the stamp of a message
PERIOD = 0.002  # s
LOST = 0.05  # s after which a command cannot act any more
PER_MILLE = 25.0  # per mille of the drive's rated torque in 1 N m
AIM = 0.2  # ms: jitter of the stamps
QUANTILES = (0.5, 0.95, 0.999, 1.0)


class Heard(NamedTuple):
    """One message: its stamp, when it was sent (ns), its number, its bytes."""

    stamp: int
    sent: int
    number: int
    data: bytes


class Listener:
    """Takes messages off their topics without an executor.

    Args:
        kinds: Topic -> type.
    """

    def __init__(self, kinds: dict[str, type]):
        self.node = Node('listener', start_parameter_services=False, enable_rosout=False)
        qos = QoSProfile(depth=DEPTH, reliability=ReliabilityPolicy.RELIABLE)
        self._subscriptions = [
            self.node.create_subscription(kind, topic, lambda message: None, qos, raw=True)
            for topic, kind in kinds.items()
        ]
        self.heard: dict[str, list[Heard]] = {topic: [] for topic in kinds}

    def read(self) -> None:
        """Take what has come."""
        for subscription, heard in zip(self._subscriptions, self.heard.values(), strict=True):
            with subscription.handle:
                while taken := subscription.handle.take_message(subscription.msg_type, True):
                    data, info = taken
                    seconds, rest = STAMP.unpack_from(data, HEADER)
                    heard.append(Heard(
                        seconds * 10**9 + rest, info['source_timestamp'],
                        info['publication_sequence_number'], data,
                    ))  # fmt: skip

    def forget(self) -> None:
        """Begin anew."""
        self.read()
        for heard in self.heard.values():
            heard.clear()

    def unheard(self) -> int:
        """Messages that were sent meanwhile and did not come here."""
        spans = (h[-1].number - h[0].number + 1 - len(h) for h in self.heard.values() if h)
        return sum(spans)


@dataclass
class Loop:
    """One run.

    Attributes:
        stages: Name of a stage -> how long it took, ms.
        ages: Of the measurements behind the torque of each cycle of the drive, ms.
        cycles: Of the drive.
        stale: Those without a newer command than the cycle before.
        alike: Those whose command cannot be told from the one before it.
        lost: Samples that no /imu told of.
        unheard: Messages that the listener missed.
        errors: Stamps of samples less their instants, ms.
    """

    stages: dict[str, np.ndarray]
    ages: np.ndarray
    cycles: int
    stale: int
    alike: int
    lost: int
    unheard: int
    errors: np.ndarray = field(default_factory=lambda: np.zeros(0))


class Acting(NamedTuple):
    """A cycle of the drive, the command that acts in it (None: nobody's), whether that is sure."""

    at: int
    command: Heard | None
    sure: bool


def acting(
    cycles: Sequence[tuple[int, float]], commands: Sequence[Heard], values: Sequence[float]
) -> Iterator[Acting]:
    """Which command acts in each cycle: the newest of the same torque that had been sent.

    Args:
        cycles: Instants in ns and torques.
        commands: In the order in which they were sent.
        values: What they ask for, as the drive tells torques.
    """
    sent = [command.sent for command in commands]
    oldest = 0
    for at, torque in cycles:
        newest = bisect.bisect_right(sent, at) - 1
        k = newest
        while k >= oldest and at - sent[k] < LOST * 1e9 and values[k] != torque:
            k -= 1
        if k < oldest or at - sent[k] >= LOST * 1e9:
            yield Acting(at, None, True)
            continue
        alike = k > oldest and values[k - 1] == torque
        oldest = k
        yield Acting(at, commands[k], not alike)


def firsts(heard: Sequence[Heard]) -> dict[int, int]:
    """Stamp -> when the first message of it was sent."""
    return {h.stamp: h.sent for h in reversed(heard)}


def torque_of(message: Heard) -> float:
    """What a command asks for, N m."""
    return deserialize_message(message.data, JointState).effort[0]


def budget(
    marks: dict[str, dict[int, int]], cycles: list[Acting], instants: dict[int, int],
    told: tuple[int, int],
) -> Loop:  # fmt: skip
    """Stages and ages.

    Args:
        marks: End of a stage -> stamp -> instant in ns, in the order of the loop.
        cycles: Of the drive.
        instants: Stamp -> when the sample was taken.
        told: Lost samples, messages unheard.
    """
    stages: dict[str, np.ndarray] = {}
    before = instants
    for name, after in marks.items():
        both = [(after[s] - before[s]) * 1e-6 for s in instants if s in after and s in before]
        stages[name], before = np.array(both), after
    known = [c for c in cycles if c.sure and c.command and c.command.stamp in instants]
    acts: dict[int, int] = {}
    for cycle in known:
        assert cycle.command is not None
        acts.setdefault(cycle.command.stamp, cycle.at)
    stages[ACTS] = np.array([(at - before[s]) * 1e-6 for s, at in acts.items() if s in before])
    stale = sum(b.command in (None, a.command) for a, b in itertools.pairwise(cycles))
    ages = [(c.at - instants[c.command.stamp]) * 1e-6 for c in known if c.command]
    alike = sum(not c.sure for c in cycles)
    return Loop(stages, np.array(ages), len(cycles), stale, alike, *told)


# The two loops

LINE, STAMPED = 'sample taken to its bytes on the line', 'bytes to /imu, stamped'
ANSWERS = {
    '/imu to /state': topics.STATE, '/state to the request': REQUESTED,
    'request to /torque_command': topics.TORQUE_COMMAND,
}  # fmt: skip
ACTS = '/torque_command to the SYNC at which it acts'


def trace_of(path: Path) -> tuple[list[list[int]], list[float], list[tuple[int, float]]]:
    """Samples (instant, on the line), their pitch, cycles (SYNC, torque of the PDO before it)."""
    samples, pitches, cycles, asked = [], [], [], math.nan
    for line in path.read_text().splitlines():
        kind, *numbers = line.split()
        if kind == 'sample' and len(numbers) == 3:
            samples.append([int(numbers[0]), int(numbers[1])])
            pitches.append(float(np.float32(numbers[2])))
        elif kind == 'command' and len(numbers) == 2:
            asked = float(numbers[1])
        elif kind == 'sync' and len(numbers) == 2:
            cycles.append((int(numbers[0]), asked))
            asked = math.nan  # a SYNC without its PDO acts on nothing new
    return samples, pitches, cycles


def latest(path: Path) -> int:
    """Instant of the last whole line of a trace, ns; it is written in blocks."""
    with path.open('rb') as file:
        file.seek(max(0, path.stat().st_size - 500))
        words = file.read().decode().split('\n')[-2].split()
    return int(words[1]) if len(words) > 1 else 0


def on_wires(seconds: float, first: bool, seed: int) -> Loop:
    """Of a robot on its wires."""
    kinds = {
        topics.IMU: Imu, topics.STATE: JointState, REQUESTED: JointState,
        topics.TORQUE_COMMAND: JointState,
    }  # fmt: skip
    with rig(LOG, seed, first, words=('--trace', str(TRACE))) as it:
        listener = Listener(kinds)
        listen_first(first)

        def wait(length: float) -> None:
            end = time.monotonic() + length
            while time.monotonic() < end:
                it.person.wait(min(READ, max(0.0, end - time.monotonic())))
                listener.read()

        wait(SETTLED)
        listener.forget()
        it.report()
        begin = time.time_ns()
        for k in range(math.ceil(seconds / PUSHED)):
            it.robot.ask(f'push {PUSH if k % 2 else -PUSH}')
            wait(min(PUSHED, seconds - k * PUSHED))
        end = time.time_ns()
        report = it.report()
        if report['state'] != 'operation enabled' or abs(report['lean']) > STANDS:
            raise Lost(f'the drive is {report["state"]}, the robot {it.person.stage}')
        print(f'wires: held up by {1e3 * report["late"]:.1f} ms at most', flush=True)
        it.person.until(lambda: latest(TRACE) > end)
        listener.read()
        listener.node.destroy_node()
    samples, pitches, cycles = trace_of(TRACE)
    return of_the_wires(listener, samples, pitches, cycles, (begin, end))


def of_the_wires(
    listener: Listener, samples: list[list[int]], pitches: list[float],
    cycles: list[tuple[int, float]], span: tuple[int, int],
) -> Loop:  # fmt: skip
    """Trace and messages, put together."""
    heard, (begin, end) = listener.heard, span
    by_pitch: dict[float, list[int]] = {}
    for k, pitch in enumerate(pitches):
        by_pitch.setdefault(pitch, []).append(k)
    instants, lines, found = {}, {}, set()
    for message in heard[topics.IMU]:
        orientation = deserialize_message(message.data, Imu).orientation
        pitch = float(np.float32(2.0 * math.atan2(orientation.y, orientation.w)))
        near = [k for k in by_pitch.get(pitch, ()) if abs(samples[k][0] - message.stamp) < 25e6]
        if len(near) != 1:
            continue  # two samples of one angle within 50 ms
        found.add(near[0])
        if begin <= samples[near[0]][0] < end:
            instants[message.stamp], lines[message.stamp] = samples[near[0]]
    inside = [k for k, (at, _) in enumerate(samples) if begin <= at < end]
    lost = sum(1 for k in inside if k not in found)
    marks = {LINE: lines, STAMPED: firsts(heard[topics.IMU])}
    marks |= {name: firsts(heard[topic]) for name, topic in ANSWERS.items()}
    commands = heard[topics.TORQUE_COMMAND]
    values = [float(round(PER_MILLE * torque_of(c))) for c in commands]
    acted = [c for c in acting(cycles, commands, values) if begin <= c.at < end]
    loop = budget(marks, acted, instants, (lost, listener.unheard()))
    loop.errors = np.array([(stamp - at) * 1e-6 for stamp, at in instants.items()])
    return loop


def simulated(seconds: float, first: bool, seed: int) -> Loop:
    """Of the simulation node."""
    asked = topics.TORQUE_REQUEST
    kinds = {
        topics.IMU: Imu, topics.STATE: JointState, asked: JointState,
        topics.TORQUE_COMMAND: JointState, topics.APPLIED_TORQUE: JointState,
    }  # fmt: skip
    instants = np.arange(SETTLED, SETTLED + seconds, PUSHED)
    pushes = [x for k, t in enumerate(instants) for x in (t, PUSH if k % 2 else -PUSH)]
    options = BalanceOptions(lean=START[0], seed=seed, pushes=pushes, epsilon=EPSILON)
    with LOG.open('a') as log, own_domain(), supervised(balance_nodes(options), log) as nodes:
        for name, process in nodes.processes.items() if first else ():
            go_first(process, DEVICES if name == MACHINE else NODES)
        rclpy.init()
        try:
            listener = Listener(kinds)
            listen_first(first)
            applied = listener.heard[topics.APPLIED_TORQUE]

            def until(condition: Callable[[], Any], patience: float) -> None:
                deadline = time.monotonic() + patience
                while not condition():
                    nodes.stop.check()
                    if nodes.processes[MACHINE].poll() is not None:
                        raise Lost('the simulated robot fell')
                    if time.monotonic() > deadline:
                        raise Lost('the simulated robot says nothing')
                    time.sleep(READ)
                    listener.read()

            until(lambda: applied, PATIENCE)
            begin = applied[0].stamp + round(SETTLED * 1e9)
            end = begin + round(seconds * 1e9)
            until(lambda: applied[-1].stamp > end, seconds + PATIENCE)
            listener.node.destroy_node()
        finally:
            rclpy.try_shutdown()
    heard = listener.heard
    taken = {h.stamp: h.stamp for h in heard[topics.IMU] if begin <= h.stamp < end}
    marks = {STAMPED: firsts(heard[topics.IMU])}
    marks |= {
        name: firsts(heard[asked if topic == REQUESTED else topic])
        for name, topic in ANSWERS.items()
    }  # fmt: skip
    commands = heard[topics.TORQUE_COMMAND]
    cycles = [(h.sent, torque_of(h)) for h in applied]
    values = [torque_of(c) for c in commands]
    acted = [c for c in acting(cycles, commands, values) if begin <= c.at < end]
    lost = round(seconds / PERIOD) - len(taken)
    return budget(marks, acted, taken, (lost, listener.unheard()))


def lasting(run: Callable[..., Loop], *asked: Any) -> tuple[Loop, int]:
    """The first run to whose end the robot stands, and how many were thrown away."""
    priority = os.sched_getscheduler(0), os.sched_getparam(0)
    for fallen in itertools.count():
        try:
            return run(*asked), fallen
        except Lost as lost:
            print(f'once more: {lost}', flush=True)
            if fallen == TRIES:
                raise SystemExit('it does not stand as long') from lost
        finally:
            os.sched_setscheduler(0, *priority)  # nodes must not inherit the listener's
    raise AssertionError('endless')


def listen_first(first: bool) -> None:
    """The listener comes before ordinary work as well, but after all nodes."""
    if first:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(LISTENER))


# Tables


def quantiles(values: np.ndarray) -> list[float]:
    """QUANTILES, of which the last is the largest."""
    return [float(x) for x in np.quantile(values, QUANTILES)] if len(values) else []


def cells(values: list[float], form: str) -> list[str]:
    """One for each quantile, empty where there are none."""
    return [format(x, form) for x in values] or [''] * len(QUANTILES)


def tables(wires: Loop, machine: Loop) -> Iterator[str]:
    """The budget, the drive, the stamps."""
    heads = 'median', '95 %', '99.9 %', 'max'
    kinds = 'wires', 'simulated', 'ratio'
    titles = [f'{kind}: {head}' if not k else head for kind in kinds
              for k, head in enumerate(heads)]  # fmt: skip
    yield f'| stage, ms | {" | ".join(titles)} |'
    yield f'|---|{"---:|" * len(titles)}'
    rows = {name: (values, machine.stages.get(name)) for name, values in wires.stages.items()}
    rows['**age of the measurement at each SYNC**'] = wires.ages, machine.ages
    for name, (ours, theirs) in rows.items():
        a, b = quantiles(ours), quantiles(np.zeros(0) if theirs is None else theirs)
        ratio = [x / y for x, y in zip(a, b, strict=False)] if b and min(b) > 0 else []
        row = cells(a, '.2f') + cells(b, '.2f') + cells(ratio, '.1f')
        yield f'| {name} | {" | ".join(row)} |'
    yield from ('', '| | wires | simulated |', '|---|---:|---:|')
    for name, value in (
        ('cycles of the drive', lambda x: x.cycles),
        ('without a newer command than the one before',
         lambda x: f'{100 * x.stale / x.cycles:.2f} %'),
        ('left out of the ages, as two commands are alike',
         lambda x: f'{100 * x.alike / x.cycles:.2f} %'),
        ('samples that no /imu told of', lambda x: x.lost),
        ('messages that the listener missed', lambda x: x.unheard),
    ):  # fmt: skip
        yield f'| {name} | {value(wires)} | {value(machine)} |'
    away = np.abs(wires.errors - np.median(wires.errors))
    spread = ', '.join(f'{x:.3f}' for x in quantiles(away))
    holds = np.mean(away < AIM)
    yield from (
        '',
        f'Stamps of /imu on wires are {np.median(wires.errors):+.3f} ms from the instants of '
        f'their samples in the median. From there they are away by (median, 95 %, 99.9 %, max) '
        f'{spread} ms, standard deviation {np.std(wires.errors):.3f} ms; {100 * holds:.2f} % '
        f'are within the {AIM:g} ms that are aimed at. The node takes off the time of the bytes '
        f'on a line of 921600 bit/s, {1e3 * ImuSettings().wire_s:.3f} ms; a pseudo-terminal needs '
        'none. Stamps of the simulated robot are exact.',
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--seconds', type=float, default=60.0, help='of each robot [60]')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--first', action='store_true', help='with real-time priority')
    parser.add_argument('--write', action='store_true', help='store the table')
    options = parser.parse_args()
    load = os.getloadavg()[0]
    LOG.parent.mkdir(parents=True, exist_ok=True)
    asked = options.seconds, options.first, options.seed
    (wires, fallen), (machine, fallen_too) = lasting(on_wires, *asked), lasting(simulated, *asked)
    words = f'--seconds {options.seconds:g}{" --first" * options.first} --write'
    text = '\n'.join([
        '# Latency of the loop, on wires and simulated', '',
        f'Command: `./cg exec python bench/wires_latency.py {words}`. 500 Hz, {options.seconds:g} '
        f's each, {os.cpu_count()} cores, load at the start {load:.1f}'
        f'{", robot with real-time priority" * options.first}. On wires: emulated devices in '
        'another process, IMU on a pseudo-terminal, drive on a serial CAN adapter. A message is '
        'at the instant at which its publisher wrote it. Runs thrown away, as the robot did not '
        f'stand to their end: {fallen} on wires, {fallen_too} simulated.', '',
        *tables(wires, machine), '',
    ])  # fmt: skip
    print(text)
    if options.write:
        write_atomically(TABLE, text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
