"""The live system in figures: lock-step pace, real-time lateness, bag size.

    ./cg exec python bench/live_system.py [--duration 10]

Prints one table. Absolute figures belong to the machine they were taken on.
"""

import argparse
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from rosbags.highlevel import AnyReader

from cg_bringup.experiment import run_experiment
from cg_bringup.runs import Run
from cg_interfaces.domains import own_domain
from cg_sysid.experiments.catalogue import load_experiment

PERIOD = 0.002  # s


def stamps_and_logs(bag: Path) -> dict[str, np.ndarray]:
    """Topic -> rows of (stamp, log time) in ns."""
    rows: dict[str, list] = {}
    with AnyReader([bag]) as reader:
        for connection, log_ns, data in reader.messages():
            if connection.topic != '/experiment':
                stamp = reader.deserialize(data, connection.msgtype).header.stamp
                rows.setdefault(connection.topic, []).append(
                    (stamp.sec * 10**9 + stamp.nanosec, log_ns)
                )
    return {topic: np.array(pairs) for topic, pairs in rows.items()}


def experiments(directory: Path, duration: float) -> list[tuple[str, str]]:
    """Pace and size of both modes."""
    table = []
    experiment = load_experiment('spring_stabilised_inner')
    for mode in ('lockstep', 'real_time'):
        with own_domain():
            run = Run(experiment, directory / mode, mode=mode, duration=duration)
            recorded = run_experiment(run)
        size = sum(file.stat().st_size for file in recorded.path.iterdir())
        messages = sum(recorded.counts.values())
        table += [
            (f'{mode}: start to closed bag', f'{recorded.seconds:.1f} s for {duration:g} s'),
            (f'{mode}: bag', f'{size / duration / 1e3:.0f} kB/s, {size / messages:.1f} B/message'),
        ]
    rows = stamps_and_logs(directory / 'real_time')
    delay = (rows['/imu'][:, 1] - rows['/imu'][:, 0]) * 1e-6
    answer = rows['/torque_command'][:, 1] - rows['/torque_command'][:, 0]
    for name, values in (
        ('real time: measurement recorded after its stamp', delay),
        ('real time: its answer recorded after the same stamp', answer * 1e-6),
    ):
        p50, p99, worst = np.percentile(values, [50, 99, 100])
        table.append((name, f'p50 {p50:.2f}, p99 {p99:.2f}, worst {worst:.2f} ms'))
    return table


def lockstep_pace(ticks: int) -> list[tuple[str, str]]:
    """Ticks per s of a machine and a controller in two processes, and with a recorder as third."""
    table = []
    for recorders in (0, 1):
        with own_domain(), tempfile.TemporaryDirectory() as directory:
            machine = ['-p', 'mode:=lockstep', '-p', 'exit_when_done:=true']
            machine += ['-p', f'duration:={ticks * PERIOD}', '-p', f'recorders:={recorders}']
            nodes = [start('cg_sysid.excitation_node', '-p', 'kind:=none')]
            if recorders:
                bag = Path(directory) / 'bag'
                recorder = ('-p', f'bag:={bag}', '-p', 'time:=stamp')
                nodes.append(start('cg_sysid.recorder_node', *recorder))
            machine_process = start('cg_hardware.simulation_node', *machine)
            _, log = machine_process.communicate()
            for node in nodes:
                node.send_signal(signal.SIGINT)
                node.wait()
        spent = float(log.rsplit('samples in ', 1)[1].split(' s')[0])
        table.append((f'lock-step with {recorders} recorder', f'{ticks / spent:.0f} ticks/s'))
    return table


def start(module: str, *parameters: str) -> subprocess.Popen:
    """A node as a process of its own."""
    return subprocess.Popen(
        [sys.executable, '-m', module, '--ros-args', *parameters],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--duration', type=float, default=10.0, help='of each record in s')
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as directory:
        table = lockstep_pace(5000)
        table += experiments(Path(directory), options.duration)
    width = max(len(name) for name, _ in table)
    for name, value in table:
        print(f'{name:{width}}  {value}')


if __name__ == '__main__':
    main()
