"""How soon a process gets a processor, where it may be had. No ROS."""

import contextlib
import os
from pathlib import Path

AUTOGROUP = Path('/proc/self/autogroup')


def take_priority(niceness: int) -> None:
    """Give this process a niceness, and the threads that it starts from now on.

    Where Linux shares processors out among sessions first (`kernel.sched_autogroup_enabled`, the
    default of most distributions), niceness counts among the processes of one session only. So a
    process that leads a session, as every node that our runners start, gives it to that as well.
    An ordinary user may not lower a niceness; then it stays what it is.

    Args:
        niceness: From -20, first of all, to 19.
    """
    with contextlib.suppress(PermissionError):
        os.setpriority(os.PRIO_PROCESS, 0, niceness)
    if os.getsid(0) == os.getpid():
        with contextlib.suppress(OSError):  # no such kernel, or no such right
            AUTOGROUP.write_text(str(niceness))
