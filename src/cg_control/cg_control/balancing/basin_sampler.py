"""A process that samples basins, started before the loop that must not wait for it.

Whoever runs a loop of some milliseconds asks for the basin of new gains by writing a line, and
looks now and then whether the answer is there. Neither starts anything or waits. The process
holds one question at a time: of those asked meanwhile only the last one is put to it.
"""

import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from cg_control.balancing.basin import Basin, modes_of, sample_basin, shipped_basins
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES

POLL = 0.01  # s


class BasinError(RuntimeError):
    """The basin could not be sampled; the message says why."""


class BasinSampler:
    """Basins of the gains of one model.

    Args:
        path: File of the model.
        model: The same, loaded.
    """

    def __init__(self, path: Path, model: Model):
        self._modes = {stance: modes_of(model, stance) for stance in STANCES}
        self._process = subprocess.Popen(
            [sys.executable, '-m', 'cg_control.balancing.basin_sampler', str(path)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the asker; its end closes the pipe
        )
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._questions, self._answers = self._process.stdin, self._process.stdout
        os.set_blocking(self._answers.fileno(), False)
        self._text = b''
        self._asked = False
        self._next: bytes | None = None

    @property
    def busy(self) -> bool:
        """True while an answer is owed."""
        return self._asked

    def ask(self, gains: Mapping[str, np.ndarray], torque_limit: float) -> None:
        """Ask for the basins of these gains; whatever was asked before is of no interest.

        Args:
            gains: Stance -> K, of which the first four count.
            torque_limit: In N m.
        """
        question = {s: [float(k) for k in gains[s][:4]] for s in STANCES}
        line = json.dumps({'gains': question, 'torque_limit': torque_limit}).encode() + b'\n'
        if self._asked:
            self._next = line
        else:
            self._send(line)

    def _send(self, line: bytes) -> None:
        self._asked, self._next = True, None
        with contextlib.suppress(OSError):  # it has died; `collect` says so
            self._questions.write(line)
            self._questions.flush()

    def collect(self) -> dict[str, Basin] | None:
        """The basins asked for last, once; None while there is nothing new.

        Raises:
            BasinError: They could not be sampled.
        """
        if not self._asked:
            return None
        self._text += self._answers.read() or b''
        line, newline, self._text = self._text.partition(b'\n')
        if not newline:
            self._text = line
            if self._process.poll() is not None:
                self._asked = False
                raise BasinError(f'its process ended with status {self._process.returncode}')
            return None
        self._asked = False
        if self._next is not None:
            self._send(self._next)
            return None
        answer = json.loads(line)
        if 'error' in answer:
            raise BasinError(answer['error'])
        return {s: Basin(self._modes[s], tuple(answer[s])) for s in STANCES}

    def wait(self, timeout: float) -> dict[str, Basin] | None:
        """As `collect`, for a caller with time; None if there is no answer within that many s."""
        deadline = time.monotonic() + timeout
        while self._asked and time.monotonic() < deadline:
            basins = self.collect()
            if basins is not None:
                return basins
            time.sleep(POLL)
        return None

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.wait()
        with contextlib.suppress(OSError):  # what it did not read any more
            self._questions.close()
        self._answers.close()


def answer(model: Model, line: str) -> dict:
    """The answer to a question: stance -> bounds in rad, or {'error': why}."""
    question = json.loads(line)
    gains = {s: np.array(question['gains'][s]) for s in STANCES}
    limit = question['torque_limit']
    try:
        basins = shipped_basins(model, gains, limit) or {
            s: sample_basin(model, s, gains[s], limit) for s in STANCES
        }
    except ValueError as error:
        return {'error': str(error)}
    return {s: list(basin.bounds) for s, basin in basins.items()}


def main() -> int:
    """Answer questions, line by line, until the asker is gone."""
    # Only on a core that nobody else wants: a loop of 2 ms feels even a nice neighbour.
    os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    model = Model.load(sys.argv[1])
    for line in sys.stdin:
        print(json.dumps(answer(model, line)), flush=True)
    return 0


if __name__ == '__main__':
    sys.exit(main())
