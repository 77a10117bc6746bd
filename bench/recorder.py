"""The real-time recorder when it is late, and when it is killed.

    ./cg exec python bench/recorder.py [--starts 20] [--kills 20] [--loads 0,15] [--write]

A machine sends seven topics of the compass gait at 500 Hz, and the latched note. *Started in the
middle*: the recorder starts while these flow; its bag must hold the note, begin with all topics
within a sample, and lack none from there on. *Killed*: the age of the newest stored sample of the
topic that has the oldest one, at SIGKILL, less the age of the newest one sent. A load of n is n
busy processes of ordinary priority. `--write` stores the table as bench/results/recorder.md.
"""

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import rclpy
import yaml
from geometry_msgs.msg import WrenchStamped
from rclpy.node import Node
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import String

from cg_description.model_file import write_atomically
from cg_interfaces.domains import own_domain
from cg_interfaces.ros import LATCHED_QOS, MACHINE_QOS, to_stamp
from cg_sysid.records.recover import recover

RESULT = Path(__file__).resolve().parent / 'results' / 'recorder.md'
PERIOD = 0.002  # s
TOPICS = {
    '/imu': Imu,
    '/hip_encoder': JointState,
    '/applied_torque': JointState,
    '/foot_contact/inner': WrenchStamped,
    '/foot_contact/outer': WrenchStamped,
    '/torque_command': JointState,
}


class Machine:
    """Sends from a thread of its own until it is stopped."""

    def __init__(self) -> None:
        self.node = Node('machine')
        self.note = self.node.create_publisher(String, '/experiment', LATCHED_QOS)
        self.note.publish(String(data='mechanism: compass_gait'))
        self.publishers = {
            topic: self.node.create_publisher(kind, topic, MACHINE_QOS)
            for topic, kind in TOPICS.items()
        }
        self.messages = {topic: kind() for topic, kind in TOPICS.items()}
        self.sent: list[int] = []
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        begun = time.monotonic()
        tick = 0
        while not self._ends.is_set():
            time.sleep(max(0.0, begun + tick * PERIOD - time.monotonic()))
            stamp_ns = time.time_ns()
            for topic, publisher in self.publishers.items():
                self.messages[topic].header.stamp = to_stamp(stamp_ns)
                publisher.publish(self.messages[topic])
            self.sent.append(stamp_ns)
            tick += 1

    def stop(self) -> None:
        """End the thread and the node."""
        self._ends.set()
        self._thread.join()
        self.node.destroy_node()


@contextmanager
def machine() -> Iterator[Machine]:
    with own_domain():
        rclpy.init()
        # As real hardware would: before the load, so that it is the recorder that is measured.
        sender = Machine()
        try:
            yield sender
        finally:
            sender.stop()
            rclpy.try_shutdown()


def start(bag: Path) -> tuple[subprocess.Popen, Path]:
    log = bag.with_suffix('.log')
    with log.open('w') as output:
        process = subprocess.Popen(
            [sys.executable, '-m', 'cg_sysid.recorder_node', '--ros-args', '-p',
             f'bag:={bag}'],
            stdout=output, stderr=output,
        )  # fmt: skip
    return process, log


def wait_for(log: Path, text: str, limit: float = 60.0) -> None:
    deadline = time.monotonic() + limit
    while text not in log.read_text():
        if time.monotonic() > deadline:
            raise TimeoutError(f'{log}: no {text!r} in {log.read_text()}')
        time.sleep(0.01)


def stamps_of(bag: Path) -> dict[str, np.ndarray]:
    stamps: dict[str, list[int]] = {topic: [] for topic in TOPICS}
    stamps['/experiment'] = []
    with AnyReader([bag]) as reader:
        for connection, log_ns, data in reader.messages():
            if connection.topic == '/experiment':
                stamps['/experiment'].append(log_ns)
            else:
                stamp = reader.deserialize(data, connection.msgtype).header.stamp
                stamps[connection.topic].append(stamp.sec * 10**9 + stamp.nanosec)
    return {topic: np.array(sorted(values)) for topic, values in stamps.items()}


def told(bag: Path) -> dict:
    info = yaml.safe_load((bag / 'metadata.yaml').read_text())['rosbag2_bagfile_information']
    return {key: json.loads(value) for key, value in (info['custom_data'] or {}).items()}


def started_in_the_middle(folder: Path, count: int) -> list[tuple[float, int, int, bool]]:
    """Spread of the first stamps in ms, samples lost after them, notes, whether late is told."""
    rows = []
    for k in range(count):
        bag = folder / f'middle{k}'
        with machine() as sender:
            time.sleep(0.2 + 0.013 * k)
            recorder, log = start(bag)
            wait_for(log, 'all topics are heard')
            time.sleep(0.5)
            recorder.send_signal(signal.SIGINT)
            recorder.wait()
        stamps = stamps_of(bag)
        notes = len(stamps.pop('/experiment'))
        firsts = [values[0] for values in stamps.values()]
        sent = np.array(sender.sent)
        lost = sum(
            int(((sent >= values[0]) & (sent <= values[-1])).sum()) - len(values)
            for values in stamps.values()
        )
        spread = float(1e-6 * (max(firsts) - min(firsts)))
        rows.append((spread, lost, notes, 'began_late' in told(bag)))
        print('middle', rows[-1], flush=True)
    return rows


def killed(folder: Path, count: int, load: int) -> list[tuple[float, float]]:
    """Loss in ms, and the longest delay in ms that the bag tells of."""
    rows = []
    for k in range(count):
        bag = folder / f'killed{load}_{k}'
        with machine() as sender:
            recorder, log = start(bag)
            wait_for(log, 'all topics are heard')
            with busy(load):
                time.sleep(2.0 + 0.0037 * k)
                newest = sender.sent[-1]
                os.kill(recorder.pid, signal.SIGKILL)
            recorder.wait()
        recover(bag)
        stamps = stamps_of(bag)
        stamps.pop('/experiment')
        oldest = min(values[-1] for values in stamps.values())
        late = max([0.0, *told(bag).get('received_late', {}).values()])
        rows.append((float(1e-6 * max(newest - oldest, 0)), 1e3 * late))
        print('killed', load, rows[-1], flush=True)
    return rows


@contextmanager
def busy(load: int) -> Iterator[None]:
    processes = [subprocess.Popen([sys.executable, '-c', 'while True: pass']) for _ in range(load)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
        for process in processes:
            process.wait()


def table(middle: list, losses: dict[int, list], around: float, command: str) -> str:
    lines = [
        '# The recorder, started late and killed', '', f'Command: `{command}`. '
        f'{os.cpu_count()} cores; other work made a load of about {around:.0f}.', '',
    ]  # fmt: skip
    if middle:
        spread, lost, notes, late = zip(*middle, strict=True)
        lines += [
            '| started in the middle | |', '|---|---:|',
            f'| starts | {len(middle)} |',
            f'| first samples of the topics apart, worst | {max(spread):.1f} ms |',
            f'| samples lost after the beginning of the bag | {sum(lost)} |',
            f'| bags without the note | {sum(n == 0 for n in notes)} |',
            f'| bags that tell of a late topic | {sum(late)} |', '',
        ]  # fmt: skip
    lines += ['| SIGKILL at load | kills | lost, median | 90 % | worst | '
              'above 20 ms and not told |', '|---:|---:|---:|---:|---:|---:|']  # fmt: skip
    for load, rows in losses.items():
        ms = np.array(rows)
        untold = int(((ms[:, 0] > 20.0) & (ms[:, 1] == 0.0)).sum())
        lines.append(
            f'| {load} | {len(rows)} | {np.median(ms[:, 0]):.1f} ms '
            f'| {np.percentile(ms[:, 0], 90):.1f} ms | {ms[:, 0].max():.1f} ms | {untold} |'
        )
    return '\n'.join(lines) + '\n'


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--starts', type=int, default=20)
    parser.add_argument('--kills', type=int, default=20)
    parser.add_argument('--loads', default='0,15', help='busy processes, comma-separated')
    parser.add_argument('--write', action='store_true')
    options = parser.parse_args()
    loads = [int(load) for load in options.loads.split(',')]
    around = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        middle = started_in_the_middle(folder, options.starts)
        losses = {load: killed(folder, options.kills, load) for load in loads}
    command = (
        f'./cg exec python bench/recorder.py --starts {options.starts} --kills {options.kills} '
        f'--loads {options.loads} --write'
    )
    text = table(middle, losses, around, command)
    print(text)
    if options.write:
        write_atomically(RESULT, text)


if __name__ == '__main__':
    main()
