"""The emulated robot as a process, for tests."""

import contextlib
import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

READY = 60.0  # s in which it is there, compilation included
PRIORITY = -10  # niceness that the drive's node has as well, where it may be had
NAP = 0.002  # s, a cycle of the drive
NAPS = 500
TOO_LATE = 0.01  # s: a drive waits for 16 ms, less a cycle and what the wires take


def wakes_late() -> float:
    """Longest by which this host wakes a thread too late in a second of drive's cycles, s."""
    worst = 0.0
    for _ in range(NAPS):
        due = time.monotonic() + NAP
        time.sleep(NAP)
        worst = max(worst, time.monotonic() - due)
    return worst


def skip_if_busy(why: str) -> None:
    """A verdict on deadlines means nothing on a host that is measured to keep none."""
    late = wakes_late()
    if late > TOO_LATE:
        pytest.skip(f'the host wakes a thread {1000 * late:.0f} ms late, and {why}')


def blame_the_host(why: str) -> None:
    """What failed again and again is the host's fault where that is measured, else ours."""
    skip_if_busy(why)
    pytest.fail(f'{why}, and the host keeps time')


class Emulated:
    """The process; ends with the context. Meanwhile the thread that leads the drive has priority.

    A busy machine would hold it up for longer than the drive waits for its host.
    """

    def __init__(self, folder: Path, *words: str):
        self.folder = folder
        self.bus = {'interface': 'slcan', 'channel': str(folder / 'can'), 'bitrate': 1_000_000,
                    'sleep_after_open': 0.1}  # fmt: skip
        self.process = subprocess.Popen(
            [sys.executable, '-m', 'cg_hardware.emulators.robot', str(folder), *words],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        assert self.process.stdout.readline() == 'ready\n'

    def ask(self, words: str) -> None:
        """Have something happen."""
        self.process.stdin.write(words + '\n')
        self.process.stdin.flush()

    def report(self) -> dict:
        """How it is, and every change of the drive's torque since the last report."""
        self.ask('report')
        return json.loads(self.process.stdout.readline())

    def __enter__(self) -> 'Emulated':
        self._niceness = os.getpriority(os.PRIO_PROCESS, 0)
        with contextlib.suppress(PermissionError):
            os.setpriority(os.PRIO_PROCESS, 0, PRIORITY)
        return self

    def __exit__(self, *error) -> None:
        if hasattr(self, '_niceness'):
            os.setpriority(os.PRIO_PROCESS, 0, self._niceness)
        self.process.kill()
        self.process.communicate()
