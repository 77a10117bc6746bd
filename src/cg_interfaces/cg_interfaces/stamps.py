"""Stamps: times as whole nanoseconds since the epoch. No ROS."""

import struct

NS_PER_S = 1_000_000_000
_STAMP = struct.Struct('<iI')
_HEADER_OFFSET = 4  # bytes of a serialised message before its Header


def stamp_of(serialised: bytes) -> int:
    """Stamp in ns of a message in CDR that begins with a Header.

    Raises:
        struct.error: if it is shorter than that.
    """
    seconds, nanoseconds = _STAMP.unpack_from(serialised, _HEADER_OFFSET)
    return int(seconds * NS_PER_S + nanoseconds)
