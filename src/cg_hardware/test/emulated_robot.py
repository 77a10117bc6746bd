"""The emulated robot as a process, for tests."""

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

READY = 60.0  # s in which it is there, compilation included
PRIORITY = -10  # niceness that the drive's node has as well, where it may be had
PATIENCE = 2.0  # s that host and drive wait for each other in tests that are not about time


def wait_longer(monkeypatch) -> None:
    """A busy host is no fault: drives that are opened from here on wait, and are waited for."""
    monkeypatch.setattr('cg_hardware.drive.can_drive.SILENCE_S', PATIENCE)
    for module in ('can_drive', 'watch'):
        monkeypatch.setattr(f'cg_hardware.drive.{module}.PATIENCE_MS', int(1000 * PATIENCE))


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

    def acted(self) -> set[int]:
        """Torques since the last report. A host that then is busy for 16 ms ends the last one."""
        return {torque for _, torque in self.report()['changes']}

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
