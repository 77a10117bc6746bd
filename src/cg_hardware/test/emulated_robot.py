"""The emulated robot as a process, for tests."""

import json
import subprocess
import sys
from pathlib import Path

READY = 60.0  # s in which it is there, compilation included


class Emulated:
    """The process; ends with the context."""

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
        return self

    def __exit__(self, *error) -> None:
        self.process.kill()
        self.process.communicate()
