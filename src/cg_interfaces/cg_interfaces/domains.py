"""A ROS domain of one's own, so that two runs on one machine never hear each other."""

import contextlib
import fcntl
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO

DOMAINS = range(2, 100)  # beyond 101, DDS ports run into those that Linux hands out


def _lock_file(domain: int) -> Path:
    return Path(tempfile.gettempdir()) / f'ros_domain_{domain}.lock'


def _let_go(domain: int) -> int:
    """When the last holder of a domain let it go, in ns since the epoch; 0 if nobody held it."""
    try:
        return _lock_file(domain).stat().st_mtime_ns
    except OSError:
        return 0


def _note(lock: IO) -> None:
    now = time.time_ns()  # finer than the clock of the file system
    os.utime(lock.fileno(), ns=(now, now))


def _take(domain: int, since: int) -> IO | None:
    """The lock on a domain that nobody held since then; None if somebody does or did."""
    try:
        lock = _lock_file(domain).open('a')
    except OSError:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if since in (0, _let_go(domain)):
            _note(lock)  # should this process be killed
            return lock
    except OSError:
        pass
    lock.close()
    return None


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """Hold a ROS_DOMAIN_ID that no other holder on this machine has, and set it.

    A file lock per domain marks it as taken; the lock dies with the process. Of those that are
    free it is the one that has rested longest, whoever held it: nodes that were killed stay on the
    graph of their domain for some seconds.
    """
    before = os.environ.get('ROS_DOMAIN_ID')
    for since, domain in sorted((_let_go(domain), domain) for domain in DOMAINS):
        lock = _take(domain, since)
        if lock is None:
            continue
        os.environ['ROS_DOMAIN_ID'] = str(domain)
        try:
            yield domain
        finally:
            _note(lock)
            lock.close()
            if before is None:
                del os.environ['ROS_DOMAIN_ID']
            else:
                os.environ['ROS_DOMAIN_ID'] = before
        return
    raise RuntimeError(f'all ROS domains from {DOMAINS[0]} to {DOMAINS[-1]} are taken')
