"""Faults of a robot on wires, seen from its drive: how long torque acts, and that it stays off.

    ./cg exec python bench/wires_faults.py [--times 10] [--only NAME ...] [--write FILE]

Every trial starts the nodes and emulated devices anew, stands, is pushed so that there is torque,
and then gets the fault. Time is the emulation's, from the report before the fault, which comes a
millisecond or two earlier. For a second afterwards, with what failed back on its wire, nobody
resets anything: torque that comes back then is counted. A trial in which the host held the
emulation up by more than 10 ms says nothing and is done again.
"""

import argparse
import os
import signal
import sys
from pathlib import Path

import numpy as np

ROOT = Path(__file__).parents[1]
sys.path[:0] = [str(ROOT / f'src/cg_{p}/test') for p in ('bringup', 'hardware')]

from wired_robot import FAULTS, standing  # noqa: E402

HELD_UP = 0.01  # s
TRIES = 4  # for each trial that is to count
AT_MOST = 0.02  # s


def trial(fault: str) -> tuple[float, bool] | None:
    """Time in s until the torque is zero, and whether any came back; None if the host was busy."""
    with standing() as (robot, person, nodes):
        robot.report()
        robot.ask('push 0.4')
        person.wait(0.05)
        before = robot.report()
        if before['acting'] == 0:
            return None
        FAULTS[fault](robot, nodes)
        person.wait(0.3)
        after = robot.report()
        if after['late'] > HELD_UP:
            return None
        last = max((at for at, torque in after['changes'] if torque == 0), default=np.inf)
        spent = last - before['time'] if after['acting'] == 0 else np.inf
        if fault.endswith('stopped'):
            os.kill(nodes['balance'].pid, signal.SIGCONT)
        for word in ('imu_back', 'can_back'):
            robot.ask(word)
        person.wait(1.0)
        return float(spent), any(torque for _, torque in robot.report()['changes'])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--times', type=int, default=10)
    parser.add_argument('--only', nargs='*', default=list(FAULTS), choices=list(FAULTS))
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    lines = ['| fault | times | zero after, ms: median | worst | later than 20 ms | came back |',
             '|---|---:|---:|---:|---:|---:|']  # fmt: skip
    for fault in options.only:
        found: list[tuple[float, bool]] = []
        for _ in range(TRIES * options.times):
            result = trial(fault)
            found += [result] if result else []
            if len(found) == options.times:
                break
        if not found:
            lines.append(f'| {fault} | 0 | | | | |')
            continue
        spent = np.array([s for s, _ in found])
        lines.append(
            f'| {fault.replace("_", " ")} | {len(found)} | {1e3 * np.median(spent):.0f} | '
            f'{1e3 * spent.max():.0f} | {np.sum(spent > AT_MOST)} | {sum(b for _, b in found)} |'
        )
        print(lines[-1], flush=True)
    if options.write:
        options.write.write_text('\n'.join([
            '# Faults of a robot on wires', '', 'Command: `./cg exec python '
            f'bench/wires_faults.py --times {options.times}`. The drive, the IMU and the body are '
            'emulated in another process.', '', *lines, '',
        ]))  # fmt: skip


if __name__ == '__main__':
    main()
