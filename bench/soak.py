"""A robot that stands for long: whether nodes grow, samples get lost, and it stands all the time.

    ./cg exec python bench/soak.py [--lockstep-minutes 60] [--wires-minutes 15] [--first] [--write]
    ./cg exec python bench/soak.py --minutes 1        both, shorter; 0 leaves one out

Each has its own page, bench/results/soak_lockstep.md and soak_wires.md.

Lock-step: simulation node, observer, controller, gate and recorder go as fast as they can, 500
samples in each simulated second. On wires: the same above emulated devices, in real time. A push
comes every 30 s.

Memory (resident), threads and files of each process are read from /proc. What counts for memory is
its growth in the second half, when all that is filled once is full. Of samples, what the machine
has taken is compared with what is in the bag: in lock-step by their number, on wires by the trace
that the emulation writes of its samples and SYNCs. An answer of the drive that takes longer than
2.8 ms is left out by its node, and missing here. A robot that falls is brought back, and the fall
told. `--first` gives robot and devices on wires real-time priority, for a host with other work.
"""

import argparse
import contextlib
import math
import os
import sys
import tempfile
import time
from array import array
from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rosbags.highlevel import AnyReader
from wires_latency import STAMP, latest, trace_of
from wires_rig import ROOT, Lost, rig

from cg_bringup.balance_run import (
    MACHINE,
    BalanceOptions,
    balance_nodes,
    verdict_of,
    with_outcome,
)
from cg_bringup.runs import NodeOf
from cg_bringup.supervisor import supervised
from cg_bringup.verdict import balance_verdict
from cg_description.model_file import write_atomically
from cg_interfaces import topics
from cg_interfaces.domains import own_domain

RESULTS = ROOT / 'bench/results'
LOG = ROOT / 'build/soak.log'
RATE, PERIOD_NS = 500, 2_000_000
PUSHED, PUSH = 30.0, 0.2  # s from one push to the next, N s
STANDS = 0.15  # rad of lean; a push leans it by less than half of that
LOOKS = 400  # at the processes, in a run
CLOSING = 1800.0  # s that the recorder may take to close an hour
WARM = 0.1  # of a run, in which caches and queues fill
GROWTH = 1.0  # MB in the second half; of 15 min that is 5 bytes a sample, less than any object
PATIENCE = 60.0  # s for the next sign of life
HEADER = 4  # bytes before the stamp of a message
ALSO = [f'{topics.STATE}:sensor_msgs/msg/JointState']
# What nodes complain of on /diagnostics.
COMPLAINTS = {
    'imu': ('bad', 'repeated'),
    'drive': ('commands_in_doubt', 'cycles_left_out'),
    'observer': ('withheld', 'restarts', 'samples_out_of_order'),
    'safety_gate': ('requests_in_doubt',),
    MACHINE: ('commands_in_doubt',),
}


@dataclass
class Processes:
    """Memory, threads and files of processes, over time.

    Attributes:
        pids: Name -> process.
        looks: Name -> rows of (s, MB, threads, files).
    """

    pids: dict[str, int]
    looks: dict[str, list[tuple[float, float, int, int]]] = field(default_factory=dict)

    def look(self, seconds: float) -> None:
        """Look at all of them now."""
        for name, pid in self.pids.items():
            with contextlib.suppress(OSError):  # one that has ended
                lines = Path(f'/proc/{pid}/status').read_text().splitlines()
                said = dict(line.split(':', 1) for line in lines)
                if 'VmRSS' not in said:
                    continue
                files = len(os.listdir(f'/proc/{pid}/fd'))
                megabytes = int(said['VmRSS'].split()[0]) / 1024
                row = seconds, megabytes, int(said['Threads']), files
                self.looks.setdefault(name, []).append(row)


@dataclass
class Run:
    """What came of one.

    Attributes:
        name: For people.
        seconds: Of the robot.
        took: The same by the clock on the wall.
        stood: Whether it stood all the time.
        line: How it fared, in words.
        processes: See there.
        samples: Topic -> in the bag, missing there, out of order.
        remarks: Of the bag about itself.
        size: Of the bag in MB.
        complaints: Of nodes, by name, and how often.
    """

    name: str
    seconds: float
    took: float
    stood: bool
    line: str
    processes: Processes
    samples: dict[str, tuple[int, int, int]]
    remarks: dict[str, str]
    size: float
    complaints: Counter[str]


class Complaints:
    """Adds up what nodes say on /diagnostics, once for each time that they say it."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._seen: dict[str, float] = {}

    def hear(self, name: str, at: float, values: dict[str, str]) -> None:
        """One status, which came at an instant."""
        if self._seen.get(name) == at:
            return
        self._seen[name] = at
        for key in COMPLAINTS.get(name, ()):
            if count := int(values.get(key, 0)):
                self.counts[f'{name}: {key}'] += count


def tell(name: str, now: float, seconds: float, more: str = '') -> None:
    """How far it is, always in the same line."""
    minutes = f'{now / 60:.1f} of {seconds / 60:.1f} min'
    print(f'\r{name}: {minutes}, {more}'.ljust(78), end='', file=sys.stderr, flush=True)


def recorder_of(bag: Path, by: str) -> NodeOf:
    """The recorder."""
    settings = {'bag': str(bag), 'mechanism': 'compass_gait', 'time': by, 'also': ALSO}
    return NodeOf('cg_sysid', 'recorder_node', settings, ending=CLOSING)


# Lock-step


def lockstep(seconds: float, folder: Path) -> Run:
    """As fast as five processes go."""
    bag, outcome = folder / 'lockstep', folder / 'outcome.json'
    instants = np.arange(PUSHED, seconds - 5.0, PUSHED)
    pushes = [float(x) for k, t in enumerate(instants) for x in (t, PUSH if k % 2 else -PUSH)]
    options = BalanceOptions(mode='lockstep', duration=seconds, pushes=pushes)
    nodes = with_outcome(balance_nodes(options), outcome)
    nodes[MACHINE].parameters['recorders'] = 1
    nodes['recorder'] = recorder_of(bag, 'stamp')
    complaints, reached = Complaints(), [0]

    def on_diagnostics(message: DiagnosticArray) -> None:
        for status in message.status:
            values = {pair.key: pair.value for pair in status.values}
            complaints.hear(status.name, time.monotonic(), values)
            if status.name == MACHINE:
                reached[0] = int(values.get('samples', reached[0]))

    began = time.monotonic()
    with LOG.open('a') as log, own_domain(), supervised(nodes, log) as supervisor:
        processes = Processes({n: p.pid for n, p in supervisor.processes.items()})
        rclpy.init()
        try:
            node = Node('listener', start_parameter_services=False, enable_rosout=False)
            node.create_subscription(DiagnosticArray, topics.DIAGNOSTICS, on_diagnostics, 50)
            executor = SingleThreadedExecutor()
            executor.add_node(node)
            machine = supervisor.processes[MACHINE]
            told, alive, step = -1.0, time.monotonic(), seconds / LOOKS
            while machine.poll() is None:
                supervisor.stop.check()
                executor.spin_once(timeout_sec=0.2)
                now = reached[0] / RATE
                if now >= told + step:
                    told, alive = now, time.monotonic()
                    processes.look(now)
                    pace = now / max(1e-3, alive - began)
                    tell('lock-step', now, seconds, f'{pace:.2f} times real time')
                if time.monotonic() - alive > PATIENCE + step:
                    raise SystemExit('the machine in lock-step has come to a stop')
            took = time.monotonic() - began
            tell('lock-step', seconds, seconds, 'the recorder closes its bag')
            node.destroy_node()
        finally:
            rclpy.try_shutdown()
    verdict = verdict_of(outcome, lambda o: balance_verdict(o, pushes))
    stamps, remarks, size = contents(bag)
    expected = round(seconds * RATE)
    samples = {
        topic: (len(own), expected - len(set(own)), disorder(own)) for topic, own in stamps.items()
    }
    return Run(
        'lock-step', seconds, took, verdict.worked, verdict.line, processes, samples, remarks,
        size, complaints.counts,
    )  # fmt: skip


# On wires


def on_wires(seconds: float, folder: Path, first: bool) -> Run:
    """In real time, devices emulated."""
    bag, trace, complaints = folder / 'wires', folder / 'trace', Complaints()

    def change(nodes: dict[str, NodeOf]) -> None:
        nodes['recorder'] = recorder_of(bag, 'receipt')

    with rig(LOG, first=first, change=change, words=('--trace', str(trace))) as it:
        pids = {name: process.pid for name, process in it.supervisor.processes.items()}
        processes = Processes(pids | {'(emulated devices)': it.robot.process.pid})
        begin_ns, began = time.time_ns(), time.monotonic()
        now, pushes, told, largest = 0.0, 0, -math.inf, 0.0
        falls: list[str] = []
        while now < seconds:
            it.person.wait(0.25)  # diagnostics come once a second
            now = time.monotonic() - began
            for name, (at, _, values) in it.person.said.items():
                complaints.hear(name, at, values)
            report = it.report()
            if report['state'] != 'operation enabled' or abs(report['lean']) > STANDS:
                it.person.wait(1.2)  # until the drive has said why
                falls.append(f'at {now:.0f} s ({it.person.said["drive"][1]})')
                try:
                    it.bring_back()
                except Lost as lost:
                    falls.append(f'not brought back: {lost}')
                    break
                continue
            largest = max(largest, abs(report['lean']))
            if now > (pushes + 1) * PUSHED:
                pushes += 1
                it.robot.ask(f'push {PUSH if pushes % 2 else -PUSH}')
            if now >= told + seconds / LOOKS:
                told = now
                processes.look(now)
                tell('wires', now, seconds, f'{len(falls)} falls, {largest:.3f} rad at most')
        end_ns = time.time_ns()
        tell('wires', now, seconds, 'the recorder closes its bag')
        it.person.until(lambda: latest(trace) > end_ns)
    line = f'{pushes} pushes, leant by {largest:.3f} rad at most, '
    line += f'fell {len(falls)} times: {", ".join(falls)}' if falls else 'stood throughout'
    stamps, remarks, size = contents(bag)
    taken, _, cycles = trace_of(trace)
    instants = {
        topics.IMU: [at for at, _ in taken], topics.HIP_ENCODER: [at for at, _ in cycles],
    }  # fmt: skip
    samples = {}
    for topic, own in stamps.items():
        if topic == topics.DRIVE_ENABLED:
            continue  # comes when it changes
        a, b = bisect_left(own, begin_ns), bisect_left(own, end_ns)
        source = instants[topics.IMU if topic in (topics.IMU, *ANSWERS) else topics.HIP_ENCODER]
        begin, end = own[a], own[min(b, len(own) - 1)]
        expected = bisect_left(source, end) - bisect_left(source, begin)
        inside = own[a:b]
        samples[topic] = len(inside), expected - len(set(inside)), disorder(inside)
    return Run(
        'wires', now, now, not falls, line, processes, samples, remarks, size, complaints.counts
    )


ANSWERS = topics.STATE, topics.TORQUE_COMMAND  # they carry the stamp of the IMU


# The bag


def contents(bag: Path) -> tuple[dict[str, array], dict[str, str], float]:
    """Stamps by topic in ns, what the bag says of itself, its size in MB."""
    stamps: dict[str, array] = {}
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            if connection.topic != topics.EXPERIMENT:
                seconds, rest = STAMP.unpack_from(data, HEADER)
                stamps.setdefault(connection.topic, array('q')).append(seconds * 10**9 + rest)
    information = yaml.safe_load((bag / 'metadata.yaml').read_text())
    remarks = information['rosbag2_bagfile_information']['custom_data'] or {}
    size = sum(file.stat().st_size for file in bag.iterdir()) / 1e6
    return dict(sorted(stamps.items())), remarks, size


def disorder(stamps: array) -> int:
    """Stamps that are not after the one before."""
    return int(np.sum(np.diff(np.array(stamps)) <= 0))


# Tables


def slope(rows: np.ndarray) -> float:
    """Of memory in MB/h, by least squares, in the second half."""
    second = rows[rows[:, 0] >= rows[-1, 0] / 2]
    if len(second) < 3:
        return math.nan
    return float(3600 * np.polyfit(second[:, 0], second[:, 1], 1)[0])


def page(run: Run, words: str) -> str:
    """Of one run, and of the words of the command that repeats it."""
    return '\n'.join([
        '# A robot that stands for long', '',
        f'Command: `./cg exec python bench/soak.py {words} --write`. '
        f'{os.cpu_count()} cores. Memory is resident, start is after {100 * WARM:.0f} % of the '
        f'run; it grows where the end has {GROWTH:g} MB more than the middle.',
        *tables(run), '',
    ])  # fmt: skip


def tables(run: Run) -> Iterator[str]:
    """Of one run."""
    pace = f' in {run.took / 60:.1f} min' if run.name == 'lock-step' else ''
    yield from (
        '', f'## {run.name.capitalize()}: {run.seconds / 60:.1f} min{pace}', '',
        f'{run.line[0].upper()}{run.line[1:]}. Bag of {run.size:.0f} MB; nodes complain of: '
        f'{", ".join(f"{k} {n}" for k, n in sorted(run.complaints.items())) or "nothing"}.', '',
        '| process | MB at the start | middle | end | MB/h in the second half | threads: start, '
        'end | files: start, end | |', '|---|---:|---:|---:|---:|---:|---:|---|',
    )  # fmt: skip
    for name, looks in run.processes.looks.items():
        rows = np.array(looks)
        start, middle, end = states(rows)
        told = ', '.join(growth(rows)) or 'does not grow'
        yield (
            f'| {name} | {start[1]:.1f} | {middle[1]:.1f} | {end[1]:.1f} | {slope(rows):+.2f} | '
            f'{start[2]:.0f}, {end[2]:.0f} | {start[3]:.0f}, {end[3]:.0f} | {told} |'
        )
    yield from ('', '| topic | in the bag | missing | out of order |', '|---|---:|---:|---:|')
    for topic, (count, missing, wrong) in run.samples.items():
        yield f'| {topic} | {count} | {missing} | {wrong} |'
    remarks = '; '.join(f'{key} {value}' for key, value in sorted(run.remarks.items()))
    yield from ('', f'The bag says of itself: {remarks or "nothing"}.')


def states(rows: np.ndarray) -> Iterator[np.ndarray]:
    """Of a process, once it is warm, in the middle, at the end: medians of a tenth of a run."""
    length = rows[-1, 0]
    for share in (WARM, 0.5, 1.0 - WARM):
        part = rows[(rows[:, 0] >= share * length) & (rows[:, 0] <= (share + WARM) * length)]
        yield np.median(part if len(part) else rows[-1:], axis=0)


def growth(rows: np.ndarray) -> Iterator[str]:
    """What grows."""
    start, middle, end = states(rows)
    if end[1] - middle[1] > GROWTH:
        yield '**memory grows**'
    for k, what in ((2, 'threads'), (3, 'files')):
        if end[k] > start[k]:
            yield f'**{what} grow**'


def is_right(run: Run) -> bool:
    """Whether all is as it should be."""
    steady = not any(any(growth(np.array(looks))) for looks in run.processes.looks.values())
    whole = all(missing == 0 and wrong == 0 for _, missing, wrong in run.samples.values())
    return run.stood and steady and whole


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--lockstep-minutes', type=float, default=60.0, help='0: none [60]')
    parser.add_argument('--wires-minutes', type=float, default=15.0, help='0: none [15]')
    parser.add_argument('--minutes', type=float, help='instead of both')
    parser.add_argument('--first', action='store_true', help='wires: with real-time priority')
    parser.add_argument('--write', action='store_true', help='store the table')
    options = parser.parse_args()
    minutes = {'lockstep': options.lockstep_minutes, 'wires': options.wires_minutes}
    if options.minutes is not None:
        minutes = dict.fromkeys(minutes, options.minutes)
    LOG.parent.mkdir(parents=True, exist_ok=True)
    runs: list[Run] = []
    makers: dict[str, Callable[[float, Path], Any]] = {
        'lockstep': lockstep, 'wires': lambda s, folder: on_wires(s, folder, options.first),
    }  # fmt: skip
    for name, length in minutes.items():
        if length > 0:
            with tempfile.TemporaryDirectory(prefix='cg_soak_') as folder:
                runs.append(makers[name](60 * length, Path(folder)))
            print(file=sys.stderr)
            alone = dict.fromkeys(minutes, 0.0) | {name: length}
            words = ' '.join(f'--{n}-minutes {m:g}' for n, m in alone.items())
            text = page(runs[-1], words + ' --first' * (options.first and name == 'wires'))
            print(text)
            if options.write:
                write_atomically(RESULTS / f'soak_{name}.md', text)
    return 0 if all(map(is_right, runs)) else 1


if __name__ == '__main__':
    sys.exit(main())
