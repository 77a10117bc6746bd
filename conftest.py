"""Tests that keep deadlines run alone, though others run side by side in several processes."""

import fcntl
import getpass
import tempfile
from pathlib import Path

import pytest

_LOCKS = Path(tempfile.gettempdir()) / f'compass_gait_tests_{getpass.getuser()}'


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item):
    """A test marked `alone` waits until no other runs, and holds the others up meanwhile.

    Who waits keeps the door, so that a stream of others cannot hold it up for ever.
    """
    _LOCKS.mkdir(exist_ok=True)
    kind = fcntl.LOCK_EX if item.get_closest_marker('alone') else fcntl.LOCK_SH
    with (_LOCKS / 'room').open('a') as room:
        with (_LOCKS / 'door').open('a') as door:
            fcntl.flock(door, fcntl.LOCK_EX)
            fcntl.flock(room, kind)
        return (yield)
