"""How a process is told to end: by a signal, or because the process that started it is gone.

Signals can be sent by whoever still lives. For the rest there is the lifeline: a process that
starts nodes keeps the writing end of the pipe that is their standard input, and tells them so by
the environment variable LIFELINE. When it dies, even of SIGKILL, the kernel closes its end, and
every node reads the end of the file.

Why not prctl(PR_SET_PDEATHSIG): it fires when the thread that forked ends, not the process, it
leaves a gap between fork and prctl, and `ros2 launch` offers no place to call it. A pipe has no
gap, it survives the re-exec with which the ROS wheels start Python, and `ros2 launch` gives its
nodes one as it is. A node that was started by hand has no LIFELINE and reads nothing.

    python -m cg_dynamics.stop_request MODULE_OR_SCRIPT ARGS...

runs a node that holds its lifeline, and ends without a traceback, from before its imports on: they
take seconds on a busy machine.
"""

import contextlib
import os
import runpy
import signal
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

LIFELINE = 'CG_LIFELINE'
ON_STDIN = {LIFELINE: 'stdin'}  # added to the environment of a process that has a lifeline
SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
GRACE = 1.5  # s that a process has to end by itself once its lifeline is cut


class Stopped(KeyboardInterrupt):
    """A signal told this process to end.

    Attributes:
        number: Which one.
        status: The exit status that shells expect of it, 128 + number.
    """

    def __init__(self, number: int):
        super().__init__(f'stopped by {signal.Signals(number).name}')
        self.number = number
        self.status = 128 + number


_came: list[int] = []  # signals that raised Stopped, in the contexts that are open


@contextlib.contextmanager
def stopped_by_signals() -> Iterator[None]:
    """In this context a signal raises Stopped, so that what the process holds is given back.

    A signal may come inside a lock's own code, or in C that turns it into another error, or that
    swallows it: NumPy does, where it asks an object for `__array_ufunc__`. So whatever ends the
    context after a signal is told as the signal, its ordinary end too. Long work asks
    `raise_if_stopped` from time to time.
    """
    earlier = len(_came)

    def on_signal(number: int, frame: Any) -> None:
        _came.append(number)
        raise Stopped(number)

    before = {number: signal.signal(number, on_signal) for number in _heard()}
    try:
        yield
        raise_if_stopped()
    except Exception as error:
        if _came[earlier:]:
            raise Stopped(_came[earlier]) from error
        raise
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        del _came[earlier:]


def raise_if_stopped() -> None:
    """Raise Stopped if a signal came in `stopped_by_signals` and was swallowed on its way."""
    if _came:
        raise Stopped(_came[0])


def _heard() -> list[signal.Signals]:
    """The signals to handle: not SIGHUP where it is ignored, which is how `nohup` works."""
    ignored = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    return [number for number in SIGNALS if number != signal.SIGHUP or not ignored]


class StopRequest:
    """Counts the signals that tell this process to end, instead of ending it.

    SIGINT and SIGTERM count even where the parent shell made the process ignore them; SIGHUP
    does not. Python hears signals in its main thread only: in another one the request never comes.

    Attributes:
        number: The first signal that came, None before that.
        count: How many came.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self.count = 0
        self._before: dict[int, Any] = {}
        if threading.current_thread() is not threading.main_thread():
            return
        for number in _heard():
            self._before[number] = signal.signal(number, self._on_signal)

    @property
    def requested(self) -> bool:
        """Whether a signal came."""
        return self.number is not None

    def _on_signal(self, number: int, frame: Any) -> None:
        self.count += 1
        if self.number is None:
            self.number = number

    def check(self) -> None:
        """Raise Stopped if a signal came."""
        if self.number is not None:
            raise Stopped(self.number)

    def restore(self) -> None:
        """Give the signals back to whoever handled them before."""
        for number, handler in self._before.items():
            signal.signal(number, handler)


def end_at_once() -> None:
    """From now on a signal ends this process as the kernel does it, without a traceback."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)


def end_with_parent() -> None:
    """From now on this process is told to end when the one that started it dies.

    It gets SIGTERM, if it has a handler for that, and after GRACE SIGKILL, together with the
    processes that it has started, if it leads its group. Without a lifeline nothing happens.
    """
    if os.environ.pop(LIFELINE, '') == 'stdin':
        threading.Thread(target=_hold_lifeline, daemon=True, name='lifeline').start()


def _hold_lifeline() -> None:
    with contextlib.suppress(OSError):
        while os.read(0, 4096):
            pass  # nobody is expected to write
    if signal.getsignal(signal.SIGTERM) != signal.SIG_DFL:
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(GRACE)
    if os.getpgrp() == os.getpid():
        os.killpg(0, signal.SIGKILL)
    os.kill(os.getpid(), signal.SIGKILL)


if __name__ == '__main__':
    end_at_once()
    end_with_parent()
    del sys.argv[0]
    if os.sep in sys.argv[0]:
        runpy.run_path(sys.argv[0], run_name='__main__')
    else:
        runpy.run_module(sys.argv[0], run_name='__main__', alter_sys=True)
