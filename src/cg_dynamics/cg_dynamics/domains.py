"""A ROS domain of one's own, so that two runs on one machine never hear each other."""

import contextlib
import fcntl
import itertools
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

DOMAINS = range(2, 100)  # beyond 101, DDS ports run into those that Linux hands out
_turn = itertools.count(os.getpid())


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """Hold a ROS_DOMAIN_ID that no other holder on this machine has, and set it.

    A file lock per domain marks it as taken; the lock dies with the process.
    """
    before = os.environ.get('ROS_DOMAIN_ID')
    first = next(_turn)  # the domain held last is still full of ghosts
    for offset in range(len(DOMAINS)):
        domain = DOMAINS[(first + offset) % len(DOMAINS)]
        path = Path(tempfile.gettempdir()) / f'ros_domain_{domain}.lock'
        with contextlib.suppress(OSError), path.open('a') as lock:
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError:
                continue
            os.environ['ROS_DOMAIN_ID'] = str(domain)
            try:
                yield domain
            finally:
                if before is None:
                    del os.environ['ROS_DOMAIN_ID']
                else:
                    os.environ['ROS_DOMAIN_ID'] = before
            return
    raise RuntimeError(f'all ROS domains from {DOMAINS[0]} to {DOMAINS[-1]} are taken')
