"""Tests in several processes: those that keep deadlines run alone, and the longest ones begin."""

import fcntl
from pathlib import Path

import pytest

# Two files of this workspace that surely exist; locks do not touch them.
_ROOM, _DOOR = Path(__file__), Path(__file__).with_name('pyproject.toml')


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(items):
    """Those that run alone first, then the slow ones.

    Each process takes the next test of this order (colcon_defaults.yaml). So nobody waits in front
    of a test that runs alone until a slow one has ended, and none is left with a slow one at last.
    """
    items.sort(key=lambda item: [item.get_closest_marker(m) is None for m in ('alone', 'slow')])


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item):
    """A test marked `alone` waits until no other runs, and holds the others up meanwhile.

    Who waits keeps the door, so that a stream of others cannot hold it up for ever.
    """
    kind = fcntl.LOCK_EX if item.get_closest_marker('alone') else fcntl.LOCK_SH
    with _ROOM.open() as room:
        with _DOOR.open() as door:
            fcntl.flock(door, fcntl.LOCK_EX)
            fcntl.flock(room, kind)
        return (yield)
